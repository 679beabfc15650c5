//! Whether a scan is good enough to be kept.

use crate::duration::{OnlineDuration, OnlineSettings, SAMPLES, ScanNeed};
use crate::scan::Scan;
use crate::scene::{Scene, SourceId};
use crate::trial::{Flaw, Series, Signal, flaws};

/// Why a scan is no good trial, a line each. `by_t_star` are the sources of which it must hold
/// enough independent samples.
pub(super) fn faults(scan: &Scan, scene: &Scene, by_t_star: &[SourceId]) -> Vec<String> {
    let mut faults = scan.spoiled.clone();
    if scan.lost_samples > 0 && faults.is_empty() {
        faults.push(format!("samples were lost in it: {}", scan.lost_samples));
    }
    for (id, signal) in &scan.trial.signals {
        let Signal::Series(series) = signal else { continue };
        // A source with a fixed length scale is a switch, which has two values and rests.
        if scene.get(id.as_str()).is_some_and(|spec| spec.sigma.is_none()) {
            let clipped = |flaw: &&Flaw| matches!(flaw, Flaw::Saturated { .. });
            faults.extend(flaws(series).iter().filter(clipped).map(|flaw| format!("{id}: {flaw}")));
        }
        if by_t_star.contains(id) {
            faults.extend(too_short(id, series));
        }
    }
    faults
}

/// That a recording holds too few independent samples, by its own T*.
fn too_short(id: &SourceId, series: &Series) -> Option<String> {
    let held_s = series.duration_s();
    let settings =
        OnlineSettings { window_s: held_s, every_s: f64::INFINITY, ..OnlineSettings::default() };
    let mut online = OnlineDuration::new(series.rate_hz(), series.channels(), settings);
    online.push(series.samples()).ok()?;
    let estimate = online.estimate();
    let needed_s = match estimate.map(|estimate| estimate.t_star_s) {
        Some(Some(t_star_s)) => ScanNeed::new(t_star_s, SAMPLES).scan_s(),
        // It never changes, which no longer drag would mend.
        _ if series.is_constant() => return None,
        _ => f64::INFINITY,
    };
    if held_s >= needed_s {
        return None;
    }
    let take = match needed_s.is_finite() {
        true => format!("{SAMPLES} independent samples take {needed_s:.1} s here"),
        false => "no two samples in it are known to be independent".into(),
    };
    Some(format!("{id}: {held_s:.1} s is too short: {take}; drag longer, or move faster"))
}
