//! Repeatable randomness: each generator is made from a seed and from a key that names its purpose.
//!
//! Seed and key alone decide which numbers are drawn. Results thus depend neither on the number of
//! threads nor on the order in which a library is read.

use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// 64-bit FNV-1a hash of `parts` and their lengths, so that ("ab", "c") and ("a", "bc") differ.
///
/// Unlike the standard library's hash, it is the same on all machines and in all versions.
pub(crate) fn stable_hash(parts: &[&[u8]]) -> u64 {
    const OFFSET: u64 = 0xcbf2_9ce4_8422_2325;
    const PRIME: u64 = 0x0000_0100_0000_01b3;
    let mut hash = OFFSET;
    for part in parts {
        for &byte in part.iter().chain(&(part.len() as u64).to_le_bytes()) {
            hash = (hash ^ u64::from(byte)).wrapping_mul(PRIME);
        }
    }
    hash
}

/// A random generator for one purpose. Equal `seed` and `key` give equal numbers on every machine.
pub fn rng(seed: u64, key: &[&[u8]]) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed ^ stable_hash(key))
}

/// A uniformly distributed number in [0, 1), with 53 random bits.
#[inline]
pub(crate) fn uniform(rng: &mut impl Rng) -> f64 {
    (rng.next_u64() >> 11) as f64 / (1u64 << 53) as f64
}

/// A standard normal number, from two independent uniform numbers (Box and Muller 1958).
pub fn normal(rng: &mut impl Rng) -> f64 {
    // 1 − u lies in (0, 1], so the logarithm is finite.
    let u = 1.0 - uniform(rng);
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * uniform(rng)).cos()
}

/// A nearly normal number, computed fast: the sum of four uniform numbers, scaled to mean 0 and
/// variance 1 (Irwin and Hall). Its magnitude is at most 3.47, its kurtosis 2.7.
#[inline]
pub(crate) fn nearly_normal(rng: &mut impl Rng) -> f32 {
    const SCALE: f32 = 1.732_050_8 / 65_536.0;
    let x = rng.next_u64();
    let sum = (x & 0xffff) + (x >> 16 & 0xffff) + (x >> 32 & 0xffff) + (x >> 48);
    (sum as f32 + 2.0 - 131_072.0) * SCALE
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_is_more_than_its_letters() {
        assert_ne!(stable_hash(&[b"ab", b"c"]), stable_hash(&[b"a", b"bc"]));
    }

    #[test]
    fn the_same_key_draws_the_same_numbers() {
        let draw = |seed, key: &str| rng(seed, &[key.as_bytes()]).next_u64();
        assert_eq!(draw(1, "mi2"), draw(1, "mi2"));
        assert_ne!(draw(1, "mi2"), draw(1, "mi1"));
        assert_ne!(draw(1, "mi2"), draw(2, "mi2"));
    }

    #[test]
    fn normal_numbers_have_mean_0_and_variance_1() {
        let mut rng = rng(1, &[b"test"]);
        let exact: Vec<f64> = (0..20_000).map(|_| normal(&mut rng)).collect();
        let nearly: Vec<f64> = (0..20_000).map(|_| f64::from(nearly_normal(&mut rng))).collect();
        for xs in [exact, nearly] {
            let mean = xs.iter().sum::<f64>() / xs.len() as f64;
            let variance = xs.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / xs.len() as f64;
            assert!(mean.abs() < 0.03 && (variance - 1.0).abs() < 0.05, "{mean} {variance}");
        }
    }
}
