//! Values made Gaussian by their ranks, so that neither scale nor tails matter.

use statrs::distribution::{ContinuousCDF, Normal};

/// Φ⁻¹((r − ½)/N) of each value's midrank r among all N, over their standard deviation: mean 0,
/// variance 1, equal values equal. None where all values are equal.
///
/// # Panics
/// If there are 2³² values or more.
pub fn normal_scores(values: &[f32]) -> Option<Vec<f32>> {
    let count = values.len();
    assert!(u32::try_from(count).is_ok(), "the position of a value takes 32 bits");
    let mut order: Vec<u64> =
        values.iter().zip(0..).map(|(&x, i)| u64::from(ordered(x)) << 32 | i).collect();
    order.sort_unstable();
    let normal = Normal::standard();
    let mut scores = vec![0.0f32; count];
    let (mut first, mut sum, mut squares) = (0, 0.0, 0.0);
    while first < count {
        let value = order[first] >> 32;
        let ties = order[first..].iter().take_while(|&&o| o >> 32 == value).count();
        // The midrank of places first + 1 to first + ties, less a half.
        let score = normal.inverse_cdf((first as f64 + 0.5 * ties as f64) / count as f64);
        for &o in &order[first..first + ties] {
            scores[(o & 0xffff_ffff) as usize] = score as f32;
        }
        sum += score * ties as f64;
        squares += score * score * ties as f64;
        first += ties;
    }
    let mean = sum / count as f64;
    let variance = squares / count as f64 - mean * mean;
    if order.first().map(|o| o >> 32) == order.last().map(|o| o >> 32) {
        return None;
    }
    let scale = 1.0 / variance.sqrt();
    scores.iter_mut().for_each(|z| *z = ((f64::from(*z) - mean) * scale) as f32);
    Some(scores)
}

/// A number that orders as the value does; the two zeros are one.
fn ordered(x: f32) -> u32 {
    let bits = (x + 0.0).to_bits();
    if bits >> 31 == 1 { !bits } else { bits | 1 << 31 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Midranks by counting.
    fn by_counting(values: &[f32]) -> Vec<f64> {
        let n = values.len() as f64;
        let normal = Normal::standard();
        let z: Vec<f64> = values
            .iter()
            .map(|x| {
                let below = values.iter().filter(|y| *y < x).count() as f64;
                let ties = values.iter().filter(|y| *y == x).count() as f64;
                normal.inverse_cdf((below + 0.5 * ties) / n)
            })
            .collect();
        let mean = z.iter().sum::<f64>() / n;
        let deviation = (z.iter().map(|z| (z - mean).powi(2)).sum::<f64>() / n).sqrt();
        z.iter().map(|z| (z - mean) / deviation).collect()
    }

    #[test]
    fn scores_are_those_of_ranks_by_counting_ties_and_signs_included() {
        let values: Vec<f32> = (0..500u32)
            .map(|i| ((i * 7919 % 101) as f32 - 50.0) / 8.0 * ((i % 3) as f32))
            .collect();
        let got = normal_scores(&values).unwrap();
        for (g, w) in got.iter().zip(by_counting(&values)) {
            assert!((f64::from(*g) - w).abs() < 1e-5, "{g} {w}");
        }
        let zeros = normal_scores(&[-0.0, 0.0, 1.0, -1.0]).unwrap();
        assert_eq!(zeros[0], zeros[1]);
    }

    #[test]
    fn equal_values_have_no_scores() {
        assert_eq!(normal_scores(&[3.0; 9]), None);
        assert_eq!(normal_scores(&[]), None);
    }
}
