//! The lags at which dependence is measured: each lag up to eight, then bins that grow with the lag.

/// Each lag up to this one, in frames, is a bin by itself.
const SINGLE: usize = 8;
/// Upper edge of a bin divided by its lower edge.
const RATIO: f64 = 1.15;
/// The longest lag is the length of a trial divided by this number.
const LONGEST: usize = 4;
/// A lag is at least this many times the stride (the distance between starts of pairs).
const STARTS_A_LAG: usize = 128;
/// Number of pairs of samples, over all trials together, that is enough for one lag.
const STARTS: usize = 20_000;

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Lag {
    /// The lag in frames, a multiple of `stride`.
    pub frames: usize,
    /// Distance from the start of one pair to that of the next, in frames; a power of two.
    pub stride: usize,
    /// Number of lags that this lag represents: half the distance between its neighbours.
    pub weight: f64,
}

/// Successive lags over which dependence is averaged.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Bin {
    /// Indices of the bin's lags in [`Lags::all`].
    pub lags: std::ops::Range<usize>,
    /// Geometric mean of the bin's lags.
    pub centre: f64,
}

/// All lags in ascending order, and their bins.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Lags {
    pub all: Vec<Lag>,
    pub bins: Vec<Bin>,
}

/// The lags for `trials` trials of `frames` frames, up to a quarter of a trial.
///
/// The stride of a lag t is the largest power of two that is at most t/128 and leaves 20,000
/// starts. Strides never fall with t, and each lag is a multiple of its stride. So starts, and the
/// samples one lag later, lie on one grid, which grows coarser with t.
pub(super) fn lags(trials: usize, frames: usize) -> Lags {
    let longest = frames / LONGEST;
    let stride = |t: usize| {
        let most = (t / STARTS_A_LAG).min(trials * (frames - longest) / STARTS).max(1);
        // The largest power of two that is at most `most`.
        1 << most.ilog2()
    };
    let mut lags = Lags { all: Vec::new(), bins: Vec::new() };
    for t in 1..=SINGLE.min(longest) {
        lags.push(&[(t, 1)]);
    }
    let (mut lower, mut last) = (SINGLE as f64 + 0.5, SINGLE);
    while lower * RATIO <= longest as f64 + 1.0 {
        // Three lags: the middle of each third of the bin.
        let mut bin = Vec::with_capacity(3);
        for third in [1.0, 3.0, 5.0] {
            let t = lower * RATIO.powf(third / 6.0);
            let stride = stride(t as usize);
            let t = (t / stride as f64).round() as usize * stride;
            if t > last && t <= longest {
                bin.push((t, stride));
                last = t;
            }
        }
        lags.push(&bin);
        lower *= RATIO;
    }
    let frames: Vec<f64> = lags.all.iter().map(|lag| lag.frames as f64).collect();
    for (i, lag) in lags.all.iter_mut().enumerate() {
        let before = if i == 0 { frames[0] - 1.0 } else { frames[i - 1] };
        let after = frames.get(i + 1).copied().unwrap_or(2.0 * frames[i] - before);
        lag.weight = 0.5 * (after - before);
    }
    lags
}

impl Lags {
    fn push(&mut self, bin: &[(usize, usize)]) {
        if bin.is_empty() {
            return;
        }
        let first = self.all.len();
        self.all.extend(bin.iter().map(|&(frames, stride)| Lag { frames, stride, weight: 0.0 }));
        let logs: f64 = bin.iter().map(|&(t, _)| (t as f64).ln()).sum();
        self.bins
            .push(Bin { lags: first..self.all.len(), centre: (logs / bin.len() as f64).exp() });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lags_rise_to_a_quarter_of_a_trial_and_stand_for_all_between() {
        for (trials, frames) in [(1, 40), (10, 1000), (10, 48_000), (5, 50_000)] {
            let lags = lags(trials, frames);
            assert!(lags.all.windows(2).all(|w| w[0].frames < w[1].frames));
            assert!(lags.all.iter().all(|l| l.frames % l.stride == 0));
            let last = lags.all.last().unwrap().frames;
            assert!(last <= frames / 4 && last as f64 > 0.8 * (frames / 4) as f64, "{last}");
            let total: f64 = lags.all.iter().map(|l| l.weight).sum();
            assert!((total / last as f64 - 1.0).abs() < 0.1, "{total} {last}");
            assert_eq!(lags.bins[0].lags, 0..1);
        }
    }

    #[test]
    fn long_lags_take_fewer_starts_but_never_fewer_than_20_000() {
        let lags = lags(10, 48_000);
        for lag in &lags.all {
            let starts = 10 * (48_000 - lag.frames) / lag.stride;
            assert!(lag.stride == 1 || starts >= STARTS, "{lag:?}");
            assert!(lag.stride == 1 || lag.frames >= STARTS_A_LAG * lag.stride / 2, "{lag:?}");
        }
        assert!(lags.all.last().unwrap().stride == 16);
    }
}
