//! The constants of the synthetic scene: its size and its difficulty; and the values that trials draw
//! from them. A quantity is a centre plus independent, normally distributed effects of the surface, the
//! user and the trial (a random-effects model).

use std::collections::BTreeMap;

use rand_chacha::ChaCha8Rng;

use crate::seed::{self, normal, uniform};
use crate::trial::{EXPERT, TrialKey};

/// Mean and spreads (standard deviations) of one quantity, in the quantity's unit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Effect {
    /// mean over surfaces, for the expert's trials
    pub centre: f64,
    /// standard deviation between surfaces, by which a method can tell surfaces apart
    pub surface: f64,
    /// standard deviation of the difference between a user and the expert
    pub user: f64,
    /// standard deviation between trials of one surface by one user
    pub trial: f64,
}

/// Longest drag, in seconds; a longer one is cut to this length.
pub(super) const LONGEST_DRAG_S: f64 = 600.0;

#[derive(Clone, Debug, PartialEq)]
pub struct Parameters {
    /// number of surfaces; surface number k does not depend on how many there are
    pub surfaces: usize,
    pub trials: u32,
    /// number of users; user u makes one trial of every surface, trial number u
    pub users: u32,
    /// seed of all random draws; equal seeds give equal scenes
    pub seed: u64,
    pub drag_seconds: f64,
    pub twins: Option<Twins>,
    pub difficulty: Difficulty,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Twins {
    /// one of the two similar surfaces, counted from 0
    pub original: usize,
    pub twin: usize,
    /// difference between the two: 0 for equal surfaces, 1 for unrelated ones
    pub distance: f64,
}

impl Default for Parameters {
    /// The size of LMT108: 108 surfaces, ten trials by the expert and one by each of ten users.
    fn default() -> Self {
        Self {
            surfaces: 108,
            trials: 10,
            users: 10,
            seed: 1,
            drag_seconds: 4.8,
            twins: None,
            difficulty: Difficulty::default(),
        }
    }
}

/// Every quantity of the scene: its name, its mean and spreads in demonstrations and, if they
/// differ, those in a scene like the dataset LMT108.
///
/// `ln` marks quantities given as natural logarithms, so that a spread of 0.1 is about 10 %;
/// `logit` marks quantities between 0 and 1. Amplitudes are fractions of the full scale.
#[rustfmt::skip]
const QUANTITIES: [(&str, Effect, Option<Effect>); 40] = [
    // Hand of the user, which shapes all sources of a trial.
    // ln of the pressing force relative to the expert's mean
    ("force",                  e(0.0, 0.0, 0.25, 0.15),     Some(e(0.0, 0.0, 0.08, 0.08))),
    // ln of the speed; a higher speed stretches spectra and shortens correlation times
    ("speed",                  e(0.0, 0.0, 0.20, 0.15),     Some(e(0.0, 0.0, 0.10, 0.10))),
    // Sound, tap and drag (mi1, mi2).
    // ln of the microphone's gain, which includes the effect of its distance
    ("microphone gain",        e(0.0, 0.0, 0.20, 0.03),     Some(e(0.0, 0.0, 0.08, 0.03))),
    // ln of the amplitude of the room's noise
    ("room level",             e(-7.6, 0.0, 0.40, 0.10),    Some(e(-7.6, 0.0, 0.10, 0.05))),
    // slope of the room noise's spectrum: amplitude falls as frequency^(−slope)
    ("room slope",             e(0.8, 0.0, 0.10, 0.02),     Some(e(0.8, 0.0, 0.02, 0.02))),
    // ln of the amplitude of the dragging sound
    ("sound level",            e(-4.2, 0.45, 0.20, 0.15),   Some(e(-4.2, 0.15, 0.05, 0.08))),
    // slope of the dragging sound's spectrum: the amplitude is proportional to 1/frequency^slope
    ("sound slope",            e(0.5, 0.15, 0.0, 0.03),     None),
    // ln of the height of each bump of the dragging sound's spectrum, as a factor on the power law
    ("sound bump",             e(0.7, 0.70, 0.15, 0.15),    Some(e(0.7, 0.45, 0.05, 0.08))),
    // ln of the centre of each bump of the dragging sound's spectrum, in Hz
    ("sound centre",           e(7.0, 0.80, 0.0, 0.0),      None),
    // ln of the amplitude of a tap's sound
    ("tap level",              e(-3.0, 0.45, 0.10, 0.10),   Some(e(-3.0, 0.30, 0.03, 0.03))),
    // ln of the relative strength of each resonance in a tap's sound
    ("tap mode",               e(-1.0, 0.80, 0.10, 0.10),   Some(e(-1.0, 0.70, 0.04, 0.04))),
    // ln of the frequency of each resonance of a tap, in Hz
    ("tap frequency",          e(6.9, 0.80, 0.0, 0.01),     None),
    // ln of the time in which a resonance of a tap decays to 1/e, in s
    ("tap decay",              e(-4.8, 0.70, 0.05, 0.05),   Some(e(-4.8, 0.50, 0.05, 0.05))),
    // ln of the relative strength of a tap's click, a short noise of all frequencies
    ("tap click",              e(-0.7, 0.60, 0.10, 0.10),   Some(e(-0.7, 0.70, 0.04, 0.04))),
    // Vibration (ac).
    // ln of the amplitude of the acceleration
    ("acceleration level",     e(-4.5, 0.55, 0.15, 0.12),   Some(e(-4.5, 0.08, 0.10, 0.08))),
    // ln of a factor on the acceleration along each axis
    ("acceleration axis",      e(0.0, 0.30, 0.05, 0.05),    Some(e(0.0, 0.17, 0.05, 0.05))),
    // slope of the acceleration's spectrum, whose amplitude falls as frequency to minus the slope
    ("acceleration slope",     e(0.3, 0.15, 0.0, 0.03),     None),
    // ln of the height of each bump in the acceleration's spectrum
    ("acceleration bump",      e(1.0, 0.80, 0.10, 0.10),    None),
    // ln of the centre of each bump of the acceleration's spectrum, in Hz
    ("acceleration centre",    e(5.5, 0.70, 0.0, 0.0),      None),
    // Forces (fr).
    // ln of the mean load on both force sensors together
    ("friction level",         e(-1.4, 0.15, 0.15, 0.05),   Some(e(-1.4, 0.50, 0.30, 0.05))),
    // logit of the first force sensor's share of the load
    ("friction share",         e(0.0, 0.30, 0.15, 0.05),    Some(e(0.0, 0.10, 0.05, 0.03))),
    // ln of the relative fluctuation of the load on both force sensors together
    ("friction common",        e(-2.2, 0.50, 0.20, 0.15),   Some(e(-2.6, 0.60, 0.05, 0.08))),
    // ln of the relative fluctuation that moves load from one force sensor to the other
    ("friction swing",         e(-2.2, 0.50, 0.20, 0.15),   Some(e(-2.6, 0.60, 0.05, 0.08))),
    // ln of the correlation time of the load's fluctuations, in s
    ("friction correlation",   e(-4.0, 0.70, 0.10, 0.10),   None),
    // Infrared reflectance (ir).
    // logit of the mean reflectance
    ("reflectance level",      e(-0.7, 0.80, 0.30, 0.05),   Some(e(-0.7, 0.80, 0.40, 0.05))),
    // ln of the reflectance's standard deviation, for a mean of ½; it is less for means near 0 or 1
    ("reflectance width",      e(-3.4, 0.55, 0.15, 0.15),   Some(e(-3.4, 0.40, 0.05, 0.08))),
    // skewness of the reflectance's distribution; 0 is symmetric
    ("reflectance skew",       e(0.0, 0.60, 0.05, 0.05),    Some(e(0.0, 0.50, 0.05, 0.05))),
    // ln of the reflectance's correlation time, in s
    ("reflectance correlation",e(-4.2, 0.90, 0.05, 0.05),   None),
    // Metal (me).
    // logit of the share of the time in which the detector senses a conducting surface
    ("metal contact",          e(1.5, 2.00, 0.20, 0.20),    None),
    // Pictures (ca1, ca2).
    // hue of the surface's base colour, in turns
    ("hue",                    e(0.08, 0.25, 0.0, 0.005),   None),
    // logit of the saturation of the base colour
    ("saturation",             e(-0.8, 0.90, 0.05, 0.05),   None),
    // logit of the value (brightness) of the base colour
    ("value",                  e(0.2, 0.80, 0.0, 0.03),     None),
    // ln of the contrast of the texture
    ("contrast",               e(-1.6, 0.50, 0.05, 0.08),   None),
    // hue of the texture's second colour, in turns from the base colour
    ("accent",                 e(0.0, 0.05, 0.0, 0.005),    None),
    // ln of the wavelength of the texture, in pixels
    ("wavelength",             e(3.2, 0.60, 0.05, 0.05),    None),
    // ln of the strength of a picture's grain, the noise of single pixels
    ("grain",                  e(-3.8, 0.50, 0.10, 0.05),   None),
    // logit of the gloss, on which size and strength of the flash's reflection depend
    ("gloss",                  e(-0.5, 1.00, 0.0, 0.05),    Some(e(-0.5, 0.40, 0.20, 0.80))),
    // ln of the brightness of the light without flash
    ("light",                  e(0.0, 0.0, 0.12, 0.03),     Some(e(0.0, 0.0, 0.05, 0.20))),
    // ln of the ratio of red to blue in the light without flash
    ("warmth",                 e(0.0, 0.0, 0.05, 0.01),     Some(e(0.0, 0.0, 0.03, 0.08))),
    // ln of the brightness of the light with flash
    ("flash",                  e(0.25, 0.0, 0.15, 0.06),    Some(e(-0.9, 0.0, 0.20, 0.80))),
];

const fn e(centre: f64, surface: f64, user: f64, trial: f64) -> Effect {
    Effect { centre, surface, user, trial }
}

/// How well sources separate surfaces, and how much users differ.
#[derive(Clone, Debug, PartialEq)]
pub struct Difficulty {
    /// centre and spreads of each quantity of the scene, by the quantity's name
    pub effects: BTreeMap<&'static str, Effect>,
    /// standard deviation of ln(force) within one drag
    pub force_drift: f64,
    /// share of the mesh and glossy surfaces that conduct electricity
    pub metal_fraction: f64,
    pub metal_correlation_s: f64,
}

impl Difficulty {
    /// A scene about as hard as the dataset LMT108, source by source.
    ///
    /// Calibrated on Table II of the paper with `cargo run --release --example synth_pattern`: on
    /// 108 such surfaces, expert against users, the method `reference` comes near the accuracies in
    /// the paper. So this scene does not show that `reference` is good.
    ///
    /// Surfaces that resemble each other in a source make the source weak. Large differences
    /// between users would make the source misleading instead, and spoil the product of scores over
    /// sources. Users differ more than trials in the offsets that `align_mean` removes: gains, the
    /// load, and above all the mean reflectance, where users' offsets exceed the variation on one
    /// surface. A flash must not be so bright that pictures turn white: they would be identical,
    /// and their scores near 0 would dominate the product.
    pub fn lmt108() -> Self {
        let effects = QUANTITIES.map(|(name, easy, hard)| (name, hard.unwrap_or(easy)));
        Self { effects: effects.into(), force_drift: 0.05, ..Self::default() }
    }
}

impl Default for Difficulty {
    /// A scene for demonstrations, easier than the dataset LMT108.
    fn default() -> Self {
        let effects = QUANTITIES.map(|(name, easy, _)| (name, easy)).into();
        Self { effects, force_drift: 0.15, metal_fraction: 0.75, metal_correlation_s: 0.02 }
    }
}

/// The random draws of one trial, each with a seed made of names, so that none depends on others.
#[derive(Clone, Copy, Debug)]
pub(super) struct Draws<'a> {
    pub seed: u64,
    pub d: &'a Difficulty,
    pub key: &'a TrialKey,
    /// The surface that the trial's surface resembles, if any, and the distance to it (0: alike).
    pub like: Option<(&'a str, f64)>,
}

impl Draws<'_> {
    pub(super) fn value(&self, name: &str) -> f64 {
        self.nth(name, 0)
    }

    /// The value number `index` among quantities with equal spreads, such as the heights of bumps.
    pub(super) fn nth(&self, name: &str, index: u32) -> f64 {
        let effect = self.d.effects[name];
        let (name, index) = (name.as_bytes(), &index.to_le_bytes()[..]);
        let (surface, user) = (self.key.surface.as_bytes(), self.key.user.as_bytes());
        let number = self.key.number.to_le_bytes();
        let draw = |sd: f64, key: &[&[u8]]| match sd {
            0.0 => 0.0,
            _ => sd * normal(&mut seed::rng(self.seed, key)),
        };
        let hand = if self.key.user == EXPERT { 0.0 } else { effect.user };
        let of_surface =
            |surface: &str| draw(effect.surface, &[b"surface", name, index, surface.as_bytes()]);
        let own = of_surface(&self.key.surface);
        effect.centre
            + self.like.map_or(own, |(other, far)| (1.0 - far) * of_surface(other) + far * own)
            + draw(hand, &[b"user", name, index, user])
            + draw(effect.trial, &[b"trial", name, index, surface, user, &number])
    }

    /// A uniform number in [0, 1), the same in all trials of a surface and of a surface like it.
    pub(super) fn surface_uniform(&self, name: &str, index: u32) -> f64 {
        let index = index.to_le_bytes();
        let surface = self.like.map_or(self.key.surface.as_str(), |(other, _)| other);
        let key = [b"uniform", name.as_bytes(), &index, surface.as_bytes()];
        uniform(&mut seed::rng(self.seed, &key))
    }

    /// A generator for noise that differs between trials.
    pub(super) fn noise(&self, name: &str) -> ChaCha8Rng {
        let number = self.key.number.to_le_bytes();
        let (surface, user) = (self.key.surface.as_bytes(), self.key.user.as_bytes());
        seed::rng(self.seed, &[b"noise", name.as_bytes(), surface, user, &number])
    }
}

pub(super) fn logistic(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(key: (&str, &str, u32), effect: Effect, like: Option<(&str, f64)>) -> f64 {
        let d = &Difficulty { effects: [("level", effect)].into(), ..Difficulty::default() };
        let key = &TrialKey::new(key.0, key.1, key.2);
        Draws { seed: 7, d, key, like }.value("level")
    }

    #[test]
    fn the_expert_is_the_zero_of_the_user_effect() {
        let hands = Effect { centre: 1.0, surface: 0.0, user: 0.25, trial: 0.0 };
        assert_eq!(value(("A", EXPERT, 1), hands, None), 1.0);
        assert_ne!(value(("A", "user1", 1), hands, None), 1.0);
    }

    #[test]
    fn all_trials_of_a_surface_share_its_effect_and_a_twin_is_almost_like_its_original() {
        let surfaces = Effect { centre: 1.0, surface: 0.5, user: 0.0, trial: 0.0 };
        let [a, b] = ["A", "B"].map(|surface| value((surface, EXPERT, 1), surfaces, None));
        assert_eq!(a, value(("A", "user3", 3), surfaces, None));
        assert_ne!(a, b);
        let twin = |distance| value(("B", EXPERT, 1), surfaces, Some(("A", distance)));
        assert_eq!(twin(0.0), a);
        assert!((twin(0.25) - (0.75 * a + 0.25 * b)).abs() < 1e-12);
    }
}
