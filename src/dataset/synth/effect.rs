//! A quantity of the synthetic scene: a centre plus independent normal effects of the surface, the
//! user and the trial (a random-effects model).
//!
//! So the whole scene is calibrated by the numbers in `Difficulty`: the spread between surfaces, by
//! which a method tells them apart, stands beside the spreads that blur it.

use rand_chacha::ChaCha8Rng;

use crate::seed::{self, normal, uniform};
use crate::trial::{EXPERT, TrialKey};

/// One quantity: its centre and the standard deviations of its effects, all in its own unit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Effect {
    /// the mean over surfaces, for the expert
    pub centre: f64,
    /// standard deviation between surfaces, which a recogniser can use
    pub surface: f64,
    /// standard deviation of a user's difference from the expert, whose own effect is 0
    pub user: f64,
    /// standard deviation between trials of one surface by one user
    pub trial: f64,
}

impl Effect {
    /// A quantity with this centre and these spreads.
    pub const fn new(centre: f64, surface: f64, user: f64, trial: f64) -> Self {
        Self { centre, surface, user, trial }
    }
}

/// The random draws of one trial. Keys name each draw, so a quantity does not depend on which
/// others exist, nor a trial on which others are made.
#[derive(Clone, Copy, Debug)]
pub(super) struct Draws<'a> {
    pub seed: u64,
    pub key: &'a TrialKey,
    /// A surface that this one resembles, and the distance to it, from 0 to 1.
    pub like: Option<(&'a str, f64)>,
}

impl Draws<'_> {
    /// The value of a quantity in this trial.
    pub fn value(&self, name: &str, effect: Effect) -> f64 {
        self.nth(name, 0, effect)
    }

    /// The value of one of several quantities with the same effects, such as the heights of bumps.
    pub fn nth(&self, name: &str, index: u32, effect: Effect) -> f64 {
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

    /// A uniform number in [0, 1), the same in all trials of the surface.
    pub fn surface_uniform(&self, name: &str, index: u32) -> f64 {
        let index = index.to_le_bytes();
        let surface = self.like.map_or(self.key.surface.as_str(), |(other, _)| other);
        let key = [b"uniform", name.as_bytes(), &index, surface.as_bytes()];
        uniform(&mut seed::rng(self.seed, &key))
    }

    /// A generator for noise that differs from trial to trial.
    pub fn noise(&self, name: &str) -> ChaCha8Rng {
        let number = self.key.number.to_le_bytes();
        let (surface, user) = (self.key.surface.as_bytes(), self.key.user.as_bytes());
        seed::rng(self.seed, &[b"noise", name.as_bytes(), surface, user, &number])
    }
}

/// Maps any number to one between 0 and 1.
pub(super) fn logistic(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

#[cfg(test)]
mod tests {
    use super::*;

    const LEVEL: Effect = Effect::new(1.0, 0.5, 0.25, 0.125);

    fn value(key: TrialKey, effect: Effect) -> f64 {
        Draws { seed: 7, key: &key, like: None }.value("level", effect)
    }

    #[test]
    fn the_expert_is_the_zero_of_the_user_effect() {
        let hands = Effect { surface: 0.0, trial: 0.0, ..LEVEL };
        assert_eq!(value(TrialKey::new("A", EXPERT, 1), hands), 1.0);
        assert_ne!(value(TrialKey::new("A", "user1", 1), hands), 1.0);
    }

    #[test]
    fn a_surface_effect_is_shared_by_all_trials_of_the_surface() {
        let surfaces = Effect { user: 0.0, trial: 0.0, ..LEVEL };
        let first = value(TrialKey::new("A", EXPERT, 1), surfaces);
        assert_eq!(first, value(TrialKey::new("A", "user3", 3), surfaces));
        assert_ne!(first, value(TrialKey::new("B", EXPERT, 1), surfaces));
    }
    #[test]
    fn a_twin_is_almost_like_its_original() {
        let surfaces = Effect { user: 0.0, trial: 0.0, ..LEVEL };
        let value = |surface: &str, like| {
            let key = &TrialKey::new(surface, EXPERT, 1);
            Draws { seed: 7, key, like }.value("level", surfaces)
        };
        let (a, b) = (value("A", None), value("B", None));
        assert_eq!(value("B", Some(("A", 0.0))), a);
        assert!((value("B", Some(("A", 0.25))) - (0.75 * a + 0.25 * b)).abs() < 1e-12);
    }
}
