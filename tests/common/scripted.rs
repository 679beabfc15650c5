//! Scans as the stylus samples them: rest, a tap, a pause, the drag of a trial, rest.

use surfaced::trial::{Signal, Trial};

/// Samples a second.
const RATE_HZ: f64 = 10_000.0;
/// The noise floor is learnt in 0.3 s; a drag that is over is quiet for 0.3 s.
const REST_S: f64 = 0.7;
const TAP_S: f64 = 0.03;
const PAUSE_S: f64 = 0.3;

/// One sample of the stylus: acceleration X Y Z, forces 1 2, infrared, metal.
pub type Sample = [i16; 7];

/// Noise of a few steps of the converter, the same for the same seed.
pub struct Noise(pub u32);

impl Noise {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from((self.0 >> 16) as i16) / 32_768.0
    }
}

/// Fractions of full scale as the converter gives them; metal is 0 or 1.
fn converted(ac: [f64; 3], fr: [f64; 2], ir: f64, me: f64) -> Sample {
    let value = |x: f64| (x * 32_768.0).round().clamp(-32_768.0, 32_767.0) as i16;
    [
        value(ac[0]),
        value(ac[1]),
        value(ac[2]),
        value(fr[0]),
        value(fr[1]),
        value(ir),
        if me > 0.5 { 32_767 } else { 0 },
    ]
}

/// The scan of a trial: its sources `ac`, `fr`, `ir` and `me` as far as it has them at 10 kHz, the
/// first `drag_s` seconds of them. A trial without forces is pressed evenly.
pub fn scan(trial: &Trial, drag_s: f64, noise: &mut Noise) -> Vec<Sample> {
    let series = |id: &str| match trial.signals.get(id) {
        Some(Signal::Series(series)) if series.rate_hz() == RATE_HZ => Some(series),
        _ => None,
    };
    let all = ["ac", "fr", "ir", "me"].map(series);
    let longest = (drag_s * RATE_HZ) as usize;
    let frames = all.iter().flatten().map(|s| s.frames()).min().unwrap_or(0).min(longest);
    let at = |source: usize, frame: usize, channel: usize| {
        let series = all[source]?;
        series.samples().get(frame * series.channels() + channel).map(|x| f64::from(*x))
    };
    // The stylus is held as in the drag, so that gravity does not jump.
    let mean = |channel: usize| {
        (0..frames).filter_map(|i| at(0, i, channel)).sum::<f64>() / frames.max(1) as f64
    };
    let gravity = [mean(0), mean(1), mean(2)];
    let mut samples = Vec::new();
    let hold = |seconds: f64, swing: f64, noise: &mut Noise, samples: &mut Vec<Sample>| {
        let count = (seconds * RATE_HZ) as usize;
        for i in 0..count {
            let t = i as f64 / RATE_HZ;
            let hit = swing * (-t / 0.01).exp() * (std::f64::consts::TAU * 300.0 * t).sin();
            let ac = gravity.map(|g| g + hit + 1e-4 * noise.next());
            let pressed = if swing > 0.0 { 0.1 } else { 0.0 };
            // No sensor rests at the very end of its range.
            let fr = [0, 1].map(|_| pressed + 3e-3 + 3e-4 * noise.next());
            samples.push(converted(ac, fr, 3e-3 + 3e-4 * noise.next(), 0.0));
        }
    };
    hold(REST_S, 0.0, noise, &mut samples);
    hold(TAP_S, 0.3, noise, &mut samples);
    hold(PAUSE_S, 0.0, noise, &mut samples);
    for i in 0..frames {
        let ac = [0, 1, 2].map(|c| at(0, i, c).unwrap_or(1e-4 * noise.next()));
        let even = 0.2 + 1e-3 * noise.next();
        let fr = [0, 1].map(|c| at(1, i, c).unwrap_or(even));
        let ir = at(2, i, 0).unwrap_or(1e-4 * noise.next());
        samples.push(converted(ac, fr, ir, at(3, i, 0).unwrap_or(0.0)));
    }
    hold(REST_S, 0.0, noise, &mut samples);
    samples
}
