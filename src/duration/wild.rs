//! The sums of the wild bootstrap: kernels, multipliers, quadratic forms.

use super::lanes::{LANES, Lane, exp_of_nonpositive};

/// Centred Gaussian kernel matrix, m × m, from squared distances.
pub(super) fn kernels(distances: &[f64], gamma: f64, m: usize, out: &mut [f64]) {
    let mut values = distances.chunks(LANES).flat_map(|chunk| {
        let mut lane = [0.0; LANES];
        lane.iter_mut().zip(chunk).for_each(|(l, d)| *l = d * gamma);
        exp_of_nonpositive(lane)
    });
    for i in 0..m {
        out[i * m + i] = 1.0;
        for j in 0..i {
            let value = values.next().unwrap_or(0.0);
            out[i * m + j] = value;
            out[j * m + i] = value;
        }
    }
    let means: Vec<f64> =
        out.chunks_exact(m).map(|row| row.iter().sum::<f64>() / m as f64).collect();
    let mean = means.iter().sum::<f64>() / m as f64;
    for (row, row_mean) in out.chunks_exact_mut(m).zip(&means) {
        for (value, column_mean) in row.iter_mut().zip(&means) {
            *value += mean - row_mean - column_mean;
        }
    }
}

/// Eight AR(1) sequences of correlation length `length`, less their means.
pub(super) fn multipliers(noise: &[Lane], length: f64, out: &mut [Lane]) {
    let phi = (-1.0 / length).exp();
    let gain = (1.0 - phi * phi).sqrt();
    let mut sum = [0.0; LANES];
    for i in 0..noise.len() {
        for lane in 0..LANES {
            let value = match i {
                0 => noise[0][lane],
                i => phi * out[i - 1][lane] + gain * noise[i][lane],
            };
            out[i][lane] = value;
            sum[lane] += value;
        }
    }
    let mean = sum.map(|s| s / noise.len() as f64);
    out.iter_mut().for_each(|w| (0..LANES).for_each(|lane| w[lane] -= mean[lane]));
}

/// Σᵢⱼ wᵢ·Mᵢⱼ·wⱼ of a symmetric matrix, for eight vectors at once.
pub(super) fn quadratic_form(matrix: &[f64], w: &[Lane]) -> Lane {
    let m = w.len();
    let mut total = [0.0; LANES];
    for i in 0..m {
        let row = &matrix[i * m..][..m];
        let mut sum = [0.0; LANES];
        for (value, other) in row[..i].iter().zip(w) {
            for lane in 0..LANES {
                sum[lane] += value * other[lane];
            }
        }
        for lane in 0..LANES {
            total[lane] += w[i][lane] * (2.0 * sum[lane] + row[i] * w[i][lane]);
        }
    }
    total
}
