//! Augmented copies of a library's trials for training: what the same scan might be with another hand,
//! at another place, or with a worse sensor.
//!
//! Each trial has three excerpts of 40 % and one *twin*: the whole trial with the disturbances of a
//! worse sensor (README §5). Two of the excerpts are noisy, since a clean library has never met noise
//! (README §5). The gain of copies varies like the force of a hand, so that training learns how much
//! to trust level. Place and gain are drawn once for each copy; stretch, noise, loss and lift-offs once
//! for each source of a copy. All draws depend only on the trial's samples and the seed, never on its name.

use std::sync::LazyLock;

use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::moments::means;
use crate::lanes::{dot, less};
use crate::library::shape::LibraryShape;
use crate::seed;

const EXCERPTS: usize = 3;

/// Number of copies of each trial of a small library: the excerpts, then the twin.
const COPIES: usize = EXCERPTS + 1;

/// About as many copies are enough for a member's scatter. In a library with more trials than a quarter
/// of it, each trial has fewer copies than [`COPIES`].
const MOST_COPIES: usize = 1600;

/// In a library with more trials, only about as many are copied.
const MOST_COPIED: usize = MOST_COPIES / 2;

/// Length of an excerpt, as a share of its trial.
pub(crate) const SHARE: f64 = 0.4;

/// Standard deviation of ln gain of a copy: 2 dB, like the force of a hand.
const LN_GAIN: f64 = 0.25;

/// Standard deviation of ln gain of a copied picture, since the light varies.
const PICTURE_LN_GAIN: f64 = 0.2;

/// Largest |ln| of a twin's stretch: a clock or pace that is 6 % off.
const LN_STRETCH: f64 = 0.06;

/// White noise added to a twin, in dB below the signal: least and most.
const TWIN_NOISE_DB: (f64, f64) = (5.0, 40.0);

/// White noise added to all excerpts except the first, in dB below the signal: least and most.
const EXCERPT_NOISE_DB: (f64, f64) = (10.0, 60.0);

/// Share of samples that is lost in half of the twins, as a power of ten: least and most.
const LOST_LOG10: (f64, f64) = (-3.0, -1.0);

/// Share of the noisy copies that leave the surface; greatest share of their time there; share of one stretch
/// of it, least and most; and the factor on its samples, as a power of ten, least and most.
const LIFTED_COPIES: f64 = 0.15;
const LIFTED: f64 = 0.3;
const LIFTED_AT_ONCE: (f64, f64) = (0.02, 0.2);
const LIFTED_LOG10: (f64, f64) = (-3.0, -1.0);

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Copy {
    /// Start of an excerpt, as a share of the latest possible start; `None` for the twin.
    pub place: Option<f64>,
    pub ln_gain: f64,
    pub picture_ln_gain: f64,
    /// The quarter of each picture that the copy holds, 0 to 3.
    pub quarter: usize,
}

/// Number of copies of each copied trial, and the share of the trials that are copied.
pub(super) fn count(shape: &LibraryShape) -> (usize, f64) {
    ((MOST_COPIES / shape.trials.max(1)).clamp(1, COPIES), shape.share(MOST_COPIED))
}

/// The copies of the trial with the given digest of its samples, in a library of this shape. If
/// they are fewer than [`COPIES`], the excerpts are drawn. Twins teach most, so one is among two copies or
/// more, and is every second single copy. Some trials of a large library have none.
pub(super) fn copies(digest: u64, seed: u64, shape: &LibraryShape) -> Vec<Copy> {
    let mut rng = rng(digest, seed, "copies");
    let mut all = std::array::from_fn::<_, COPIES, _>(|i| Copy {
        place: (i < EXCERPTS).then(|| seed::uniform(&mut rng)),
        ln_gain: LN_GAIN * seed::normal(&mut rng),
        picture_ln_gain: PICTURE_LN_GAIN * seed::normal(&mut rng),
        quarter: i,
    });
    let (count, share) = count(shape);
    if count < COPIES {
        all[..EXCERPTS].rotate_left((seed::uniform(&mut rng) * EXCERPTS as f64) as usize);
        if count > 1 || seed::uniform(&mut rng) < 0.5 {
            all.swap(count - 1, EXCERPTS);
        }
    }
    let count = if seed::uniform(&mut rng) < share { count } else { 0 };
    all[..count].to_vec()
}

fn rng(digest: u64, seed: u64, purpose: &str) -> ChaCha8Rng {
    seed::rng(seed, &[purpose.as_bytes(), &digest.to_le_bytes()])
}

/// The samples of a copy of a series: an excerpt, or the twin. `samples` are interleaved; `source` is
/// the name of the source, and `deviations` are the [`deviations`] of its channels.
pub(super) fn samples(
    copy: &Copy,
    (digest, seed, source): (u64, u64, &str),
    deviations: &[f64],
    samples: &[f32],
) -> Vec<f32> {
    let channels = deviations.len();
    let mut rng = rng(digest, seed, &format!("copy {} {source}", copy.quarter));
    let Some(place) = copy.place else {
        return twin(&mut rng, deviations, samples);
    };
    let frames = samples.len() / channels;
    let length = ((SHARE * frames as f64).round() as usize).max(1);
    let first = (place * (frames - length.min(frames)) as f64).round() as usize;
    let mut excerpt = samples[first * channels..(first + length).min(frames) * channels].to_vec();
    if copy.quarter > 0 {
        lift(&mut rng, channels, &mut excerpt);
        let noise = noise(between(&mut rng, EXCERPT_NOISE_DB), deviations);
        add_noise(&mut rng, &noise, &mut excerpt);
    }
    excerpt
}

fn between(rng: &mut ChaCha8Rng, (low, high): (f64, f64)) -> f64 {
    low + (high - low) * seed::uniform(rng)
}

/// Deviation of white noise on each channel, `db` below the signal.
fn noise(db: f64, deviations: &[f64]) -> Vec<f32> {
    let share = 10f64.powf(-db / 20.0);
    deviations.iter().map(|deviation| (share * deviation) as f32).collect()
}

/// Number of draws of white noise that all copies share; prime, so that the frames of a long sound
/// meet other draws in each round. To draw each anew would take a tenth of the time of a library.
const DRAWS: usize = 65_521;

static NOISE: LazyLock<Vec<f32>> = LazyLock::new(|| {
    let mut rng = seed::rng(0, &[b"noise"]);
    (0..DRAWS).map(|_| seed::nearly_normal(&mut rng)).collect()
});

/// Adds white noise with these deviations to the channels of interleaved samples: shared draws from a
/// drawn place on.
fn add_noise(rng: &mut ChaCha8Rng, noise: &[f32], samples: &mut [f32]) {
    let (channels, mut rest) = (noise.len(), samples);
    let mut draws = &NOISE[(seed::uniform(rng) * (DRAWS - channels) as f64) as usize..];
    while !rest.is_empty() {
        if draws.len() < channels {
            draws = &NOISE;
        }
        let count = rest.len().min(draws.len() / channels * channels);
        let (some, after) = rest.split_at_mut(count);
        if let [noise] = noise {
            some.iter_mut().zip(draws).for_each(|(x, draw)| *x += noise * draw);
        } else {
            for (frame, draws) in some.chunks_exact_mut(channels).zip(draws.chunks_exact(channels))
            {
                for channel in 0..channels {
                    frame[channel] += noise[channel] * draws[channel];
                }
            }
        }
        (rest, draws) = (after, &draws[count..]);
    }
}

/// A series as a worse sensor would have recorded it: stretched, with white noise. In half of the
/// cases, single samples are lost and later samples move up.
fn twin(rng: &mut ChaCha8Rng, deviations: &[f64], samples: &[f32]) -> Vec<f32> {
    let channels = deviations.len();
    let pace = between(rng, (-LN_STRETCH, LN_STRETCH)).exp();
    let noise = noise(between(rng, TWIN_NOISE_DB), deviations);
    let lost = 10f64.powf(between(rng, LOST_LOG10));
    let lost = if seed::uniform(rng) < 0.5 { lost } else { 0.0 };
    let last = samples.len() / channels - 1;
    let frames = ((last as f64 / pace) as usize + 1).max(1);
    let mut twin = vec![0.0; frames * channels];
    // Places between samples, in parts of a sample.
    const PARTS: f64 = 4_294_967_296.0;
    let (mut at, step) = (0u64, (pace * PARTS) as u64);
    for frame in twin.chunks_exact_mut(channels) {
        let before = ((at >> 32) as usize).min(last);
        let (after, part) = ((before + 1).min(last), at as u32 as f32 / PARTS as f32);
        for channel in 0..channels {
            let x = samples[before * channels + channel];
            frame[channel] = x + part * (samples[after * channels + channel] - x);
        }
        at += step;
    }
    if lost > 0.0 {
        // Each frame after the first is lost or not, so the numbers kept between two are geometric.
        let (mut kept, mut from) = (1, 1);
        while from < frames {
            let run = ((1.0 - seed::uniform(rng)).ln() / (1.0 - lost).ln()) as usize;
            let end = from.saturating_add(run).min(frames);
            twin.copy_within(from * channels..end * channels, kept * channels);
            kept += end - from;
            from = end + 1;
        }
        twin.truncate(kept * channels);
    }
    lift(rng, channels, &mut twin);
    add_noise(rng, &noise, &mut twin);
    twin
}

/// Weakens all channels of interleaved samples in some stretches of one copy in seven, as if the stylus had
/// left the surface, or a line had paused. A channel at rest moves then, too.
fn lift(rng: &mut ChaCha8Rng, channels: usize, samples: &mut [f32]) {
    if seed::uniform(rng) >= LIFTED_COPIES {
        return;
    }
    let frames = samples.len() / channels;
    let gain = 10f64.powf(between(rng, LIFTED_LOG10)) as f32;
    let mut left = (LIFTED * seed::uniform(rng) * frames as f64) as usize;
    while left > 0 {
        let length = ((between(rng, LIFTED_AT_ONCE) * frames as f64) as usize).clamp(1, left);
        let first = (seed::uniform(rng) * (frames - length + 1) as f64) as usize;
        let stretch = &mut samples[first * channels..(first + length) * channels];
        stretch.iter_mut().for_each(|x| *x *= gain);
        left -= length;
    }
}

/// Standard deviation of each channel of interleaved samples.
pub(super) fn deviations(channels: usize, samples: &[f32]) -> Vec<f64> {
    let means = means(samples, channels);
    let frames = (samples.len() / channels).max(1) as f64;
    let of_channel = |(c, mean): (usize, &f32)| {
        let apart = less(samples, (channels, c), *mean);
        (dot(&apart, &apart) / frames).sqrt()
    };
    means.iter().enumerate().map(of_channel).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(trials: usize) -> LibraryShape {
        LibraryShape { trials, ..LibraryShape::default() }
    }

    fn wave() -> Vec<f32> {
        (0..2000).map(|i| (i as f32 * 0.05).sin()).collect()
    }

    #[test]
    fn copies_depend_on_samples_and_seed_alone() {
        assert_eq!(copies(1, 1, &of(9)), copies(1, 1, &of(9)));
        assert_ne!(copies(1, 1, &of(9)), copies(2, 1, &of(9)));
        assert_ne!(copies(1, 1, &of(9)), copies(1, 2, &of(9)));
        let is_twin = |copy: &Copy| copy.place.is_none();
        assert_eq!(
            copies(1, 1, &of(9)).iter().map(is_twin).collect::<Vec<_>>(),
            [false, false, false, true]
        );
        let twin = |source| {
            let wave = wave();
            samples(&copies(1, 1, &of(9))[EXCERPTS], (1, 1, source), &deviations(1, &wave), &wave)
        };
        assert_eq!(twin("ac"), twin("ac"));
        assert_ne!(twin("ac"), twin("fr"));
    }

    #[test]
    fn trials_of_a_large_library_have_fewer_copies_and_twins_stay() {
        let counts =
            [0, 1, 400, 401, 534, 800, 801, 1200, 100_000].map(|trials| count(&of(trials)));
        let copied = counts.map(|(_, share)| share);
        assert_eq!(counts.map(|(count, _)| count), [4, 4, 4, 3, 2, 2, 1, 1, 1]);
        assert_eq!(copied, [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 8.0 / 9.0, 2.0 / 3.0, 0.008]);
        for (trials, expected) in [(450, [533, 533, 533, 800]), (2000, [53, 53, 53, 160])] {
            let mut of_kind = [0usize; COPIES];
            for copy in (0..800).flat_map(|digest| copies(digest, 1, &of(trials))) {
                of_kind[copy.quarter] += 1;
            }
            let near = |(found, expected): (&usize, usize)| found.abs_diff(expected) < 50;
            assert!(of_kind.iter().zip(expected).all(near), "{of_kind:?}");
        }
    }

    #[test]
    fn an_excerpt_is_cut_to_the_sample_and_only_the_first_stays_clean() {
        let given: Vec<f32> = (0..2 * 1001).map(|i| i as f32).collect();
        for digest in 1..50 {
            for copy in &copies(digest, 3, &of(9))[..EXCERPTS] {
                let cut = samples(copy, (digest, 3, "ac"), &deviations(2, &given), &given);
                assert_eq!(cut.len(), 800);
                let clean = cut[0] % 2.0 == 0.0 && cut.windows(2).all(|w| w[1] == w[0] + 1.0);
                assert_eq!(clean, copy.quarter == 0);
            }
        }
        let copy = copies(1, 3, &of(9))[0];
        assert_eq!(samples(&copy, (1, 3, "ac"), &[0.0; 2], &given[..2]).len(), 2, "a single frame");
    }

    #[test]
    fn noise_is_as_loud_as_asked_on_each_channel_of_a_series_of_any_length() {
        let asked = [0.5, 0.0, 2.0];
        for frames in [2000, DRAWS] {
            let mut samples = vec![0.0; 3 * frames];
            add_noise(&mut rng(1, 1, "noise"), &asked.map(|x| x as f32), &mut samples);
            for (found, asked) in deviations(3, &samples).iter().zip(asked) {
                assert!((found - asked).abs() <= 0.05 * asked, "{found} instead of {asked}");
            }
        }
    }

    #[test]
    fn a_share_of_the_noisy_copies_is_lifted_for_a_part_of_the_time_with_channels_at_rest() {
        let loud: Vec<f32> = (0..4000)
            .map(|i| if i % 2 == 1 { 6.0 } else { 5.0 + 0.2 * (i / 2 % 2) as f32 })
            .collect();
        let mut lifted = [0; COPIES];
        for digest in 0..200 {
            for copy in copies(digest, 1, &of(9)) {
                let made = samples(&copy, (digest, 1, "ac"), &deviations(2, &loud), &loud);
                let weak = |c: usize| made.iter().skip(c).step_by(2).filter(|x| **x < 2.0).count();
                assert_eq!(weak(0), weak(1), "in all channels at once");
                assert!((weak(0) as f64) < (LIFTED + 1e-3) * made.len() as f64 / 2.0);
                lifted[copy.quarter] += usize::from(weak(0) > 0);
            }
        }
        let [clean, noisy @ ..] = lifted;
        assert_eq!(clean, 0);
        assert!(noisy.iter().all(|lifted| (15..45).contains(lifted)), "{noisy:?}");
    }

    #[test]
    fn a_twin_is_as_long_as_clock_and_losses_leave_it() {
        for digest in 1..30 {
            let copy = copies(digest, 1, &of(9))[EXCERPTS];
            let twin = samples(&copy, (digest, 1, "ac"), &deviations(1, &wave()), &wave());
            let share = twin.len() as f64 / 2000.0;
            assert!((0.83..1.07).contains(&share), "{share}");
            let rest = samples(&copy, (digest, 1, "ac"), &[0.0], &[0.25; 400]);
            let up: Vec<f32> = rest.iter().copied().filter(|x| *x != 0.25).collect();
            assert!(up.len() as f64 <= LIFTED * rest.len() as f64, "at rest on the surface");
            assert!(up.iter().all(|x| (0.0..0.02501).contains(x)), "no noise, but 20 dB weaker");
        }
    }
}
