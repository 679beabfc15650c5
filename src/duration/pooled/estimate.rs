//! T* of recordings, thinned as far as its precision allows.

use super::features::Samples;
use super::{PooledAnswer, pooled};
use crate::trial::Series;

/// Threshold: the dependence of a Gaussian process with this correlation is small enough.
pub const CORRELATION: f64 = 0.1;
/// Most values of a channel that are used, over all trials: about 10 trials of 4.8 s at 10 kHz.
pub const VALUES: usize = 500_000;
/// If T* is shorter than this number of thinned frames, frames are thinned less.
const RESOLUTION: f64 = 32.0;

/// Dependence of samples a lag apart.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct PooledDependence {
    /// Lag in samples.
    pub lag_samples: f64,
    /// Lag in seconds.
    pub lag_s: f64,
    /// The measured dependence, as the correlation of a Gaussian process with as much dependence.
    pub dependence: f64,
    /// The monotone fit, which never rises with the lag, and from which T* is read.
    pub fitted: f64,
    /// Lower end of the fit's 90 % interval.
    pub low: f64,
    /// Upper end of that interval.
    pub high: f64,
}

/// The result of `pooled`. Lags and lengths are in samples of the source.
#[derive(Clone, Debug, PartialEq)]
pub struct PooledEstimate {
    /// T*, or why there is none.
    pub answer: PooledAnswer,
    /// k, where every k-th sample was used.
    pub step: usize,
    /// Longest T* that these trials can show.
    pub range: f64,
    /// Number of samples that together count as one independent sample.
    pub inflation: Option<f64>,
    /// Share of the variance that is due to lasting differences between trials.
    pub lasting_share: Option<f64>,
    /// Dependence at each lag, for the pair of channels with the longest T*.
    pub curve: Vec<PooledDependence>,
}

impl PooledEstimate {
    /// T* in samples: the smallest whole lag from which on the dependence is small.
    pub fn t_star_samples(&self) -> Option<usize> {
        match self.answer {
            PooledAnswer::Found { t_star, .. } => Some(t_star.ceil() as usize),
            _ => None,
        }
    }

    /// Upper bound of T*, in samples: the spacing to use.
    pub fn upper_samples(&self) -> Option<usize> {
        match self.answer {
            PooledAnswer::Found { upper, .. } => Some(upper.ceil() as usize),
            _ => None,
        }
    }

    /// Effective number of independent samples among `samples` consecutive samples.
    pub fn effective_samples(&self, samples: usize) -> Option<f64> {
        self.inflation.map(|inflation| samples as f64 / inflation)
    }
}

/// T* from the first `frames` frames of trials of one rate and number of channels, for a threshold
/// `correlation`; `None` if nothing changes in the trials.
///
/// Uses every k-th frame, so that a channel has at most about `values` values: the error of T*
/// depends on how often T* fits into the recordings, hardly on how many samples lie within T*. If
/// T* is shorter than 32 thinned frames, k was too large; a smaller k is computed from T*, and the
/// last `values`·k of all these frames are used. Frames are dropped, not averaged, since the
/// dependence of the original samples is wanted.
pub fn at_needed_rate(
    series: &[Series],
    frames: usize,
    correlation: f64,
    values: usize,
) -> Option<PooledEstimate> {
    let rate_hz = series.first()?.rate_hz();
    let mut step = (series.len() * frames).div_ceil(values);
    let found = pooled(&Samples::every(step, 0..frames, series), correlation, step, rate_hz)?;
    if let PooledAnswer::Found { t_star, .. } = found.answer
        && t_star < RESOLUTION * step as f64
        && step > 1
    {
        step = ((t_star / RESOLUTION) as usize).max(1);
        let kept = frames.min(values * step / series.len());
        let samples = Samples::every(step, frames - kept..frames, series);
        return pooled(&samples, correlation, step, rate_hz).or(Some(found));
    }
    Some(found)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::duration::simulate;

    fn ar1(tau: f64, count: usize, frames: usize, seed: u64) -> Vec<Series> {
        let mut rng = crate::seed::rng(seed, &[b"pooled"]);
        simulate::trials(count, 1e4, || simulate::ar1(frames, tau, &mut rng)).unwrap()
    }

    #[test]
    fn t_star_is_where_the_autocorrelation_has_fallen_to_a_tenth() {
        for (tau, count, frames) in [(5.0, 10, 12_000), (20.0, 10, 24_000), (20.0, 1, 48_000)] {
            let series = ar1(tau, count, frames, 1);
            let got = at_needed_rate(&series, frames, CORRELATION, VALUES).unwrap();
            let (t_star, upper) = (got.t_star_samples().unwrap(), got.upper_samples().unwrap());
            let in_tau = t_star as f64 / tau;
            assert!((2.0..2.8).contains(&in_tau) && upper >= t_star, "{tau}: {in_tau} {upper}");
            let inflation = got.inflation.unwrap() / (2.0 * tau);
            assert!((0.85..1.15).contains(&inflation), "{inflation}");
        }
    }

    #[test]
    fn a_larger_dependence_is_reached_sooner() {
        let series = ar1(50.0, 10, 12_000, 2);
        let at = |correlation| {
            at_needed_rate(&series, 12_000, correlation, VALUES).unwrap().t_star_samples().unwrap()
        };
        let (half, tenth) = (at(0.5) as f64, at(0.1) as f64);
        assert!((half / 50.0 - 0.69).abs() < 0.15 && tenth > 2.0 * half, "{half} {tenth}");
    }

    #[test]
    fn long_recordings_are_thinned_until_t_star_is_coarse_and_no_further() {
        for (tau, steps) in [(300.0, 18..=18), (20.0, 1..=3), (0.0, 1..=1)] {
            let series = ar1(tau, 6, 60_000, 3);
            let got = at_needed_rate(&series, 60_000, CORRELATION, 20_000).unwrap();
            assert!(steps.contains(&got.step), "{}", got.step);
            let t_star = got.t_star_samples().unwrap() as f64;
            assert!((t_star - f64::max(1.0, 2.3 * tau)).abs() <= 0.4 * tau, "{tau}: {t_star}");
        }
    }

    #[test]
    fn noise_is_independent_at_once_a_sine_never_and_little_data_say_nothing() {
        let mut rng = crate::seed::rng(4, &[b"pooled"]);
        let noise = ar1(0.0, 5, 4000, 4);
        let got = |series: &[Series], frames| {
            at_needed_rate(series, frames, CORRELATION, VALUES).unwrap().answer
        };
        assert_eq!(got(&noise, 4000), PooledAnswer::Found { t_star: 1.0, upper: 1.0 });
        let sines = simulate::trials(5, 1e4, || simulate::sine(4000, 210.0, &mut rng)).unwrap();
        assert_eq!(got(&sines, 4000), PooledAnswer::Never);
        let slow = ar1(300.0, 3, 4000, 5);
        assert!(matches!(got(&slow, 4000), PooledAnswer::TooLittleData { more_trials: 1.. }));
    }

    #[test]
    fn two_channels_depend_on_each_other_though_neither_on_itself() {
        let mut rng = crate::seed::rng(5, &[b"pooled"]);
        let make = || {
            let x = simulate::ar1(6000, 0.0, &mut rng);
            let y = simulate::ar1(6000, 0.0, &mut rng);
            (0..6000).flat_map(|i| [x[i], if i < 5 { y[i] } else { x[i - 5] + y[i] }]).collect()
        };
        let series: Vec<Series> = std::iter::repeat_with(make)
            .take(8)
            .map(|samples| Series::new(1e4, 2, samples).unwrap())
            .collect();
        let got = at_needed_rate(&series, 6000, CORRELATION, VALUES).unwrap();
        assert_eq!(got.t_star_samples(), Some(6));
    }

    #[test]
    fn a_constant_source_has_no_answer() {
        let flat = vec![Series::new(1e4, 1, vec![2.0; 500]).unwrap(); 6];
        assert_eq!(at_needed_rate(&flat, 500, CORRELATION, VALUES), None);
    }
}
