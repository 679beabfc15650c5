//! A source in the domain where its samples are drawn: time, spectrum, or pixels.

use ndarray::Array2;

use super::sampling::{DomainExtent, Positions};
use crate::recognise::features::hsv;
use crate::scene::{Colour, Domain, SourceSpec};
use crate::spectrum::amplitude_spectrum;
use crate::trial::{Image, Series, Signal};

/// All samples of one source in its domain, from which some are drawn.
#[derive(Clone, Debug)]
pub enum DomainSamples {
    /// Rows are frames or bins, columns are channels.
    Rows {
        /// Time or spectrum.
        extent: DomainExtent,
        /// Shape (frames or bins, channels).
        rows: Array2<f32>,
    },
    /// Pixels; when drawn, they are converted to the colour channels that are compared.
    Pixels(Image, Colour),
}

impl DomainSamples {
    /// The first `frames` of a source's signal in the domain that its description asks for.
    pub fn new(spec: &SourceSpec, signal: &Signal, frames: usize) -> Self {
        match signal {
            Signal::Image(image) => Self::Pixels(image.clone(), spec.colour),
            Signal::Series(series) => {
                let series = series.crop(0, frames);
                match spec.domain {
                    Domain::Spectrum { band_hz } => spectrum_rows(&series, band_hz),
                    Domain::Time { .. } | Domain::Image => {
                        let rows = series.view().to_owned();
                        Self::Rows { extent: DomainExtent::Time(rows.nrows()), rows }
                    }
                }
            }
        }
    }

    /// The extent from which positions are drawn.
    pub(crate) fn extent(&self) -> DomainExtent {
        match self {
            Self::Rows { extent, .. } => *extent,
            Self::Pixels(..) => DomainExtent::Image,
        }
    }

    /// The samples at `positions`, shape (positions, channels).
    pub fn at(&self, Positions(positions): &Positions) -> Array2<f64> {
        match self {
            Self::Rows { rows, .. } => {
                Array2::from_shape_fn((positions.len(), rows.ncols()), |(i, channel)| {
                    f64::from(rows[[positions[i], channel]])
                })
            }
            Self::Pixels(image, colour) => {
                let channels = match colour {
                    Colour::Hsv | Colour::Rgb => 0..3,
                    Colour::Hue => 0..1,
                    Colour::Saturation => 1..2,
                    Colour::Value => 2..3,
                };
                let mut samples = Array2::zeros((positions.len(), channels.len()));
                for (mut sample, &at) in samples.rows_mut().into_iter().zip(positions) {
                    let rgb = image.pixel(at / Image::COLS, at % Image::COLS);
                    let all = match colour {
                        Colour::Rgb => rgb.map(|x| f64::from(x) / 255.0),
                        _ => hsv(rgb),
                    };
                    sample.iter_mut().zip(&all[channels.clone()]).for_each(|(slot, x)| *slot = *x);
                }
                samples
            }
        }
    }
}

fn spectrum_rows(series: &Series, band_hz: (f64, f64)) -> DomainSamples {
    let spectra: Vec<_> = (0..series.channels())
        .map(|c| amplitude_spectrum(series.channel(c), series.rate_hz(), band_hz))
        .collect();
    let bins = spectra[0].len();
    let rows = Array2::from_shape_fn((bins, spectra.len()), |(bin, c)| spectra[c][bin] as f32);
    DomainSamples::Rows { extent: DomainExtent::Spectrum(bins), rows }
}
