//! Quantiles of the values and the steps of a growing series, from histograms, so that a look costs the
//! same at any time of a scan. A bin is an eighth of an octave of |x|, and x lies evenly within it.

use multiversion::multiversion;

/// The shares at which quantiles are taken.
const SHARES: [f32; QUANTILES] = [0.02, 0.1, 0.25, 0.5, 0.75, 0.9, 0.98];

/// Number of quantiles of the values of a channel, and of its steps.
pub(crate) const QUANTILES: usize = 7;

/// A bin holds the values whose bits are alike above this place: exponent and three bits.
const SHIFT: u32 = 20;

/// Bits of the least magnitude that does not count as 0, 2⁻³⁶. The greatest is 2²⁸ and counts for all above.
const FIRST: u32 = (127 - 36) << 3;
const BINS: usize = 64 << 3;

/// Histograms of x and of |step| for each channel: x below 0, the greatest magnitude first, x above 0,
/// then steps.
#[derive(Clone, Debug)]
pub(super) struct Histograms {
    counts: Vec<u32>,
}

impl Histograms {
    pub(super) fn new(channels: usize) -> Self {
        Self { counts: vec![0; 3 * BINS * channels] }
    }

    /// Counts a block. `planes` holds the samples of each channel minus its reference; the first `past` of
    /// them precede the block. `counts` tells whether the block counts, and whether the blocks before it do.
    pub(super) fn add(
        &mut self,
        (counts, earlier): (bool, bool),
        planes: &[Vec<f32>],
        past: usize,
    ) {
        if !earlier {
            self.counts.fill(0);
        }
        if !counts {
            return;
        }
        let mut places = Vec::new();
        for (bins, plane) in self.counts.chunks_exact_mut(3 * BINS).zip(planes) {
            let (bins, _) = bins.as_chunks_mut::<{ 3 * BINS }>();
            places_of(plane, past, &mut places);
            places.iter().for_each(|place| bins[0][usize::from(*place)] += 1);
        }
    }

    /// For each channel, the quantiles of its values, then of its steps.
    pub(super) fn quantiles(&self) -> Vec<f32> {
        let of_channel = |bins: &[u32]| {
            let (values, steps) = bins.split_at(2 * BINS);
            let value_edge = |place: usize| match place.checked_sub(BINS) {
                Some(bin) => edge(bin),
                None => -edge(BINS - place),
            };
            [quantiles(values, value_edge), quantiles(steps, edge)].concat()
        };
        self.counts.chunks_exact(3 * BINS).flat_map(of_channel).collect()
    }
}

/// The places of the values from the `past` on, and of the steps to them, among the bins of a channel.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn places_of(plane: &[f32], past: usize, places: &mut Vec<u16>) {
    let (values, steps) = (&plane[past..], &plane[past.saturating_sub(1)..]);
    places.clear();
    places.resize(values.len() + steps.len().saturating_sub(1), 0);
    let (of_values, of_steps) = places.split_at_mut(values.len());
    for i in 0..values.len() {
        let bin = bin_of(values[i].abs());
        let place = if values[i] < 0.0 { BINS as u32 - 1 - bin } else { BINS as u32 + bin };
        of_values[i] = place as u16;
    }
    for i in 0..of_steps.len().min(steps.len().saturating_sub(1)) {
        of_steps[i] = (2 * BINS as u32 + bin_of((steps[i + 1] - steps[i]).abs())) as u16;
    }
}

#[inline(always)]
fn bin_of(magnitude: f32) -> u32 {
    (magnitude.to_bits() >> SHIFT).saturating_sub(FIRST).min(BINS as u32 - 1)
}

/// Lower edge of a bin of magnitudes.
fn edge(bin: usize) -> f32 {
    if bin == 0 { 0.0 } else { f32::from_bits((FIRST + bin as u32) << SHIFT) }
}

/// Number of empty bins before the first that is not. Most are, so they are looked at in groups.
fn empty(counts: &[u32]) -> usize {
    let (groups, _) = counts.as_chunks::<16>();
    let is_empty = |group: &&[u32; 16]| group.iter().fold(0, |all, n| all | n) == 0;
    let from = 16 * groups.iter().take_while(is_empty).count();
    from + counts[from..].iter().take_while(|n| **n == 0).count()
}

/// The quantiles of a histogram whose bin i begins at `edge(i)`; 0 where it is empty.
fn quantiles(counts: &[u32], edge: impl Fn(usize) -> f32) -> [f32; QUANTILES] {
    let total = counts.iter().sum::<u32>() as f32;
    let (mut bin, mut below) = (0, 0.0);
    SHARES.map(|share| {
        let wanted = share * total;
        while bin + 1 < counts.len() && below + counts[bin] as f32 <= wanted {
            below += counts[bin] as f32;
            bin += 1;
            if below <= wanted {
                bin += empty(&counts[bin..counts.len() - 1]);
            }
        }
        if total == 0.0 {
            return 0.0;
        }
        let part = ((wanted - below) / counts[bin].max(1) as f32).clamp(0.0, 1.0);
        let (low, high) = (edge(bin), edge(bin + 1));
        low + part * (high - low)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_the_sorted_values_and_steps() {
        let series: Vec<f32> = (0..2000).map(|i| (i as f32 * 0.377).sin() * 3.0 - 0.1).collect();
        let mut histograms = Histograms::new(1);
        histograms.add((true, true), &[series[..700].to_vec()], 0);
        histograms.add((true, true), &[series[697..].to_vec()], 3);
        let found = histograms.quantiles();
        let mut values = series.clone();
        let mut steps: Vec<f32> = series.windows(2).map(|w| (w[1] - w[0]).abs()).collect();
        values.sort_by(f32::total_cmp);
        steps.sort_by(f32::total_cmp);
        for (k, share) in SHARES.iter().enumerate() {
            let value = values[(share * 2000.0) as usize];
            assert!((found[k] - value).abs() < 0.15, "{share}: {} vs {value}", found[k]);
            let step = steps[(share * 1999.0) as usize];
            assert!((found[QUANTILES + k] - step).abs() < 0.05, "{share}: step");
        }
        histograms.add((true, false), &[vec![0.0; 3]], 1);
        assert_eq!(histograms.quantiles()[QUANTILES + 3], edge(1) / 2.0, "only the last block");
    }

    #[test]
    fn any_finite_value_has_a_bin() {
        let mut histograms = Histograms::new(2);
        let planes = [vec![0.0, -0.0, 1e-38], vec![f32::MAX, f32::MIN, -1e-30]];
        histograms.add((true, true), &planes, 0);
        assert!(histograms.quantiles().iter().all(|x| x.is_finite()));
        assert!(Histograms::new(1).quantiles().iter().all(|x| *x == 0.0));
    }
}
