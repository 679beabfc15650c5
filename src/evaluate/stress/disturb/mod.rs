//! Disturbances: pure functions of a trial, a severity and a seeded generator.
//!
//! The levels of each disturbance go from what a good station sees now and then (first), through a
//! bad day, to the absurd (last), so that levels of the same rank can be compared.

mod trial;

use std::collections::BTreeMap;

use rand_chacha::ChaCha8Rng;

use crate::library::Entry;
use crate::scene::{Domain, Phase, Scene, SourceSpec};
use crate::seed::uniform;
use crate::trial::{Image, Series, Signal, Trial};

/// What a disturbance changes: queries or the library.
#[derive(Clone, Copy)]
pub enum Kind {
    Query(fn(&mut Trial, &mut Setting<'_>)),
    Library(LibraryChange),
}

/// A disturbance with its axis of severities.
#[derive(Clone, Copy)]
pub struct Disturbance {
    /// Short name, as in options.
    pub name: &'static str,
    /// The quantity and unit of the levels.
    pub axis: &'static str,
    pub levels: &'static [f64],
    pub kind: Kind,
    /// Whether the disturbance changes a source.
    pub touches: fn(&SourceSpec) -> bool,
    /// The disturbance makes sense only with this number of such sources or more.
    pub fewest: usize,
}

pub fn all() -> Vec<Disturbance> {
    let query = |name, axis, levels, change, touches| Disturbance {
        name,
        axis,
        levels,
        kind: Kind::Query(change),
        touches,
        fewest: 1,
    };
    let of_library = |name, axis, levels, change| Disturbance {
        name,
        axis,
        levels,
        kind: Kind::Library(change),
        touches: any,
        fewest: 1,
    };
    let several = |disturbance: Disturbance| Disturbance { fewest: 2, ..disturbance };
    vec![
        query("white-noise", "SNR, dB", &[40.0, 30.0, 20.0, 10.0, 0.0], trial::white, analog),
        query("red-noise", "SNR, dB", &[40.0, 30.0, 20.0, 10.0, 0.0], trial::red, analog),
        query(
            "room-noise",
            "sound over room, dB",
            &[30.0, 20.0, 10.0, 3.0, -10.0],
            trial::room,
            sound,
        ),
        query("gain", "factor", &[1.2, 1.5, 2.0, 4.0, 16.0], trial::gain, analog),
        query("force", "factor", &[1.2, 1.5, 2.0, 3.0, 6.0], trial::force, analog),
        query("offset", "deviations", &[0.2, 1.0, 3.0, 10.0, 100.0], trial::offset, analog),
        query(
            "saturation",
            "limit over peak",
            &[0.7, 0.4, 0.2, 0.1, 0.03],
            trial::saturation,
            analog,
        ),
        query("quantisation", "bits", &[12.0, 10.0, 8.0, 6.0, 3.0], trial::quantisation, analog),
        query("dropped-samples", "share", &[0.001, 0.01, 0.05, 0.2, 0.6], trial::dropped, drag),
        query("gaps", "share, held", &[0.01, 0.05, 0.1, 0.3, 0.7], trial::gaps, drag),
        query("clock-error", "%", &[0.1, 0.5, 2.0, 5.0, 20.0], trial::clock, analog),
        query("short-scan", "s", &[2.0, 1.0, 0.5, 0.25, 0.05], trial::short, drag),
        query("slow-hand", "times closer than T*", &[1.5, 2.0, 4.0, 8.0, 32.0], trial::slow, slow),
        several(query("dead-sensors", "sources", &[1.0, 2.0, 3.0, 4.0, 6.0], trial::dead, sensed)),
        several(query(
            "stuck-sensors",
            "sources",
            &[1.0, 2.0, 3.0, 4.0, 6.0],
            trial::stuck,
            analog,
        )),
        query("swapped-channels", "channels turned by", &[1.0, 2.0], trial::swapped, many_channels),
        query("darkness", "light", &[0.9, 0.75, 0.5, 0.25, 0.05], trial::dark, is_picture),
        query(
            "white-balance",
            "red over blue",
            &[1.05, 1.1, 1.25, 1.5, 3.0],
            trial::tint,
            is_picture,
        ),
        query("image-shift", "pixels", &[2.0, 8.0, 32.0, 80.0, 160.0], trial::shift, is_picture),
        query("blur", "pixels", &[1.0, 2.0, 4.0, 10.0, 40.0], trial::blur, is_picture),
        query("stick-slip", "depth", &[0.1, 0.3, 0.6, 0.9, 1.0], trial::stick_slip, drag),
        query(
            "lift-offs",
            "share of the drag",
            &[0.02, 0.05, 0.15, 0.4, 0.8],
            trial::lift_offs,
            drag,
        ),
        of_library("few-trials", "library trials a surface", &[7.0, 5.0, 3.0, 2.0, 1.0], few),
        of_library(
            "mislabelled",
            "share of the library",
            &[0.02, 0.05, 0.1, 0.2, 0.5],
            mislabelled,
        ),
        of_library("twins", "difference of twins, % of pitch", &[10.0, 5.0, 2.0, 1.0, 0.3], twins),
    ]
}

impl Disturbance {
    /// Whether enough of these sources are changed by the disturbance.
    pub fn fits(&self, sources: &[&SourceSpec]) -> bool {
        sources.iter().filter(|spec| (self.touches)(spec)).count() >= self.fewest
    }
}

pub struct Setting<'a> {
    pub level: f64,
    pub scene: &'a Scene,
    /// Generator for this trial, disturbance and level alone.
    pub rng: ChaCha8Rng,
}

fn any(_: &SourceSpec) -> bool {
    true
}

/// A series of an analog sensor, not of a switch such as the metal detector.
fn analog(spec: &SourceSpec) -> bool {
    spec.domain != Domain::Image && spec.sigma.is_none()
}

fn sensed(spec: &SourceSpec) -> bool {
    spec.sigma.is_none()
}

fn sound(spec: &SourceSpec) -> bool {
    spec.sensor == "microphone"
}

fn drag(spec: &SourceSpec) -> bool {
    spec.phase == Phase::Drag
}

/// An analog source compared as a series in time.
fn slow(spec: &SourceSpec) -> bool {
    matches!(spec.domain, Domain::Time { .. }) && spec.sigma.is_none()
}

fn many_channels(spec: &SourceSpec) -> bool {
    analog(spec) && spec.channels > 1
}

fn is_picture(spec: &SourceSpec) -> bool {
    spec.domain == Domain::Image
}

/// Changes the series of a trial whose sources `touches` accepts.
fn each_series(
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

/// Changes each sample of such series: `change` gets the sample, its channel's spread, the level.
fn each_sample(
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

/// Converts to f32 and keeps the sample finite.
fn to_sample(x: f64) -> f32 {
    x.clamp(f64::from(-f32::MAX), f64::from(f32::MAX)) as f32
}

/// Changes the pictures of a trial; `change` gets and returns RGB bytes.
fn each_picture(trial: &mut Trial, change: impl Fn(&[u8]) -> Vec<u8>) {
    for signal in trial.signals.values_mut() {
        if let Signal::Image(image) = signal
            && let Ok(changed) = Image::new(Image::COLS, Image::ROWS, change(image.rgb()))
        {
            *image = changed;
        }
    }
}

/// Replaces the frames of a series; leaves it unchanged if `samples` do not make a series.
fn replace(series: &mut Series, samples: Vec<f32>) {
    if let Ok(changed) = Series::new(series.rate_hz(), series.channels(), samples) {
        *series = changed;
    }
}

/// Mean, deviation and largest magnitude of a channel.
#[derive(Clone, Copy)]
struct ChannelSpread {
    mean: f64,
    deviation: f64,
    peak: f64,
}

impl ChannelSpread {
    fn of(values: impl ExactSizeIterator<Item = f64>) -> Self {
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

/// Changes a library by a level; the generator is for this disturbance, level and fold alone.
pub type LibraryChange = fn(Vec<Entry>, f64, &mut ChaCha8Rng) -> Vec<Entry>;

/// Keeps at most `most` trials of each surface, picked at random.
pub fn few(library: Vec<Entry>, most: f64, rng: &mut ChaCha8Rng) -> Vec<Entry> {
    let mut drawn: Vec<(f64, Entry)> =
        library.into_iter().map(|entry| (uniform(rng), entry)).collect();
    drawn.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut kept: BTreeMap<String, usize> = BTreeMap::new();
    drawn.retain(|(_, entry)| {
        let count = kept.entry(entry.key.surface.clone()).or_insert(0);
        *count += 1;
        *count as f64 <= most
    });
    drawn.into_iter().map(|(_, entry)| entry).collect()
}

/// Gives about a share of the trials the name of another surface.
pub fn mislabelled(mut library: Vec<Entry>, share: f64, rng: &mut ChaCha8Rng) -> Vec<Entry> {
    let mut surfaces: Vec<String> = library.iter().map(|e| e.key.surface.clone()).collect();
    surfaces.sort();
    surfaces.dedup();
    for (at, entry) in library.iter_mut().enumerate() {
        if uniform(rng) < share {
            let own = surfaces.partition_point(|surface| *surface < entry.key.surface);
            let by = 1 + (uniform(rng) * (surfaces.len() - 1) as f64) as usize;
            entry.key.surface = surfaces[(own + by) % surfaces.len()].clone();
            // That surface may have a trial of the same number.
            entry.key.number += 1000 * (at as u32 + 1);
        }
    }
    library
}

/// Adds a twin of every surface: the surface's own trials at a pitch `percent` % higher.
pub fn twins(mut library: Vec<Entry>, percent: f64, _: &mut ChaCha8Rng) -> Vec<Entry> {
    let twin = |entry: &Entry| {
        let mut twin = entry.clone().changed(move |mut trial: Trial| {
            for signal in trial.signals.values_mut() {
                if let Signal::Series(series) = signal {
                    trial::stretch(series, 1.0 + percent / 100.0);
                }
            }
            trial
        });
        twin.key.surface.push_str(" (twin)");
        twin
    };
    let all: Vec<Entry> = library.iter().map(twin).collect();
    library.extend(all);
    library
}

#[cfg(test)]
mod tests;
