//! Disturbances: pure functions of a trial, a severity and a seeded generator.
//!
//! The levels of each disturbance go from one that a good station sees now and then (first) to an
//! absurd one (last), so that levels of the same rank can be compared.

mod trial;

use std::collections::BTreeMap;

use rand_chacha::ChaCha8Rng;

use crate::library::Entry;
use crate::scene::{Domain, Phase, Scene, SourceSpec};
use crate::seed::uniform;
use crate::trial::{Image, Series, Signal, Trial};

/// The side that a disturbance changes: queries or the library.
#[derive(Clone, Copy)]
pub enum Kind {
    Query(fn(&mut Trial, &mut Setting<'_>)),
    Library(LibraryChange),
}

/// A disturbance, and the severities at which it is applied.
#[derive(Clone, Copy)]
pub struct Disturbance {
    /// Short name, as on the command line.
    pub name: &'static str,
    pub axis: &'static str,
    pub levels: &'static [f64],
    pub kind: Kind,
    pub touches: fn(&SourceSpec) -> bool,
    /// The disturbance makes sense only if it touches at least this many sources.
    pub fewest: usize,
}

#[rustfmt::skip] // One line for each disturbance.
pub fn all() -> Vec<Disturbance> {
    let query = |name, axis, levels, change, touches| {
        Disturbance { name, axis, levels, kind: Kind::Query(change), touches, fewest: 1 }
    };
    let of_library = |name, axis, levels, change| {
        Disturbance { name, axis, levels, kind: Kind::Library(change), touches: any, fewest: 1 }
    };
    let several = |disturbance: Disturbance| Disturbance { fewest: 2, ..disturbance };
    vec![
        query("white-noise", "SNR, dB", &[40.0, 30.0, 20.0, 10.0, 0.0], trial::white, analog),
        query("red-noise", "SNR, dB", &[40.0, 30.0, 20.0, 10.0, 0.0], trial::red, analog),
        query("room-noise", "sound over room, dB", &[30.0, 20.0, 10.0, 3.0, -10.0],
            trial::room, sound),
        query("gain", "factor", &[1.2, 1.5, 2.0, 4.0, 16.0], trial::gain, analog),
        query("force", "factor", &[1.2, 1.5, 2.0, 3.0, 6.0], trial::force, analog),
        query("offset", "deviations", &[0.2, 1.0, 3.0, 10.0, 100.0], trial::offset, analog),
        query("saturation", "limit over peak", &[0.7, 0.4, 0.2, 0.1, 0.03],
            trial::saturation, analog),
        query("quantisation", "bits", &[12.0, 10.0, 8.0, 6.0, 3.0], trial::quantisation, analog),
        query("dropped-samples", "share", &[0.001, 0.01, 0.05, 0.2, 0.6], trial::dropped, drag),
        query("gaps", "share, held", &[0.01, 0.05, 0.1, 0.3, 0.7], trial::gaps, drag),
        query("clock-error", "%", &[0.1, 0.5, 2.0, 5.0, 20.0], trial::clock, analog),
        query("short-scan", "s", &[2.0, 1.0, 0.5, 0.25, 0.05], trial::short, drag),
        query("slow-hand", "times closer than T*", &[1.5, 2.0, 4.0, 8.0, 32.0], trial::slow, slow),
        several(query("dead-sensors", "sources", &[1.0, 2.0, 3.0, 4.0, 6.0], trial::dead, sensed)),
        several(query("stuck-sensors", "sources", &[1.0, 2.0, 3.0, 4.0, 6.0],
            trial::stuck, analog)),
        query("swapped-channels", "channels turned by", &[1.0, 2.0], trial::swapped, many_channels),
        query("darkness", "light", &[0.9, 0.75, 0.5, 0.25, 0.05], trial::dark, is_picture),
        query("white-balance", "red over blue", &[1.05, 1.1, 1.25, 1.5, 3.0],
            trial::tint, is_picture),
        query("image-shift", "pixels", &[2.0, 8.0, 32.0, 80.0, 160.0], trial::shift, is_picture),
        query("blur", "pixels", &[1.0, 2.0, 4.0, 10.0, 40.0], trial::blur, is_picture),
        query("stick-slip", "depth", &[0.1, 0.3, 0.6, 0.9, 1.0], trial::stick_slip, drag),
        query("lift-offs", "share of the drag", &[0.02, 0.05, 0.15, 0.4, 0.8],
            trial::lift_offs, drag),
        of_library("few-trials", "library trials a surface", &[7.0, 5.0, 3.0, 2.0, 1.0], few),
        of_library("mislabelled", "share of the library", &[0.02, 0.05, 0.1, 0.2, 0.5],
            mislabelled),
        of_library("twins", "difference of twins, % of pitch", &[10.0, 5.0, 2.0, 1.0, 0.3], twins),
    ]
}

impl Disturbance {
    /// Whether the disturbance changes at least [`Self::fewest`] of these sources.
    pub fn fits(&self, sources: &[&SourceSpec]) -> bool {
        sources.iter().filter(|spec| (self.touches)(spec)).count() >= self.fewest
    }
}

pub struct Setting<'a> {
    pub level: f64,
    pub scene: &'a Scene,
    /// A random generator, seeded for this trial, disturbance and level.
    pub rng: ChaCha8Rng,
}

fn any(_: &SourceSpec) -> bool {
    true
}

/// Whether a source is a series of an analog sensor, not of a switch such as the metal detector.
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

/// Whether a source is analog, and is compared as a series in time.
fn slow(spec: &SourceSpec) -> bool {
    matches!(spec.domain, Domain::Time { .. }) && spec.sigma.is_none()
}

fn many_channels(spec: &SourceSpec) -> bool {
    analog(spec) && spec.channels > 1
}

fn is_picture(spec: &SourceSpec) -> bool {
    spec.domain == Domain::Image
}

/// Calls `change`, with the generator and the level, for each series if `touches` accepts its source.
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

/// Changes each sample of the series that `touches` accepts. `change` gets the sample, the mean,
/// deviation and peak of its channel, and the level.
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

/// Changes a library by a level. The generator is seeded for this disturbance, level and fold.
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

/// Gives about a `share` of the trials the name of another surface.
pub fn mislabelled(mut library: Vec<Entry>, share: f64, rng: &mut ChaCha8Rng) -> Vec<Entry> {
    let mut surfaces: Vec<String> = library.iter().map(|e| e.key.surface.clone()).collect();
    surfaces.sort();
    surfaces.dedup();
    for (at, entry) in library.iter_mut().enumerate() {
        if uniform(rng) < share {
            let own = surfaces.partition_point(|surface| *surface < entry.key.surface);
            let by = 1 + (uniform(rng) * (surfaces.len() - 1) as f64) as usize;
            entry.key.surface = surfaces[(own + by) % surfaces.len()].clone();
            // The number changes, since the other surface may have a trial of the same number.
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
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::dataset::synth::{self, Parameters};
    use crate::scene::SourceId;
    use crate::seed;
    use crate::trial::TrialKey;

    fn trial() -> Trial {
        let small = Parameters {
            surfaces: 1,
            trials: 1,
            users: 0,
            drag_seconds: 1.0,
            ..Default::default()
        };
        synth::library(&small).entries[0].load().unwrap()
    }

    fn disturbed(d: &Disturbance, level: f64, trial: &Trial, scene: &Scene, seed: u64) -> Trial {
        let Kind::Query(change) = d.kind else { panic!("{} is for the library", d.name) };
        let mut trial = trial.clone();
        change(&mut trial, &mut Setting { level, scene, rng: seed::rng(seed, &[b"test"]) });
        trial
    }

    fn of_queries() -> Vec<Disturbance> {
        all().into_iter().filter(|d| matches!(d.kind, Kind::Query(_))).collect()
    }

    #[test]
    fn names_are_distinct_and_axes_run_one_way() {
        let all = all();
        assert_eq!(all.iter().map(|d| d.name).collect::<BTreeSet<_>>().len(), all.len());
        for d in all {
            let rising = d.levels.is_sorted_by(|a, b| a < b);
            assert!(rising || d.levels.is_sorted_by(|a, b| a > b), "{}", d.name);
        }
    }

    #[test]
    fn every_level_changes_what_it_touches_and_nothing_else() {
        let (trial, scene) = (trial(), Scene::lmt108());
        for d in of_queries() {
            for &level in d.levels {
                let after = disturbed(&d, level, &trial, &scene, 1);
                assert_eq!(after, disturbed(&d, level, &trial, &scene, 1), "{}: seeded", d.name);
                let mut changed = 0;
                for (id, signal) in &trial.signals {
                    let touched = (d.touches)(scene.get(id.as_str()).unwrap());
                    assert!(touched || after.signals[id] == *signal, "{} changed {id}", d.name);
                    changed += usize::from(after.signals[id] != *signal);
                }
                // Cutting to a second or more leaves this drag of 1 s as it is, and rare lift-offs and
                // gaps may by chance not occur.
                let may_rest = ["short-scan", "lift-offs", "gaps"].contains(&d.name);
                assert!(changed > 0 || may_rest, "{} at {level}", d.name);
            }
        }
    }

    #[test]
    fn the_most_absurd_level_leaves_finite_samples_of_the_same_kind() {
        let (trial, scene) = (trial(), Scene::lmt108());
        for d in of_queries() {
            let after = disturbed(&d, *d.levels.last().unwrap(), &trial, &scene, 2);
            for (id, signal) in &after.signals {
                let Signal::Series(series) = signal else { continue };
                assert!(series.samples().iter().all(|x| x.is_finite()), "{} {id}", d.name);
                assert_eq!(series.channels(), scene.get(id.as_str()).unwrap().channels);
            }
        }
    }

    #[test]
    fn white_noise_has_the_level_that_it_says() {
        let d = all().into_iter().find(|d| d.name == "white-noise").unwrap();
        let (trial, scene) = (trial(), Scene::lmt108());
        let after = disturbed(&d, 20.0, &trial, &scene, 3);
        let (Signal::Series(a), Signal::Series(b)) = (&trial.signals["mi2"], &after.signals["mi2"])
        else {
            panic!("sound is a series");
        };
        let noise: Vec<f64> = a.channel(0).zip(b.channel(0)).map(|(a, b)| b - a).collect();
        let ratio = ChannelSpread::of(a.channel(0)).deviation
            / ChannelSpread::of(noise.into_iter()).deviation;
        assert!((20.0 * ratio.log10() - 20.0).abs() < 0.1, "{ratio}");
    }

    #[test]
    fn the_given_number_of_sensors_is_dead_and_one_is_left() {
        let d = all().into_iter().find(|d| d.name == "dead-sensors").unwrap();
        let (trial, scene) = (trial(), Scene::lmt108());
        for (level, expected) in [(1.0, 1), (3.0, 3), (99.0, 7)] {
            let after = disturbed(&d, level, &trial, &scene, 4);
            let dead = trial.signals.iter().filter(|(id, s)| after.signals[*id] != **s).count();
            // The metal detector is never picked, since it is a switch.
            assert!(dead == expected, "{dead} of {expected}");
        }
    }

    fn library() -> Vec<Entry> {
        let entry = |(surface, number): (&str, u32)| {
            let series = Series::new(10.0, 1, vec![1.0, 2.0, 3.0, number as f32]).unwrap();
            let signals = BTreeMap::from([(SourceId::new("ir").unwrap(), Signal::Series(series))]);
            let key = TrialKey::new(surface, "expert", number);
            Entry::in_memory(Trial { key, signals })
        };
        ["a", "b", "c"].into_iter().flat_map(|s| (1..=10).map(move |n| (s, n))).map(entry).collect()
    }

    #[test]
    fn libraries_get_smaller_wrong_or_double() {
        let rng = || seed::rng(1, &[b"library"]);
        let few = super::few(library(), 2.0, &mut rng());
        assert_eq!(few.len(), 6);
        let wrong = super::mislabelled(library(), 0.5, &mut rng());
        let moved =
            wrong.iter().zip(library()).filter(|(a, b)| a.key.surface != b.key.surface).count();
        assert!((8..23).contains(&moved), "{moved}");
        let keys: BTreeSet<_> = wrong.iter().map(|e| e.key.clone()).collect();
        assert_eq!(keys.len(), wrong.len(), "no trial is there twice");
        let twins = super::twins(library(), 10.0, &mut rng());
        assert_eq!(twins.len(), 60);
        assert_ne!(twins[30].load().unwrap().signals, twins[0].load().unwrap().signals);
    }
}
