//! Reads every recording of a library once, measures its series, and says what is usual among them.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use crate::evaluate::ProgressFn;
use crate::library::{Entry, Unreadable};
use crate::scene::{Scene, SourceId};
use crate::spectrum::amplitude_spectrum;
use crate::trial::{Doubt, Series, SeriesFlaws, Signal, Trial, flaws_of, level_of, usual_rests};

/// Most bytes of samples that are kept in memory, to save reading them again.
const MOST_KEPT: usize = 1 << 30;
/// Fewest trials that tell what is usual.
pub(super) const FEWEST: usize = 3;
/// A trial is too loud or quiet if ln of its loudness is at least this far from its surface's middle half: 20
/// dB.
const LOUD: f64 = std::f64::consts::LN_10;

/// One trial with its readable sources, and what was found in them.
pub(super) struct Inspected {
    /// The trial; its signals are kept in memory if there is room.
    pub entry: Entry,
    /// The faults of its sensors, judged by how long each channel rests in the whole library.
    pub doubts: Vec<Doubt>,
    /// The measurements of each series, except of switches such as the metal detector.
    pub series: BTreeMap<SourceId, Measured>,
}

#[derive(Default)]
pub(super) struct Measured {
    pub seconds: f64,
    /// ln of the root mean square, after the mean of each channel was subtracted.
    pub level: f64,
    pub rate_hz: f64,
    /// The frequency below which 95 % of the power lies.
    pub edge_hz: f64,
    pub is_constant: bool,
    /// For each channel, the largest share of the samples that rests at one value.
    pub rests: Vec<f32>,
}

/// Reads all trials. Returns the trials with a readable source, and the sources that cannot be read.
pub(super) fn inspect(
    entries: Vec<Entry>,
    scene: &Scene,
    progress: ProgressFn<'_>,
) -> (Vec<Inspected>, Vec<Unreadable>) {
    let (kept, done, all) = (AtomicUsize::new(0), AtomicUsize::new(0), entries.len());
    let one = |(at, entry): (usize, Entry)| {
        let inspected = of_entry(at, entry, scene, &kept);
        progress("reading all recordings", done.fetch_add(1, Ordering::Relaxed) + 1, all);
        inspected
    };
    let read: Vec<_> = entries.into_par_iter().enumerate().map(one).collect();
    let (mut inspected, unreadable): (Vec<_>, Vec<_>) = read.into_iter().unzip();
    inspected.retain(|trial: &Inspected| !trial.entry.sources.is_empty());
    forget_usual(&mut inspected);
    (inspected, unreadable.into_iter().flatten().collect())
}

fn of_entry(
    at: usize,
    mut entry: Entry,
    scene: &Scene,
    kept: &AtomicUsize,
) -> (Inspected, Vec<Unreadable>) {
    let (mut signals, mut unreadable) = (BTreeMap::new(), Vec::new());
    for source in &entry.sources {
        match entry.with_only(source).load() {
            Ok(trial) => signals.extend(trial.signals),
            Err(error) => unreadable.push(Unreadable { entry: at, source: source.clone(), error }),
        }
    }
    entry.sources.retain(|source| signals.contains_key(source));
    let (mut doubts, mut series) = (Vec::new(), BTreeMap::new());
    for (id, signal) in &signals {
        match signal {
            Signal::Image(_) => doubts.extend(flaws_of(id, signal, &[])),
            Signal::Series(one) if !scene.is_switch(id) => {
                let flaws = SeriesFlaws::of(one);
                doubts.extend(flaws.doubts(id, &[]));
                let measured = Measured {
                    seconds: one.duration_s(),
                    level: level_of(one),
                    rate_hz: one.rate_hz(),
                    edge_hz: edge_hz(one),
                    is_constant: one.is_constant(),
                    rests: flaws.rests(),
                };
                series.insert(id.clone(), measured);
            }
            Signal::Series(_) => {}
        }
    }
    let bytes: usize = signals.values().map(bytes).sum();
    if kept.fetch_add(bytes, Ordering::Relaxed) + bytes <= MOST_KEPT {
        let key = entry.key.clone();
        entry = entry.held(Arc::new(Trial { key, signals }));
    }
    (Inspected { entry, doubts, series }, unreadable)
}

fn bytes(signal: &Signal) -> usize {
    match signal {
        Signal::Series(series) => size_of_val(series.samples()),
        Signal::Image(image) => image.rgb().len(),
    }
}

/// Forgets doubts about channels that rest no longer than they usually do in the library.
fn forget_usual(inspected: &mut [Inspected]) {
    let mut of_trials: BTreeMap<&SourceId, Vec<&[f32]>> = BTreeMap::new();
    for (id, of) in inspected.iter().flat_map(|one| &one.series) {
        of_trials.entry(id).or_default().push(&of.rests);
    }
    let usual = |(id, rests): (&SourceId, Vec<&[f32]>)| (id.clone(), usual_rests(&rests));
    let usual: BTreeMap<SourceId, Vec<f32>> = of_trials.into_iter().map(usual).collect();
    for one in inspected {
        one.doubts.retain(|doubt| {
            let rests = doubt.source().and_then(|id| usual.get(id));
            !doubt.is_usual(rests.map_or(&[], Vec::as_slice))
        });
    }
}

/// The median of a measurement of a source, over the trials of one surface if one is given.
pub(super) fn usual<'i>(
    trials: impl Iterator<Item = &'i Inspected>,
    id: &SourceId,
    surface: Option<&str>,
    of: fn(&Measured) -> f64,
) -> Option<f64> {
    let those = trials.filter(|one| surface.is_none_or(|name| one.entry.key.surface == name));
    median(those.filter_map(|one| one.series.get(id).map(of)).collect())
}

/// Within what the levels of a surface lie, but for outliers, and their median between: their middle half, and on
/// either side 1.5 times its width (Tukey 1977, "Exploratory Data Analysis"), but at least [`LOUD`]. `None` if
/// there are fewer than [`FEWEST`].
pub(super) fn levels(inspected: &[Inspected], id: &SourceId, surface: &str) -> Option<[f64; 3]> {
    let of_surface = inspected.iter().filter(|one| one.entry.key.surface == surface);
    let mut all: Vec<f64> =
        of_surface.filter_map(|one| one.series.get(id).map(|of| of.level)).collect();
    if all.len() < FEWEST {
        return None;
    }
    all.sort_by(f64::total_cmp);
    let quarter = (all.len() / 4).max(1);
    let (low, high) = (all[quarter], all[all.len() - 1 - quarter]);
    let beyond = LOUD.max(1.5 * (high - low));
    Some([low - beyond, all[all.len() / 2], high + beyond])
}

/// The median; `None` if there are fewer than [`FEWEST`] values.
pub(super) fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    (values.len() >= FEWEST).then(|| values[values.len() / 2])
}

/// Most frames that the edge of a band is measured on.
const MOST_FRAMES: usize = 1 << 16;

/// The frequency in Hz below which 95 % of the power of a series' first channel lies, without its mean.
/// 0 for a constant.
fn edge_hz(series: &Series) -> f64 {
    let rate_hz = series.rate_hz();
    let first: Vec<f64> = series.channel(0).take(MOST_FRAMES).collect();
    let mean = first.iter().sum::<f64>() / first.len() as f64;
    let power = amplitude_spectrum(first.iter().map(|x| x - mean), rate_hz, (0.0, rate_hz / 2.0));
    let power: Vec<f64> = power.into_iter().map(|x| x * x).collect();
    let mut left = 0.05 * power.iter().sum::<f64>();
    let above = power.iter().rev().take_while(|&&x| {
        left -= x;
        left >= 0.0
    });
    let edge = power.len().saturating_sub(1 + above.count());
    if left < 0.0 { edge as f64 * rate_hz / first.len().next_power_of_two() as f64 } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_edge_of_a_band_is_that_of_its_fastest_strong_tone() {
        let series = |samples| Series::new(1024.0, 1, samples).unwrap();
        let wave = |hz: f64, i: usize| (i as f64 * hz * std::f64::consts::TAU / 1024.0).sin();
        let edge = |strength: f64| {
            let sample = |i| (3.0 + wave(50.0, i) + strength * wave(300.0, i)) as f32;
            edge_hz(&series((0..2048).map(sample).collect()))
        };
        assert_eq!((edge(0.5), edge(0.1)), (300.0, 50.0));
        assert_eq!(edge_hz(&series(vec![2.0; 64])), 0.0);
    }
}
