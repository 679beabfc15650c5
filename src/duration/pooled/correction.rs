//! What taking each trial's mean out does to the covariance, put right.
//!
//! A trial's mean follows its own slow changes. Taken out, it lowers the covariance at every lag by
//! its own variance V, and long correlations look short. V follows from the covariance itself.

use super::covariance::Covariances;
use super::lags::Lag;

/// Variance of the trial mean, F × F:
///
/// V = [Γ(0) + Σ_{t≤M} w·(1 − t/L)·(G(t) + G(t)ᵀ)] / (L − 1 − 2·Σ_{t≤M} w·(1 − t/L)),
///
/// with G the mean covariance of the features at lag t, each trial's mean taken out, and w the
/// number of lags that t stands for. The denominator is L less what G itself lacks: G = Γ − V.
pub fn mean_variance(
    at_once: &[f64],
    covariances: &Covariances,
    lags: &[Lag],
    frames: usize,
    longest: f64,
) -> Vec<f64> {
    let count = covariances.features;
    let length = frames as f64;
    let mut one_way = vec![0.0; count * count];
    let mut taken = 0.0;
    for (lag, values) in lags.iter().zip(&covariances.lags) {
        if lag.frames as f64 > longest {
            break;
        }
        let weight = lag.weight * (1.0 - lag.frames as f64 / length);
        taken += weight;
        let scale = weight / covariances.blocks as f64;
        for block in values.chunks_exact(count * count) {
            one_way.iter_mut().zip(block).for_each(|(sum, c)| *sum += scale * c);
        }
    }
    let scale = 1.0 / (length - 1.0 - 2.0 * taken);
    (0..count * count)
        .map(|at| (at_once[at] + one_way[at] + one_way[at % count * count + at / count]) * scale)
        .collect()
}

/// (C + V)/√((1 + Vᵢᵢ)(1 + Vⱼⱼ)) of every block and lag: correlations of what was not centred.
pub fn corrected(covariances: &Covariances, mean_variance: &[f64]) -> Covariances {
    let count = covariances.features;
    let scale: Vec<f64> =
        (0..count).map(|i| (1.0 + mean_variance[i * count + i]).sqrt().recip()).collect();
    let scale: Vec<f64> =
        (0..count * count).map(|at| scale[at / count] * scale[at % count]).collect();
    let mut corrected = covariances.clone();
    for block in corrected.lags.iter_mut().flat_map(|lag| lag.chunks_exact_mut(count * count)) {
        for ((value, shift), scale) in block.iter_mut().zip(mean_variance).zip(&scale) {
            *value = (*value + shift) * scale;
        }
    }
    corrected
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Covariance of an AR(1) process of correlation time τ whose trial means were taken out.
    fn centred_ar1(tau: f64, frames: usize, lags: &[Lag]) -> (Covariances, f64) {
        let length = frames as f64;
        let rho = |t: f64| (-t / tau).exp();
        let v = (1..frames).map(|t| 2.0 * (1.0 - t as f64 / length) * rho(t as f64)).sum::<f64>();
        let v = (1.0 + v) / length;
        let value = |lag: &Lag| vec![(rho(lag.frames as f64) - v) / (1.0 - v)];
        let lags = lags.iter().map(value).collect();
        (Covariances { features: 1, blocks: 1, lags }, v)
    }

    #[test]
    fn the_correlation_of_a_slow_process_is_restored() {
        let (frames, tau) = (20_000, 600.0);
        let lags = super::super::lags::lags(1, frames).all;
        let (centred, v) = centred_ar1(tau, frames, &lags);
        assert!(v > 0.05);
        let got = mean_variance(&[1.0], &centred, &lags, frames, 5000.0);
        let restored = corrected(&centred, &got);
        for (lag, value) in lags.iter().zip(&restored.lags) {
            let want = (-(lag.frames as f64) / tau).exp();
            assert!((value[0] - want).abs() < 0.01, "{}: {} {want}", lag.frames, value[0]);
        }
    }
}
