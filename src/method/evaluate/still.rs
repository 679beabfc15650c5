//! Finds channels that never move, as of a muted microphone or a broken cable: in a whole library, or on one
//! of its surfaces. No trial shows this alone, since a channel may rest for as long as it usually does.

use std::collections::BTreeMap;
use std::fmt;

use rayon::prelude::*;

use crate::library::Entry;
use crate::scene::{Scene, SourceId};
use crate::trial::{STEADY, SeriesFlaws, Signal};

/// Channels of a source that have one value in all trials.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Still {
    pub source: SourceId,
    /// Counted from 1.
    pub channels: Vec<usize>,
    /// The surface whose trials these are, if the channels move on other surfaces.
    pub surface: Option<String>,
}

impl fmt::Display for Still {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let channels: Vec<String> = self.channels.iter().map(ToString::to_string).collect();
        let (s, have) = if channels.len() == 1 { ("", "has") } else { ("s", "have") };
        let (of, too) = match &self.surface {
            Some(surface) => (format!(" of {surface}, and moves on others"), "; then record anew"),
            None => (String::new(), ""),
        };
        write!(
            f,
            "{}: channel{s} {} {have} one value in all trials{of}: check its cable, and whether it is \
             muted{too}",
            self.source,
            channels.join(", ")
        )
    }
}

/// The behaviour of a source's channels in the trials of one surface.
struct OfSurface<'a> {
    source: &'a SourceId,
    surface: &'a str,
    trials: usize,
    /// The value of each channel that has no other in any trial.
    values: Vec<Option<f32>>,
    /// For each channel, the largest share of the first trial that rests at one value.
    rests: Vec<f32>,
}

impl<'a> OfSurface<'a> {
    /// Reads trials up to the first one without a still channel: one, where all is well.
    fn read(((source, surface), trials): ((&'a SourceId, &'a str), Vec<&Entry>)) -> Option<Self> {
        let mut found: Option<Self> = None;
        for entry in &trials {
            let Ok(mut trial) = entry.with_only(source).load() else { continue };
            let Some(Signal::Series(series)) = trial.signals.remove(source) else { continue };
            let rests = SeriesFlaws::of(&series).rests();
            // Adding 0 turns -0 into 0, so that both count as one value.
            let value = |(rest, first): (&f32, &f32)| (*rest >= 1.0).then_some(first + 0.0);
            let values: Vec<Option<f32>> = rests.iter().zip(series.samples()).map(value).collect();
            let first =
                || Self { source, surface, trials: trials.len(), values: values.clone(), rests };
            let known = found.get_or_insert_with(first);
            for (known, value) in known.values.iter_mut().zip(&values) {
                *known = known.filter(|known| Some(*known) == *value);
            }
            if known.values.iter().all(Option::is_none) {
                break;
            }
        }
        found
    }

    fn value(&self, channel: usize) -> Option<f32> {
        self.values.get(channel).copied().flatten()
    }
}

/// The channels that never move in a library, and those that never move on a surface although they move
/// steadily on others. Switches may rest, such as the metal detector, and so may what has another value on
/// each surface, and what often rests.
pub fn still(entries: &[Entry], scene: &Scene) -> Vec<Still> {
    let mut of: BTreeMap<(&SourceId, &str), Vec<&Entry>> = BTreeMap::new();
    for entry in entries {
        for source in entry.sources.iter().filter(|id| !scene.is_switch(id)) {
            of.entry((source, &entry.key.surface)).or_default().push(entry);
        }
    }
    let all: Vec<OfSurface<'_>> = of.into_par_iter().filter_map(OfSurface::read).collect();
    all.chunk_by(|a, b| a.source == b.source).flat_map(of_source).collect()
}

fn of_source(surfaces: &[OfSurface<'_>]) -> Vec<Still> {
    let mut found: BTreeMap<Option<&str>, Vec<usize>> = BTreeMap::new();
    for channel in 0..surfaces[0].values.len() {
        let (still, moving): (Vec<&OfSurface<'_>>, Vec<&OfSurface<'_>>) =
            surfaces.iter().partition(|one| one.value(channel).is_some());
        let mut rests: Vec<f32> =
            moving.iter().filter_map(|one| one.rests.get(channel).copied()).collect();
        rests.sort_by(f32::total_cmp);
        let is_alike = || still.iter().all(|one| one.value(channel) == still[0].value(channel));
        match rests.get(rests.len() / 2) {
            None if is_alike() => found.entry(None).or_default().push(channel + 1),
            // One such trial alone has a doubt of its own.
            Some(rest) if *rest < STEADY => {
                for one in still.iter().filter(|one| one.trials > 1) {
                    found.entry(Some(one.surface)).or_default().push(channel + 1);
                }
            }
            _ => {}
        }
    }
    let source = surfaces[0].source;
    let one = |(surface, channels): (Option<&str>, _)| Still {
        source: source.clone(),
        channels,
        surface: surface.map(String::from),
    };
    found.into_iter().map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trial::{Series, Trial, TrialKey};

    /// The channels of source `x` that are still, where a function of surface, trial, channel and sample
    /// gives its values on three surfaces of three trials each.
    fn found(value: fn(&str, u32, usize, usize) -> f32) -> Vec<(Option<String>, Vec<usize>)> {
        let scene = "format = 1\n[sources.x]\ndomain = \"time\"\nrate_hz = 100\nchannels = 2\n";
        let scene = Scene::from_toml(scene).unwrap();
        let source = SourceId::new("x").unwrap();
        let entry = |surface: &str, n: u32| {
            let samples = (0..100).map(|at| value(surface, n, at % 2 + 1, at / 2)).collect();
            let series = Series::new(100.0, 2, samples).unwrap();
            let key = TrialKey::new(surface, "anna", n);
            Entry::in_memory(Trial::of_series(key, source.clone(), series))
        };
        let of = |surface| (1..=3).map(move |n| entry(surface, n));
        let entries: Vec<Entry> = ["a", "b", "c"].into_iter().flat_map(of).collect();
        still(&entries, &scene).into_iter().map(|one| (one.surface, one.channels)).collect()
    }

    #[test]
    fn a_channel_that_never_moves_is_found_in_a_library_and_on_a_surface() {
        let sound = found(|_, _, _, at| at as f32);
        assert!(sound.is_empty(), "{sound:?}");
        let muted = found(|_, _, channel, at| if channel == 2 { 0.0 } else { at as f32 });
        assert_eq!(muted, [(None, vec![2])]);
        assert_eq!(found(|_, _, _, _| 0.0), [(None, vec![1, 2])]);
        let on_a = found(|surface, _, _, at| if surface == "a" { 0.5 } else { at as f32 });
        assert_eq!(on_a, [(Some("a".into()), vec![1, 2])]);
        let once = found(|s, n, _, at| if s == "a" && n == 1 { 0.0 } else { at as f32 });
        assert!(once.is_empty(), "one broken trial is no still surface: {once:?}");
    }

    #[test]
    fn a_switch_and_what_often_rests_are_no_faults() {
        let switch = found(|surface, _, _, _| if surface == "a" { 1.0 } else { 0.0 });
        assert!(switch.is_empty(), "{switch:?}");
        // A taxel that is touched at times, and never on `a`.
        let taxel = found(|surface, _, _, at| f32::from(u8::from(surface != "a" && at % 10 == 0)));
        assert!(taxel.is_empty(), "{taxel:?}");
    }
}
