//! A quantity of the synthetic scene: a centre plus independent, normally distributed effects of
//! the surface, the user and the trial (a random-effects model).
//!
//! [`Difficulty`] holds the numbers of all effects. A method tells surfaces apart by the spread
//! between surfaces; the spreads between users and between trials make this harder.

use rand_chacha::ChaCha8Rng;

use super::parameters::Difficulty;
use crate::seed::{self, normal, uniform};
use crate::trial::{EXPERT, TrialKey};

/// The random draws of one trial. Each draw has its own seed, made from names, so that it does not
/// depend on draws of other quantities or other trials.
#[derive(Clone, Copy, Debug)]
pub(super) struct Draws<'a> {
    pub seed: u64,
    pub d: &'a Difficulty,
    pub key: &'a TrialKey,
    /// The surface that the trial's surface resembles, if any, and the distance to it (0: alike).
    pub like: Option<(&'a str, f64)>,
}

impl Draws<'_> {
    /// The value of a quantity in this trial.
    pub fn value(&self, name: &str) -> f64 {
        self.nth(name, 0)
    }

    /// The value number `index` among quantities with equal spreads, such as the heights of bumps.
    pub fn nth(&self, name: &str, index: u32) -> f64 {
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
    pub fn surface_uniform(&self, name: &str, index: u32) -> f64 {
        let index = index.to_le_bytes();
        let surface = self.like.map_or(self.key.surface.as_str(), |(other, _)| other);
        let key = [b"uniform", name.as_bytes(), &index, surface.as_bytes()];
        uniform(&mut seed::rng(self.seed, &key))
    }

    /// A generator for noise that differs between trials.
    pub fn noise(&self, name: &str) -> ChaCha8Rng {
        let number = self.key.number.to_le_bytes();
        let (surface, user) = (self.key.surface.as_bytes(), self.key.user.as_bytes());
        seed::rng(self.seed, &[b"noise", name.as_bytes(), surface, user, &number])
    }
}

/// The logistic function, which maps any number to a number between 0 and 1.
pub(super) fn logistic(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

#[cfg(test)]
mod tests {
    use super::super::parameters::Effect;
    use super::*;

    const LEVEL: Effect = Effect { centre: 1.0, surface: 0.5, user: 0.25, trial: 0.125 };

    fn value_like(key: TrialKey, effect: Effect, like: Option<(&str, f64)>) -> f64 {
        let d = &Difficulty { effects: [("level", effect)].into(), ..Difficulty::default() };
        Draws { seed: 7, d, key: &key, like }.value("level")
    }

    fn value(key: TrialKey, effect: Effect) -> f64 {
        value_like(key, effect, None)
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
        let value =
            |surface: &str, like| value_like(TrialKey::new(surface, EXPERT, 1), surfaces, like);
        let (a, b) = (value("A", None), value("B", None));
        assert_eq!(value("B", Some(("A", 0.0))), a);
        assert!((value("B", Some(("A", 0.25))) - (0.75 * a + 0.25 * b)).abs() < 1e-12);
    }
}
