//! Dragging makes the stylus vibrate: sound (mi2) and acceleration (ac).
//!
//! Noise with a smooth spectrum that belongs to the surface; speed stretches it, force and speed
//! make it stronger.

use super::effect::{Draws, Effect};
use super::hand::Hand;
use super::noise::{coloured, quantised};
use super::parameters::Difficulty;

/// Number of bumps in a spectrum.
const BUMPS: u32 = 4;
/// Width of a bump, as the standard deviation of the ln of the frequency.
const BUMP_WIDTH: f64 = 0.25;
/// The microphone picks up nothing above.
pub(super) const MICROPHONE_END_HZ: f64 = 12_000.0;
/// The accelerometer feels nothing above.
const ACCELEROMETER_END_HZ: f64 = 1_600.0;
/// Level grows as force to this power.
const FORCE_POWER: f64 = 0.7;

/// A smooth spectrum: a slope with bumps over it. Its density is 1 at the middle frequency, less
/// the bumps.
struct Spectrum {
    middle_hz: f64,
    slope: f64,
    /// ln of the centre in Hz, and height
    bumps: [(f64, f64); BUMPS as usize],
}

impl Spectrum {
    fn draw(draws: &Draws<'_>, name: &str, slope: Effect, height: Effect, centre: Effect) -> Self {
        let (heights, centres) = (format!("{name} bump"), format!("{name} centre"));
        let bump = |i| (draws.nth(&centres, i, centre), draws.nth(&heights, i, height).exp());
        Self {
            middle_hz: centre.centre.exp(),
            slope: draws.value(&format!("{name} slope"), slope),
            bumps: std::array::from_fn(|i| bump(i as u32)),
        }
    }

    /// Amplitude at a frequency in Hz.
    fn density(&self, hz: f64) -> f64 {
        let hz = hz.max(20.0);
        let bumps: f64 = self
            .bumps
            .iter()
            .map(|(centre, height)| {
                height * (-0.5 * ((hz.ln() - centre) / BUMP_WIDTH).powi(2)).exp()
            })
            .sum();
        (hz / self.middle_hz).powf(-self.slope) * (1.0 + bumps)
    }
}

/// The room's noise: amplitude per √Hz at a frequency in Hz.
pub(super) fn room(draws: &Draws<'_>, d: &Difficulty) -> impl Fn(f64) -> f64 + use<> {
    let level = draws.value("room level", d.room_level).exp();
    let slope = draws.value("room slope", d.room_slope);
    // A room of slope 0 has this level as its standard deviation.
    let unit = level / MICROPHONE_END_HZ.sqrt();
    move |hz| unit * (hz.max(20.0) / 1_000.0).powf(-slope)
}

/// The dragging sound, in full scales of the converter.
pub(super) fn sound(
    draws: &Draws<'_>,
    d: &Difficulty,
    hand: &Hand,
    frames: usize,
    rate_hz: f64,
) -> Vec<f32> {
    let spectrum = Spectrum::draw(draws, "sound", d.sound_slope, d.sound_bump, d.sound_centre);
    let room = room(draws, d);
    let gain = draws.value("microphone gain", d.microphone_gain).exp();
    let level = draws.value("sound level", d.sound_level) + FORCE_POWER * hand.force + hand.speed;
    let unit = level.exp() / MICROPHONE_END_HZ.sqrt();
    let speed = hand.speed.exp();
    let density = |hz: f64| gain * (unit * spectrum.density(hz / speed)).hypot(room(hz));
    let rng = &mut draws.noise("sound");
    let mut samples = coloured(rng, frames, rate_hz, MICROPHONE_END_HZ, density);
    hand.modulate(&mut samples, FORCE_POWER);
    samples.iter_mut().for_each(|x| *x = quantised(*x));
    samples
}

/// Acceleration along x, y and z, interleaved, in full scales of the converter.
pub(super) fn acceleration(
    draws: &Draws<'_>,
    d: &Difficulty,
    hand: &Hand,
    frames: usize,
    rate_hz: f64,
) -> Vec<f32> {
    let spectrum = Spectrum::draw(
        draws,
        "acceleration",
        d.acceleration_slope,
        d.acceleration_bump,
        d.acceleration_centre,
    );
    let level = draws.value("acceleration level", d.acceleration_level)
        + FORCE_POWER * hand.force
        + hand.speed;
    let speed = hand.speed.exp();
    let rng = &mut draws.noise("acceleration");
    let mut interleaved = vec![0.0; 3 * frames];
    for axis in 0..3 {
        let share = draws.nth("acceleration axis", axis, d.acceleration_axis);
        let unit = (level + share).exp() / ACCELEROMETER_END_HZ.sqrt();
        let density = |hz: f64| unit * spectrum.density(hz / speed);
        let mut samples = coloured(rng, frames, rate_hz, ACCELEROMETER_END_HZ, density);
        hand.modulate(&mut samples, FORCE_POWER);
        for (frame, x) in interleaved.chunks_exact_mut(3).zip(samples) {
            frame[axis as usize] = quantised(x);
        }
    }
    interleaved
}
