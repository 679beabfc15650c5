//! A trial as the method `embedding` sees it: frames, delay pairs, neighbouring
//! pixels; made at once, or piece by piece while a scan goes on.

use std::collections::BTreeMap;
use std::sync::Arc;

use rayon::prelude::*;

use super::decimated::DecimatedSeries;
use super::frames::{FrameView, VIEWS, ViewFrames};
use super::image_features::PixelGrid;
use crate::recognise::checks::{check_signal, check_surfaces};
use crate::recognise::error::RecogniseError;
use crate::scene::{Domain, Scene, SourceId, SourceSpec};
use crate::trial::{Signal, Trial, TrialKey};

/// One source of a trial.
#[derive(Clone, Debug, serde::Serialize, serde::Deserialize)]
pub enum Framed {
    /// Log-band frames, one view after the other.
    Bands(Vec<ViewFrames>),
    /// A series at about 1 kHz.
    Slow(DecimatedSeries),
    /// A grid of pixels.
    Pixels(PixelGrid),
}

/// One source of a trial, with what it was made of.
#[derive(Clone, Debug, serde::Serialize, serde::Deserialize)]
pub struct SourceFrames {
    /// What is kept.
    pub data: Framed,
    /// How long the recording was, in seconds; 0 for pictures.
    pub duration_s: f64,
    /// The recording's rate in Hz; 0 for pictures.
    pub rate_hz: f64,
}

/// A trial, ready for `embedding`.
#[derive(Clone, Debug)]
pub struct FrameFeatures {
    /// Which trial this is.
    pub key: TrialKey,
    /// What it holds of the scene's sources.
    pub sources: BTreeMap<SourceId, SourceFrames>,
}

impl FrameFeatures {
    /// Frames those sources of a trial that the scene describes.
    ///
    /// # Errors
    /// If a source is of another kind, or has another number of channels, than the scene says.
    pub fn new(key: &TrialKey, trial: &Trial, scene: &Scene) -> Result<Self, RecogniseError> {
        let known = trial.signals.iter().filter_map(|(id, s)| Some((scene.get(id.as_str())?, s)));
        let known: Vec<(&SourceSpec, &Signal)> = known.collect();
        let sources = known
            .into_par_iter()
            .map(|(spec, signal)| Ok((spec.id.clone(), frame_source(spec, signal, key)?)))
            .collect::<Result<_, RecogniseError>>()?;
        Ok(Self { key: key.clone(), sources })
    }
}

fn frame_source(
    spec: &SourceSpec,
    signal: &Signal,
    key: &TrialKey,
) -> Result<SourceFrames, RecogniseError> {
    check_signal(spec, signal, key)?;
    Ok(match signal {
        Signal::Image(image) => SourceFrames {
            data: Framed::Pixels(PixelGrid::new(image)),
            duration_s: 0.0,
            rate_hz: 0.0,
        },
        Signal::Series(series) => {
            let (rate_hz, channels) = (series.rate_hz(), series.channels());
            let data = match spec.domain {
                Domain::Spectrum { band_hz } => {
                    let of_view = |view| ViewFrames::new(view, series.samples());
                    Framed::Bands(
                        views(rate_hz, channels, band_hz).into_par_iter().map(of_view).collect(),
                    )
                }
                Domain::Time | Domain::Image => {
                    Framed::Slow(DecimatedSeries::new(rate_hz, channels, series.samples()))
                }
            };
            SourceFrames { data, duration_s: series.duration_s(), rate_hz }
        }
    })
}

fn views(rate_hz: f64, channels: usize, band_hz: (f64, f64)) -> Vec<FrameView> {
    let view = |(frame_s, bands)| FrameView::new(rate_hz, channels, band_hz, frame_s, bands);
    VIEWS.into_iter().map(view).collect()
}

/// A library sorted by key, so that nothing depends on the order it came in.
///
/// # Errors
/// If it holds fewer than two surfaces, or rates that cannot be compared.
pub fn sorted_library(
    mut library: Vec<Arc<FrameFeatures>>,
) -> Result<Vec<Arc<FrameFeatures>>, RecogniseError> {
    library.sort_by(|a, b| a.key.cmp(&b.key));
    check_surfaces(library.iter().map(|trial| &trial.key))?;
    let mut first: BTreeMap<&SourceId, (&SourceFrames, &TrialKey)> = BTreeMap::new();
    for trial in &library {
        for (id, source) in &trial.sources {
            let (like, key) = first.entry(id).or_insert((source, &trial.key));
            check_rates(id, source, like, key)?;
        }
    }
    Ok(library)
}

/// Checks that a source of a query can be compared with that of a library trial, by frequency in
/// Hz or by time in seconds. Rates may differ; a rate too low for the library's band may not.
pub fn check_rates(
    id: &SourceId,
    query: &SourceFrames,
    library: &SourceFrames,
    library_key: &TrialKey,
) -> Result<(), RecogniseError> {
    if let (Framed::Bands(a), Framed::Bands(b)) = (&query.data, &library.data)
        && !a.iter().zip(b).all(|(a, b)| a.view.comparable(&b.view))
    {
        return Err(RecogniseError::Rates {
            source_name: id.clone(),
            query_hz: query.rate_hz,
            library_hz: library.rate_hz,
            trial: library_key.to_string(),
        });
    }
    Ok(())
}

/// A trial that grows while a scan goes on: frames are transformed when they are complete, and
/// never again. [`FrameStream::so_far`] equals [`FrameFeatures::new`] of what was pushed.
#[derive(Clone, Debug)]
pub struct FrameStream {
    scene: Scene,
    key: TrialKey,
    sources: BTreeMap<SourceId, SourceStream>,
}

#[derive(Clone, Debug)]
struct SourceStream {
    source: SourceFrames,
    channels: usize,
    samples: usize,
    /// Samples that are not yet used up: for each view, or for the series.
    pending: Vec<Vec<f32>>,
}

impl FrameStream {
    /// A stream without samples.
    pub fn new(scene: Scene, key: TrialKey) -> Self {
        Self { scene, key, sources: BTreeMap::new() }
    }

    /// Takes what newly arrived of a source: the next frames of a series, or a picture. Sources
    /// that the scene does not describe are passed over.
    ///
    /// # Errors
    /// If the source is of another kind, or has another number of channels, than the scene says,
    /// or if its rate changes while the scan goes on.
    pub fn push(&mut self, id: &SourceId, signal: &Signal) -> Result<(), RecogniseError> {
        let Some(spec) = self.scene.get(id.as_str()) else { return Ok(()) };
        check_signal(spec, signal, &self.key)?;
        let Signal::Series(series) = signal else {
            let source = frame_source(spec, signal, &self.key)?;
            let stream = SourceStream { source, channels: 0, samples: 0, pending: Vec::new() };
            self.sources.insert(id.clone(), stream);
            return Ok(());
        };
        let (rate_hz, channels) = (series.rate_hz(), series.channels());
        let stream = self.sources.entry(id.clone()).or_insert_with(|| {
            let data = match spec.domain {
                Domain::Spectrum { band_hz } => Framed::Bands(
                    (views(rate_hz, channels, band_hz).into_iter())
                        .map(|view| ViewFrames { view, values: Vec::new() })
                        .collect(),
                ),
                Domain::Time | Domain::Image => {
                    Framed::Slow(DecimatedSeries::empty(rate_hz, channels))
                }
            };
            let source = SourceFrames { data, duration_s: 0.0, rate_hz };
            SourceStream { source, channels, samples: 0, pending: vec![Vec::new(); VIEWS.len()] }
        });
        if stream.source.rate_hz != rate_hz {
            return Err(RecogniseError::Rates {
                source_name: id.clone(),
                query_hz: rate_hz,
                library_hz: stream.source.rate_hz,
                trial: self.key.to_string(),
            });
        }
        stream.push(series.samples());
        Ok(())
    }

    /// The trial so far. A source too short for a single frame is filled up with zeros.
    pub fn so_far(&self) -> FrameFeatures {
        let ready = self.sources.iter().map(|(id, stream)| (id.clone(), stream.so_far()));
        FrameFeatures { key: self.key.clone(), sources: ready.collect() }
    }
}

impl SourceStream {
    fn push(&mut self, samples: &[f32]) {
        self.samples += samples.len() / self.channels;
        self.source.duration_s = self.samples as f64 / self.source.rate_hz;
        let take = |pending: &mut Vec<f32>, used: &mut dyn FnMut(&[f32]) -> usize| {
            pending.extend_from_slice(samples);
            let done = used(pending) * self.channels;
            pending.drain(..done);
        };
        match &mut self.source.data {
            Framed::Bands(views) => (views.iter_mut().zip(&mut self.pending))
                .for_each(|(view, pending)| take(pending, &mut |new| view.extend(new))),
            Framed::Slow(series) => take(&mut self.pending[0], &mut |new| series.extend(new)),
            Framed::Pixels(_) => {}
        }
    }

    fn so_far(&self) -> SourceFrames {
        let mut source = self.source.clone();
        match &mut source.data {
            Framed::Bands(views) => {
                for (view, pending) in views.iter_mut().zip(&self.pending) {
                    if view.values.is_empty() {
                        view.pad(pending);
                    }
                }
            }
            Framed::Slow(series) if series.len() == 0 => series.average(&self.pending[0]),
            _ => {}
        }
        source
    }
}
