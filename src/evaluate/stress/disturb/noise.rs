//! Noise of the sensors and of the room.

use std::f64::consts::TAU;

use rand_chacha::ChaCha8Rng;

use super::setting::{ChannelSpread, Setting, analog, each_series, sound, to_sample};
use crate::seed::{nearly_normal, uniform};
use crate::trial::{Series, Trial};

/// Corner of red noise in Hz: above, its amplitude falls as 1/f.
const CORNER_HZ: f64 = 50.0;
/// Syllables a second: speech and machines come and go at this rate.
const SYLLABLES_HZ: f64 = 4.0;
/// Hum of the mains and its harmonics in Hz.
const HUM_HZ: [f64; 3] = [50.0, 100.0, 150.0];
/// Power of the hum in the room's.
const HUM_SHARE: f64 = 0.2;

/// White noise; the level is the ratio of the signal's deviation to the noise's, in dB.
pub fn white(trial: &mut Trial, setting: &mut Setting<'_>) {
    each_series(trial, setting, analog, |_, series, rng, db| {
        add(series, db, rng, |rng, frames, _| {
            (0..frames).map(|_| f64::from(nearly_normal(rng))).collect()
        });
    });
}

/// Noise that is strongest at low frequencies: handling, cables, drift.
pub fn red(trial: &mut Trial, setting: &mut Setting<'_>) {
    each_series(trial, setting, analog, |_, series, rng, db| add(series, db, rng, red_noise));
}

/// Room noise in what the microphone records: red noise that comes and goes, and hum.
pub fn room(trial: &mut Trial, setting: &mut Setting<'_>) {
    each_series(trial, setting, sound, |_, series, rng, db| add(series, db, rng, room_noise));
}

fn red_noise(rng: &mut ChaCha8Rng, frames: usize, rate_hz: f64) -> Vec<f64> {
    let keep = (-TAU * CORNER_HZ / rate_hz).exp();
    let fresh = (1.0 - keep * keep).sqrt();
    let mut state = f64::from(nearly_normal(rng));
    let next = |_| {
        state = keep * state + fresh * f64::from(nearly_normal(rng));
        state
    };
    (0..frames).map(next).collect()
}

fn room_noise(rng: &mut ChaCha8Rng, frames: usize, rate_hz: f64) -> Vec<f64> {
    let mut noise = red_noise(rng, frames, rate_hz);
    let (pace, start) = (TAU * SYLLABLES_HZ / rate_hz, TAU * uniform(rng));
    let hum = (2.0 * HUM_SHARE / HUM_HZ.len() as f64).sqrt();
    let phases = HUM_HZ.map(|_| TAU * uniform(rng));
    for (i, x) in noise.iter_mut().enumerate() {
        let at = i as f64;
        *x *= 1.0 + 0.8 * (start + pace * at).sin();
        for (hz, phase) in HUM_HZ.iter().zip(phases) {
            *x += hum * (phase + TAU * hz / rate_hz * at).sin();
        }
    }
    noise
}

/// Adds noise of its own to each channel, `db` below the channel's deviation.
fn add(
    series: &mut Series,
    db: f64,
    rng: &mut ChaCha8Rng,
    make: impl Fn(&mut ChaCha8Rng, usize, f64) -> Vec<f64>,
) {
    for channel in 0..series.channels() {
        let noise = make(rng, series.frames(), series.rate_hz());
        let own = ChannelSpread::of(noise.iter().copied()).deviation;
        let scale = ChannelSpread::of(series.channel(channel)).deviation * 10f64.powf(-db / 20.0)
            / own.max(1e-12);
        for (x, noise) in series.view_mut().column_mut(channel).iter_mut().zip(noise) {
            *x = to_sample(f64::from(*x) + scale * noise);
        }
    }
}
