//! What disturbances are given, and what they share: which sources they touch, and how samples and
//! pictures are changed.

use rand_chacha::ChaCha8Rng;

use crate::scene::{Domain, Phase, Scene, SourceSpec};
use crate::trial::{Image, Series, Signal, Trial};

/// How a trial is disturbed.
pub struct Setting<'a> {
    /// How much, in the disturbance's own unit.
    pub level: f64,
    /// What the sources are.
    pub scene: &'a Scene,
    /// Belongs to this trial, disturbance and level.
    pub rng: ChaCha8Rng,
}

pub(super) fn any(_: &SourceSpec) -> bool {
    true
}

/// A series that is no switch.
pub(super) fn analog(spec: &SourceSpec) -> bool {
    spec.domain != Domain::Image && spec.sigma.is_none()
}

pub(super) fn sensed(spec: &SourceSpec) -> bool {
    spec.sigma.is_none()
}

pub(super) fn sound(spec: &SourceSpec) -> bool {
    spec.sensor == "microphone"
}

pub(super) fn drag(spec: &SourceSpec) -> bool {
    spec.phase == Phase::Drag
}

/// A series in time, whose samples T* is about.
pub(super) fn slow(spec: &SourceSpec) -> bool {
    spec.domain == Domain::Time && spec.sigma.is_none()
}

pub(super) fn many_channels(spec: &SourceSpec) -> bool {
    analog(spec) && spec.channels > 1
}

pub(super) fn is_picture(spec: &SourceSpec) -> bool {
    spec.domain == Domain::Image
}

/// Changes those series of a trial that a filter lets through.
pub(super) fn each_series(
    trial: &mut Trial,
    setting: &mut Setting<'_>,
    touches: fn(&SourceSpec) -> bool,
    mut change: impl FnMut(&SourceSpec, &mut Series, &mut ChaCha8Rng, f64),
) {
    for (id, signal) in &mut trial.signals {
        if let (Some(spec), Signal::Series(series)) = (setting.scene.get(id.as_str()), signal)
            && touches(spec)
        {
            change(spec, series, &mut setting.rng, setting.level);
        }
    }
}

/// Changes each sample of those series: `change` gets it and the channel's mean, deviation and
/// largest magnitude.
pub(super) fn each_sample(
    trial: &mut Trial,
    setting: &mut Setting<'_>,
    touches: fn(&SourceSpec) -> bool,
    change: impl Fn(f64, ChannelSpread, f64) -> f64,
) {
    each_series(trial, setting, touches, |_, series, _, level| {
        for channel in 0..series.channels() {
            let spread = ChannelSpread::of(series.channel(channel));
            for x in series.view_mut().column_mut(channel) {
                *x = to_sample(change(f64::from(*x), spread, level));
            }
        }
    });
}

/// Samples stay finite, whatever is done to them.
pub(super) fn to_sample(x: f64) -> f32 {
    x.clamp(f64::from(-f32::MAX), f64::from(f32::MAX)) as f32
}

/// Changes the pictures of a trial, given as RGB bytes.
pub(super) fn each_picture(trial: &mut Trial, change: impl Fn(&[u8]) -> Vec<u8>) {
    for signal in trial.signals.values_mut() {
        if let Signal::Image(image) = signal
            && let Ok(changed) = Image::new(Image::COLS, Image::ROWS, change(image.rgb()))
        {
            *image = changed;
        }
    }
}

/// A series with other frames of the same kind; unchanged if there are none.
pub(super) fn replace(series: &mut Series, samples: Vec<f32>) {
    if let Ok(changed) = Series::new(series.rate_hz(), series.channels(), samples) {
        *series = changed;
    }
}

/// Mean, deviation and largest magnitude of a channel.
#[derive(Clone, Copy)]
pub(super) struct ChannelSpread {
    pub(super) mean: f64,
    pub(super) deviation: f64,
    pub(super) peak: f64,
}

impl ChannelSpread {
    pub(super) fn of(values: impl ExactSizeIterator<Item = f64>) -> Self {
        let n = values.len() as f64;
        let (mut sum, mut squares, mut peak) = (0.0, 0.0, 0.0f64);
        for x in values {
            sum += x;
            squares += x * x;
            peak = peak.max(x.abs());
        }
        let mean = sum / n;
        Self { mean, deviation: (squares / n - mean * mean).max(0.0).sqrt(), peak }
    }
}
