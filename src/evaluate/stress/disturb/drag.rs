//! Drags that are not steady.

use super::setting::{Setting, drag, each_series, to_sample};
use crate::seed::uniform;
use crate::trial::Trial;

/// Slips a second.
const SLIPS_HZ: f64 = 5.0;
/// Length of a lift-off in s.
const LIFT_S: f64 = 0.1;
/// Share of every signal that remains in the air.
const IN_THE_AIR: f64 = 0.02;

/// The stylus sticks and slips five times a second: every signal of the drag swells and breaks off,
/// by the level, a share of its strength.
pub fn stick_slip(trial: &mut Trial, setting: &mut Setting<'_>) {
    each_series(trial, setting, drag, |spec, series, _, depth| {
        if spec.sigma.is_some() {
            return;
        }
        let rate_hz = series.rate_hz();
        for (i, mut row) in series.view_mut().rows_mut().into_iter().enumerate() {
            let phase = (i as f64 / rate_hz * SLIPS_HZ).fract();
            let gain = 1.0 - depth * (1.0 - phase);
            row.mapv_inplace(|x| to_sample(gain * f64::from(x)));
        }
    });
}

/// The stylus leaves the surface for 100 ms at a time, for a share of the drag, in all sources at
/// once.
pub fn lift_offs(trial: &mut Trial, setting: &mut Setting<'_>) {
    let seconds = trial.signals.values().map(|signal| match signal {
        crate::trial::Signal::Series(series) => series.duration_s(),
        crate::trial::Signal::Image(_) => 0.0,
    });
    let pieces = (seconds.fold(0.0, f64::max) / LIFT_S).ceil() as usize;
    let up: Vec<bool> = (0..pieces).map(|_| uniform(&mut setting.rng) < setting.level).collect();
    each_series(trial, setting, drag, |_, series, _, _| {
        let rate_hz = series.rate_hz();
        for (i, mut row) in series.view_mut().rows_mut().into_iter().enumerate() {
            let piece = (i as f64 / rate_hz / LIFT_S) as usize;
            if up.get(piece).copied().unwrap_or(false) {
                row.mapv_inplace(|x| to_sample(IN_THE_AIR * f64::from(x)));
            }
        }
    });
}
