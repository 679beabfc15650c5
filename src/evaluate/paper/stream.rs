//! One source in one of the ways that the paper's tables compare it: a scene with that source alone.

use crate::library::Entry;
use crate::scene::{Colour, Domain, Scene};
use crate::trial::Signal;

/// How samples are drawn from a source.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum SampleView {
    /// Equidistant in time.
    Time,
    /// The same at the positions of the 10 kHz series, whatever the source's own rate: of a drag
    /// sound only the first 1.1 s is seen (the quirk of the DFT ablation, method.md §2).
    TimeOfSerial,
    /// Bins of the amplitude spectrum, in the source's band or from 0 to 1000 Hz.
    Spectrum,
    /// Pixels.
    Pixels(Colour),
}

/// Frames of the 10 kHz series in LMT108.
const SERIAL_FRAMES: usize = 48_000;
/// The band of sources that are not sampled in the spectrum otherwise: that of the haptic ones.
const BAND_HZ: (f64, f64) = (0.0, 1000.0);

/// A source, how it is sampled, and whether the query's mean is shifted (Eq. 8).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct SampledSource {
    /// The source.
    pub source: &'static str,
    /// How it is sampled.
    pub view: SampleView,
    /// Whether the shift is done.
    pub align: bool,
}

/// The eight sources as the paper uses them.
pub const AS_USED: [SampledSource; 8] = [
    SampledSource::new("ca1", SampleView::Pixels(Colour::Hsv), false),
    SampledSource::new("ca2", SampleView::Pixels(Colour::Hsv), false),
    SampledSource::new("mi1", SampleView::Spectrum, true),
    SampledSource::new("mi2", SampleView::Spectrum, true),
    SampledSource::new("ac", SampleView::Spectrum, true),
    SampledSource::new("fr", SampleView::Time, true),
    SampledSource::new("ir", SampleView::Time, true),
    SampledSource::new("me", SampleView::Time, false),
];

impl SampledSource {
    /// A stream from its parts.
    pub const fn new(source: &'static str, view: SampleView, align: bool) -> Self {
        Self { source, view, align }
    }

    /// The stream as the paper uses the source.
    ///
    /// # Panics
    /// If the paper has no such source.
    pub fn as_used(source: &str) -> Self {
        let found = AS_USED.iter().find(|stream| stream.source == source);
        *found.expect("one of the paper's eight sources")
    }

    /// The scene with this source alone, in this way; `None` if the scene does not know the source.
    pub fn scene(&self, base: &Scene) -> Option<Scene> {
        let id = base.get(self.source)?.id.clone();
        let scene = base.clone().only(&[id]).ok()?;
        Some(scene.changed(|spec| {
            spec.align_mean = self.align;
            spec.weight = 1.0;
            match self.view {
                SampleView::Time | SampleView::TimeOfSerial => spec.domain = Domain::Time,
                SampleView::Spectrum if matches!(spec.domain, Domain::Spectrum { .. }) => {}
                SampleView::Spectrum => spec.domain = Domain::Spectrum { band_hz: BAND_HZ },
                SampleView::Pixels(colour) => spec.colour = colour,
            }
        }))
    }

    /// The entry with this source alone, of the length that this way sees.
    pub fn entry(&self, entry: &Entry, scene: &Scene) -> Entry {
        let entry = entry.clone().within(scene);
        if self.view != SampleView::TimeOfSerial {
            return entry;
        }
        entry.changed(|mut trial| {
            for signal in trial.signals.values_mut() {
                if let Signal::Series(series) = signal {
                    *series = series.crop(0, SERIAL_FRAMES);
                }
            }
            trial
        })
    }
}
