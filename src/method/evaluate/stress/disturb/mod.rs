//! Disturbances: pure functions of a trial, a severity and a seeded generator.
//!
//! The levels of each disturbance go from one that a good station sees now and then (first) to an
//! absurd one (last), so that levels of the same rank can be compared.

mod changes;

use std::collections::{BTreeMap, BTreeSet};

use rand_chacha::ChaCha8Rng;

use crate::library::Entry;
use crate::scene::{Domain, Phase, Scene, SourceId, SourceSpec};
use crate::seed::uniform;
use crate::trial::{Image, Series, Signal, Trial};

/// The description of a source that a disturbance touches; `None` for other sources.
pub(crate) type Touches<'a> = &'a dyn Fn(&SourceId) -> Option<&'a SourceSpec>;

/// How a disturbance changes what it touches in a query, or how it changes the library. The numbers
/// are levels.
#[derive(Clone, Copy)]
pub enum Kind {
    /// Changes each sample, given the spread of its channel.
    Samples(fn(f64, ChannelSpread, f64) -> f64),
    /// Adds noise, made for a number of frames at a rate, to each channel. The level is the ratio of the
    /// signal's deviation to the noise's, in dB.
    Noise(fn(&mut ChaCha8Rng, usize, f64) -> Vec<f64>),
    Series(fn(&SourceSpec, &mut Series, f64, &mut ChaCha8Rng)),
    /// Changes each picture, given as RGB bytes.
    Pictures(fn(&[u8], f64) -> Vec<u8>),
    Trial(fn(&mut Trial, Touches<'_>, f64, &mut ChaCha8Rng)),
    /// Changes the trials of a fold's library.
    Library(fn(Vec<Entry>, f64, &mut ChaCha8Rng) -> Vec<Entry>),
}

#[derive(Clone, Copy)]
pub struct Disturbance {
    /// Short name, as on the command line.
    pub name: &'static str,
    pub axis: &'static str,
    pub levels: &'static [f64],
    pub kind: Kind,
    pub touches: fn(&SourceSpec) -> bool,
}

const SOURCES: &str = "sources";

#[rustfmt::skip] // One line for each disturbance.
pub fn all() -> Vec<Disturbance> {
    use Kind::{Library, Noise, Pictures, Samples, Series, Trial};
    let one = |name, axis, levels, kind, touches| Disturbance { name, axis, levels, kind, touches };
    let any = |_: &SourceSpec| true;
    let drag = |spec: &SourceSpec| spec.phase == Phase::Drag;
    let sound = |spec: &SourceSpec| spec.sensor == "microphone";
    let picture = |spec: &SourceSpec| spec.domain == Domain::Image;
    // A switch, such as the metal detector, is no analog sensor.
    let sensed = |spec: &SourceSpec| !spec.is_switch();
    let analog = |spec: &SourceSpec| spec.domain != Domain::Image && !spec.is_switch();
    let in_time = |spec: &SourceSpec| matches!(spec.domain, Domain::Time { .. }) && !spec.is_switch();
    let many_channels =
        |spec: &SourceSpec| spec.domain != Domain::Image && !spec.is_switch() && spec.channels > 1;
    vec![
        one("white-noise", "SNR, dB", &[40.0, 30.0, 20.0, 10.0, 0.0], Noise(changes::white), analog),
        one("red-noise", "SNR, dB", &[40.0, 30.0, 20.0, 10.0, 0.0], Noise(changes::red), analog),
        one("room-noise", "sound over room, dB", &[30.0, 20.0, 10.0, 3.0, -10.0],
            Noise(changes::room), sound),
        one("gain", "factor", &[1.2, 1.5, 2.0, 4.0, 16.0], Samples(changes::gain), analog),
        one("force", "factor", &[1.2, 1.5, 2.0, 3.0, 6.0], Series(changes::force), analog),
        one("offset", "deviations", &[0.2, 1.0, 3.0, 10.0, 100.0], Samples(changes::offset), analog),
        one("saturation", "limit over peak", &[0.7, 0.4, 0.2, 0.1, 0.03],
            Samples(changes::saturation), analog),
        one("quantisation", "bits", &[12.0, 10.0, 8.0, 6.0, 3.0],
            Samples(changes::quantisation), analog),
        one("dropped-samples", "share", &[0.001, 0.01, 0.05, 0.2, 0.6],
            Series(changes::dropped), drag),
        one("gaps", "share, held", &[0.01, 0.05, 0.1, 0.3, 0.7], Series(changes::gaps), drag),
        one("clock-error", "%", &[0.1, 0.5, 2.0, 5.0, 20.0], Series(changes::clock), analog),
        one("short-scan", "s", &[2.0, 1.0, 0.5, 0.25, 0.05], Series(changes::short), drag),
        one("slow-hand", "times closer than T*", &[1.5, 2.0, 4.0, 8.0, 32.0],
            Series(changes::slow), in_time),
        one("dead-sensors", SOURCES, &[1.0, 2.0, 3.0, 4.0, 6.0], Trial(changes::dead), sensed),
        one("stuck-sensors", SOURCES, &[1.0, 2.0, 3.0, 4.0, 6.0], Trial(changes::stuck), analog),
        one("swapped-channels", "channels turned by", &[1.0, 2.0],
            Series(changes::swapped), many_channels),
        one("darkness", "light", &[0.9, 0.75, 0.5, 0.25, 0.05], Pictures(changes::dark), picture),
        one("white-balance", "red over blue", &[1.05, 1.1, 1.25, 1.5, 3.0],
            Pictures(changes::tint), picture),
        one("image-shift", "pixels", &[2.0, 8.0, 32.0, 80.0, 160.0],
            Pictures(changes::shift), picture),
        one("blur", "pixels", &[1.0, 2.0, 4.0, 10.0, 40.0], Pictures(changes::blur), picture),
        one("stick-slip", "depth", &[0.1, 0.3, 0.6, 0.9, 1.0], Series(changes::stick_slip), drag),
        one("lift-offs", "share of the drag", &[0.02, 0.05, 0.15, 0.4, 0.8],
            Trial(changes::lift_offs), drag),
        one("few-trials", "library trials a surface", &[7.0, 5.0, 3.0, 2.0, 1.0],
            Library(few), any),
        one("mislabelled", "share of the library", &[0.02, 0.05, 0.1, 0.2, 0.5],
            Library(mislabelled), any),
        one("twins", "difference of twins, % of pitch", &[10.0, 5.0, 2.0, 1.0, 0.3],
            Library(twins), any),
    ]
}

impl Disturbance {
    /// The disturbance of these sources; `None` if it changes none. Levels that count sources leave one
    /// alone.
    pub fn fitted(self, sources: &[&SourceSpec]) -> Option<Self> {
        let touched = sources.iter().filter(|spec| (self.touches)(spec)).count();
        let fits = |level: f64| touched > 0 && (self.axis != SOURCES || level < touched as f64);
        let possible = self.levels.iter().filter(|&&level| fits(level)).count();
        (possible > 0).then(|| Self { levels: &self.levels[..possible], ..self })
    }

    /// A query at a level of this disturbance; unchanged by a disturbance of the library.
    pub fn disturbed(
        &self,
        trial: &Trial,
        level: f64,
        scene: &Scene,
        mut rng: ChaCha8Rng,
    ) -> Trial {
        let mut trial = trial.clone();
        let touches = |id: &SourceId| scene.get(id.as_str()).filter(|spec| (self.touches)(spec));
        if let Kind::Trial(change) = self.kind {
            change(&mut trial, &touches, level, &mut rng);
        }
        for (id, signal) in &mut trial.signals {
            let Some(spec) = touches(id) else { continue };
            match (self.kind, signal) {
                (Kind::Samples(change), Signal::Series(series)) => {
                    for channel in 0..series.channels() {
                        let spread = ChannelSpread::of(series.channel(channel));
                        for x in series.view_mut().column_mut(channel) {
                            *x = to_sample(change(f64::from(*x), spread, level));
                        }
                    }
                }
                (Kind::Noise(make), Signal::Series(series)) => {
                    changes::add(series, level, &mut rng, make);
                }
                (Kind::Series(change), Signal::Series(series)) => {
                    change(spec, series, level, &mut rng);
                }
                (Kind::Pictures(change), Signal::Image(image)) => {
                    change_picture(image, |rgb| change(rgb, level));
                }
                _ => {}
            }
        }
        trial
    }
}

fn to_sample(x: f64) -> f32 {
    x.clamp(f64::from(-f32::MAX), f64::from(f32::MAX)) as f32
}

/// Changes a picture; `change` gets and returns RGB bytes.
fn change_picture(image: &mut Image, change: impl Fn(&[u8]) -> Vec<u8>) {
    if let Ok(changed) = Image::new(Image::COLS, Image::ROWS, change(image.rgb())) {
        *image = changed;
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
pub struct ChannelSpread {
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

/// Keeps at most `most` trials of each surface, picked at random, in the order of the library.
pub(crate) fn few(library: Vec<Entry>, most: f64, rng: &mut ChaCha8Rng) -> Vec<Entry> {
    let mut drawn: Vec<(f64, usize)> = (0..library.len()).map(|at| (uniform(rng), at)).collect();
    drawn.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    drawn.retain(|&(_, at)| {
        let count = counts.entry(&library[at].key.surface).or_default();
        *count += 1;
        *count as f64 <= most
    });
    drawn.sort_by_key(|&(_, at)| at);
    drawn.into_iter().map(|(_, at)| library[at].clone()).collect()
}

/// Gives about a `share` of the trials the name of another surface.
pub(crate) fn mislabelled(mut library: Vec<Entry>, share: f64, rng: &mut ChaCha8Rng) -> Vec<Entry> {
    let surfaces: BTreeSet<String> = library.iter().map(|e| e.key.surface.clone()).collect();
    let surfaces: Vec<String> = surfaces.into_iter().collect();
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
pub(crate) fn twins(mut library: Vec<Entry>, percent: f64, _: &mut ChaCha8Rng) -> Vec<Entry> {
    let twin = |entry: &Entry| {
        let mut twin = entry.clone().changed(move |mut trial: Trial| {
            for signal in trial.signals.values_mut() {
                if let Signal::Series(series) = signal {
                    changes::stretch(series, 1.0 + percent / 100.0);
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
    use super::*;
    use crate::dataset::synth::{self, Parameters};
    use crate::seed;
    use crate::trial::TrialKey;

    fn trial() -> Trial {
        let (surfaces, trials, users) = (1, 1, 0);
        let small = Parameters { surfaces, trials, users, drag_seconds: 1.0, ..Default::default() };
        synth::library(&small).entries[0].load().unwrap()
    }

    fn disturbed(d: &Disturbance, level: f64, trial: &Trial) -> Trial {
        d.disturbed(trial, level, &Scene::lmt108(), seed::rng(1, &[b"test"]))
    }

    fn named(name: &str) -> Disturbance {
        all().into_iter().find(|d| d.name == name).unwrap()
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
    fn every_level_changes_what_it_touches_and_nothing_else_and_leaves_finite_samples() {
        let (trial, scene) = (trial(), Scene::lmt108());
        for d in all().into_iter().filter(|d| !matches!(d.kind, Kind::Library(_))) {
            for &level in d.levels {
                let after = disturbed(&d, level, &trial);
                assert_eq!(after, disturbed(&d, level, &trial), "{}: seeded", d.name);
                let mut changed = 0;
                for (id, signal) in &trial.signals {
                    let spec = scene.get(id.as_str()).unwrap();
                    let touched = (d.touches)(spec);
                    assert!(touched || after.signals[id] == *signal, "{} changed {id}", d.name);
                    if let Signal::Series(series) = &after.signals[id] {
                        assert!(series.samples().iter().all(|x| x.is_finite()), "{} {id}", d.name);
                        assert_eq!(series.channels(), spec.channels);
                    }
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
    fn white_noise_has_the_level_that_it_says() {
        let trial = trial();
        let after = disturbed(&named("white-noise"), 20.0, &trial);
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
        let trial = trial();
        for (level, expected) in [(1.0, 1), (3.0, 3), (99.0, 7)] {
            let after = disturbed(&named("dead-sensors"), level, &trial);
            let dead = trial.signals.iter().filter(|(id, s)| after.signals[*id] != **s).count();
            // The metal detector is never picked, since it is a switch.
            assert!(dead == expected, "{dead} of {expected}");
        }
    }

    #[test]
    fn no_level_makes_more_sensors_dead_than_leaves_one() {
        let scene = Scene::lmt108();
        let of = |ids: &[&str]| {
            let held: Vec<&SourceSpec> =
                scene.sources().filter(|spec| ids.contains(&spec.id.as_str())).collect();
            named("dead-sensors").fitted(&held).map(|d| d.levels.to_vec())
        };
        assert_eq!(of(&["ir"]), None);
        assert_eq!(of(&["ir", "mi2"]), Some(vec![1.0]));
        assert_eq!(of(&["ir", "mi2", "ac", "ca1"]), Some(vec![1.0, 2.0, 3.0]));
    }

    fn library() -> Vec<Entry> {
        let entry = |(surface, number): (&str, u32)| {
            let series = Series::new(10.0, 1, vec![1.0, 2.0, 3.0, number as f32]).unwrap();
            let key = TrialKey::new(surface, "expert", number);
            Entry::in_memory(Trial::of_series(key, SourceId::new("ir").unwrap(), series))
        };
        ["a", "b", "c"].into_iter().flat_map(|s| (1..=10).map(move |n| (s, n))).map(entry).collect()
    }

    #[test]
    fn libraries_get_smaller_wrong_or_double() {
        let rng = || seed::rng(1, &[b"library"]);
        let few = super::few(library(), 2.0, &mut rng());
        assert_eq!(few.len(), 6);
        let keys = |library: &[Entry]| library.iter().map(|e| e.key.clone()).collect::<Vec<_>>();
        let all = super::few(library(), 10.0, &mut rng());
        assert_eq!(keys(&all), keys(&library()), "a library that is small enough stays in order");
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
