//! Gain, force, offset, saturation and coarse converters.

use super::setting::{Setting, analog, each_sample, each_series, to_sample};
use crate::trial::Trial;

/// Vibration grows as force to this power.
const FORCE_POWER: f64 = 0.7;

/// Every amplifier turned up by a factor.
pub fn gain(trial: &mut Trial, setting: &mut Setting<'_>) {
    each_sample(trial, setting, analog, |x, _, factor| factor * x);
}

/// A hand that presses harder by a factor: loads grow with it, vibrations less. Reflectance stays.
pub fn force(trial: &mut Trial, setting: &mut Setting<'_>) {
    each_series(trial, setting, analog, |spec, series, _, factor| {
        let gain = match spec.id.as_str() {
            "ir" => 1.0,
            "fr" => factor,
            _ => factor.powf(FORCE_POWER),
        };
        series.view_mut().mapv_inplace(|x| to_sample(gain * f64::from(x)));
    });
}

/// A constant, added: the level, in deviations of the channel.
pub fn offset(trial: &mut Trial, setting: &mut Setting<'_>) {
    each_sample(trial, setting, analog, |x, spread, level| x + level * spread.deviation);
}

/// Limits at a share of the largest magnitude about the mean.
pub fn saturation(trial: &mut Trial, setting: &mut Setting<'_>) {
    each_sample(trial, setting, analog, |x, spread, share| {
        let limit = share * (spread.peak - spread.mean.abs()).max(spread.deviation);
        spread.mean + (x - spread.mean).clamp(-limit, limit)
    });
}

/// A converter of so few bits, whose full scale is the channel's largest magnitude.
pub fn quantisation(trial: &mut Trial, setting: &mut Setting<'_>) {
    each_sample(trial, setting, analog, |x, spread, bits| {
        let step = 2.0 * spread.peak / bits.exp2();
        if step > 0.0 { (x / step).round() * step } else { x }
    });
}
