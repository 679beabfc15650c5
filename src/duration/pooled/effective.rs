//! How many independent samples a stretch of a process is worth.

use super::covariance::Covariances;
use super::features::Features;
use super::lags::Lag;

/// Largest variance inflation over the features of one channel: the variance of a mean of many
/// samples over what it would be if they were independent. 2τ for an Ornstein–Uhlenbeck process.
///
/// It is the largest eigenvalue of I + Σ_{t≤M} w·(Γ(t) + Γ(t)ᵀ), Γ the corrected covariance. Each
/// channel has its own, and the worst counts. At least 1.
pub fn inflation(
    covariances: &Covariances,
    features: &Features,
    lags: &[Lag],
    longest: f64,
) -> f64 {
    let count = covariances.features;
    let mut sum = vec![0.0; count * count];
    for (lag, values) in lags.iter().zip(&covariances.lags) {
        if lag.frames as f64 > longest {
            break;
        }
        let scale = lag.weight / covariances.blocks as f64;
        for block in values.chunks_exact(count * count) {
            sum.iter_mut().zip(block).for_each(|(s, c)| *s += scale * c);
        }
    }
    (features.channels.iter())
        .map(|channel| {
            let size = channel.len();
            let matrix: Vec<f64> = (0..size * size)
                .map(|at| {
                    let (i, j) = (channel.start + at / size, channel.start + at % size);
                    f64::from(u8::from(i == j)) + sum[i * count + j] + sum[j * count + i]
                })
                .collect();
            largest_eigenvalue(&matrix, size)
        })
        .fold(1.0, f64::max)
}

/// Largest eigenvalue of a small symmetric matrix, by power iteration; shifted by its norm, which
/// makes the largest one the largest in size too.
fn largest_eigenvalue(matrix: &[f64], size: usize) -> f64 {
    let shift = matrix.iter().map(|x| x * x).sum::<f64>().sqrt();
    let mut vector: Vec<f64> = (0..size).map(|i| 1.0 + 0.1 * i as f64).collect();
    let mut value = 0.0;
    for _ in 0..500 {
        let next: Vec<f64> = (0..size)
            .map(|i| {
                let row = &matrix[i * size..(i + 1) * size];
                shift * vector[i] + row.iter().zip(&vector).map(|(a, b)| a * b).sum::<f64>()
            })
            .collect();
        let norm = next.iter().map(|x| x * x).sum::<f64>().sqrt();
        if norm == 0.0 {
            return 0.0;
        }
        value = norm - shift;
        vector = next.into_iter().map(|x| x / norm).collect();
    }
    value
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_eigenvalue_is_found_also_beside_a_larger_negative_one() {
        assert!((largest_eigenvalue(&[2.0, 1.0, 1.0, 2.0], 2) - 3.0).abs() < 1e-9);
        assert!((largest_eigenvalue(&[1.0, 0.0, 0.0, -9.0], 2) - 1.0).abs() < 1e-9);
        assert_eq!(largest_eigenvalue(&[4.0], 1), 4.0);
    }
}
