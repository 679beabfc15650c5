//! What the blocks of a window add up to, and its statistics.

use super::block_layout::{LAGS, OF_CHANNEL, Of, place, products, width};

/// Keeps logarithms finite: far below a 24-bit converter's step.
const FLOOR: f64 = 1e-9;

/// Statistics of one channel: see [`WindowStatistics::moments`].
pub const MOMENTS: [&str; 9] = [
    "ln of the standard deviation",
    "skewness, cube root",
    "ln of the kurtosis",
    "ln of peak over deviation (crest)",
    "ln of deviation over mean magnitude (shape)",
    "ln of peak over squared mean root (clearance)",
    "ln of the rate of mean crossings in Hz",
    "ln of the deviation of differences over that of values",
    "ln of the deviation of the level over blocks",
];

/// What some blocks add up to: those that move, if any does. Blocks where every channel rests are
/// gaps that a line has filled with its last value.
#[derive(Clone, Debug)]
pub struct WindowSums {
    channels: usize,
    /// Whether some block moved.
    moved: bool,
    sums: Vec<f64>,
}

impl WindowSums {
    /// Of no block.
    pub fn new(channels: usize) -> Self {
        let mut sums = vec![0.0; width(channels)];
        for c in 0..channels {
            sums[place(Of::Least, c)] = f64::INFINITY;
            sums[place(Of::Greatest, c)] = f64::NEG_INFINITY;
        }
        Self { channels, moved: false, sums }
    }

    /// Whether no channel ever moves.
    pub fn is_constant(&self) -> bool {
        let extreme = |of: Of, c: usize| self.sums[place(of, c)];
        (0..self.channels).all(|c| extreme(Of::Least, c) == extreme(Of::Greatest, c))
    }

    /// Adds a block.
    pub fn add(&mut self, of_block: &[f32]) {
        let (least, greatest) = (Of::Least as usize, Of::Greatest as usize);
        let extreme = |of: Of, c: usize| of_block[place(of, c)];
        let moves = (0..self.channels).any(|c| extreme(Of::Least, c) != extreme(Of::Greatest, c));
        if self.moved && !moves {
            return;
        }
        if moves && !self.moved {
            *self = Self { moved: true, ..Self::new(self.channels) };
        }
        let powers = 1..products(self.channels, 0);
        for (i, (sum, &x)) in self.sums.iter_mut().zip(of_block).enumerate() {
            let x = f64::from(x);
            let of = if powers.contains(&i) { (i - 1) % OF_CHANNEL } else { 0 };
            if of == least {
                *sum = sum.min(x);
            } else if of == greatest {
                *sum = sum.max(x);
            } else {
                *sum += x;
            }
        }
    }

    /// The statistics of these blocks together, of a series of `rate_hz`.
    pub fn statistics(&self, rate_hz: f64) -> WindowStatistics {
        let n = self.sums[0].max(1.0);
        let at = |of: Of, c: usize| self.sums[place(of, c)];
        let level: Vec<f64> = (0..self.channels).map(|c| at(Of::Sum, c) / n).collect();
        let covariances: Vec<Vec<f64>> =
            (0..LAGS).map(|lag| self.covariance(lag, n, &level)).collect();
        let mut moments = Vec::with_capacity(MOMENTS.len() * self.channels);
        let mut deviations = Vec::with_capacity(self.channels);
        for (c, &m) in level.iter().enumerate() {
            let own = |lag: usize| covariances[lag][c * self.channels + c];
            let variance = own(0).max(0.0);
            let deviation = variance.sqrt().max(FLOOR);
            let (second, third, fourth) =
                (variance + m * m, at(Of::Cubes, c) / n, at(Of::Fourths, c) / n);
            let skew = third - 3.0 * m * second + 2.0 * m.powi(3);
            let tail = fourth - 4.0 * m * third + 6.0 * m * m * second - 3.0 * m.powi(4);
            let peak = (at(Of::Greatest, c) - m).max(m - at(Of::Least, c)).max(FLOOR);
            let magnitude = (at(Of::Magnitude, c) / n).max(FLOOR);
            let root = (at(Of::Root, c) / n).powi(2).max(FLOOR);
            let step = (2.0 * (variance - own(1))).max(0.0).sqrt();
            let drift = (at(Of::SquaredLevel, c) / n - m * m).max(0.0).sqrt();
            moments.extend([
                deviation.ln(),
                (skew / deviation.powi(3)).cbrt(),
                (tail / deviation.powi(4)).max(FLOOR).ln(),
                (peak / deviation).ln(),
                (deviation / magnitude).ln(),
                (peak / root).ln(),
                ((at(Of::Crossings, c) + 1.0) * rate_hz / n).ln(),
                (step / deviation).max(FLOOR).ln(),
                drift.max(FLOOR).ln(),
            ]);
            deviations.push(deviation);
        }
        WindowStatistics { moments, deviations, means: level, covariances }
    }

    /// Γ(l)_ij, mean of (x_i(t) − m_i)·(x_j(t − l) − m_j).
    fn covariance(&self, lag: usize, n: f64, level: &[f64]) -> Vec<f64> {
        let at = products(self.channels, lag);
        let entry = |k: usize| {
            let (i, j) = (k / self.channels, k % self.channels);
            self.sums[at + k] / n - level[i] * level[j]
        };
        (0..self.channels * self.channels).map(entry).collect()
    }
}

/// Statistics of a window of a series.
#[derive(Clone, Debug)]
pub struct WindowStatistics {
    /// [`MOMENTS`], channel by channel.
    pub moments: Vec<f64>,
    /// Standard deviation of each channel; at least 1e-9.
    pub deviations: Vec<f64>,
    /// Mean of each channel, less the reference of its blocks.
    pub means: Vec<f64>,
    /// Γ(l) for lags of 0 to 3 samples, each of shape (C, C).
    pub covariances: Vec<Vec<f64>>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recognise::features::block_sums::BlockSums;
    use crate::recognise::features::block_sums::tests::series;

    fn statistics(sums: &BlockSums) -> WindowStatistics {
        sums.window(0..sums.blocks()).statistics(100.0)
    }

    #[test]
    fn statistics_are_those_of_their_definitions() {
        let (n, channels) = (1000, 2);
        let samples = series(n, channels);
        let sums = BlockSums::new(channels, 64, &samples);
        let stats = statistics(&sums);
        let channel = |c: usize| -> Vec<f64> {
            samples.iter().skip(c).step_by(channels).map(|&x| f64::from(x)).collect()
        };
        let mean = |x: &[f64]| x.iter().sum::<f64>() / x.len() as f64;
        for c in 0..channels {
            let x = channel(c);
            let m = mean(&x);
            let of = |f: &dyn Fn(f64) -> f64| mean(&x.iter().map(|x| f(x - m)).collect::<Vec<_>>());
            let deviation = of(&|x| x * x).sqrt();
            let peak = x.iter().map(|x| (x - m).abs()).fold(0.0, f64::max);
            let moments = &stats.moments[c * MOMENTS.len()..];
            assert!((stats.means[c] + f64::from(sums.reference()[c]) - m).abs() < 1e-5);
            assert!((moments[0] - deviation.ln()).abs() < 1e-4);
            assert!((moments[1].powi(3) - of(&|x| x.powi(3)) / deviation.powi(3)).abs() < 1e-3);
            assert!((moments[2].exp() - of(&|x| x.powi(4)) / deviation.powi(4)).abs() < 1e-3);
            assert!((moments[3].exp() - peak / deviation).abs() < 1e-3);
        }
        let (a, b) = (channel(0), channel(1));
        let (ma, mb) = (mean(&a), mean(&b));
        let lagged: f64 = (2..n).map(|t| (a[t] - ma) * (b[t - 2] - mb)).sum::<f64>() / n as f64;
        assert!((stats.covariances[2][1] - lagged).abs() < 2e-3, "{lagged}");
    }

    #[test]
    fn an_offset_costs_no_digits() {
        let samples = series(4000, 1);
        let shifted: Vec<f32> = samples.iter().map(|x| x + 500.0).collect();
        let (a, b) = (BlockSums::new(1, 128, &samples), BlockSums::new(1, 128, &shifted));
        let (a, b) = (statistics(&a), statistics(&b));
        for (a, b) in a.moments.iter().zip(&b.moments).take(6) {
            assert!((a - b).abs() < 0.01, "{a} vs {b}");
        }
    }

    #[test]
    fn constants_and_single_samples_have_finite_statistics() {
        for samples in [vec![0.5; 300], vec![1e30, -1e30, 0.0], vec![-1e-30; 5], vec![1.0, 2.0]] {
            let stats = statistics(&BlockSums::new(1, 16, &samples));
            let all = stats.moments.iter().chain(&stats.covariances[3]);
            assert!(all.chain(&stats.deviations).all(|x| x.is_finite()), "{stats:?}");
        }
    }
}
