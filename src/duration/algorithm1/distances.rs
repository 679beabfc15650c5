//! Squared distances of the trials' samples, and their medians, eight tests at a time.

use super::lanes::{F64Lanes, LANES, sort_lanes, sorting_network};

/// Largest number of distances that a sorting network is built for; more are gone through lane by
/// lane.
const LARGEST_NETWORK: usize = 1300;

/// The network that [`medians`] sorts `pairs` distances by; empty where there are too many.
pub(super) fn network_for(pairs: usize) -> Vec<(u32, u32)> {
    if pairs <= LARGEST_NETWORK { sorting_network(pairs) } else { Vec::new() }
}

/// Squared distances of all pairs of samples, each pair once.
#[inline(always)]
pub(super) fn distances(samples: &[F64Lanes], n: usize, channels: usize, out: &mut [F64Lanes]) {
    let mut pair = 0;
    for i in 0..n {
        for j in 0..i {
            let mut sum = [0.0; LANES];
            for c in 0..channels {
                let (a, b) = (&samples[i * channels + c], &samples[j * channels + c]);
                for lane in 0..LANES {
                    let d = a[lane] - b[lane];
                    sum[lane] += d * d;
                }
            }
            out[pair] = sum;
            pair += 1;
        }
    }
}

/// Median of the distances that are not zero, for each lane; infinite where none is left.
#[inline(always)]
pub(super) fn medians(
    distances: &[F64Lanes],
    network: &[(u32, u32)],
    sorted: &mut [F64Lanes],
) -> F64Lanes {
    let mut counts = [0usize; LANES];
    for (slot, d) in sorted.iter_mut().zip(distances) {
        for lane in 0..LANES {
            slot[lane] = if d[lane] > 0.0 { d[lane] } else { f64::INFINITY };
            counts[lane] += usize::from(d[lane] > 0.0);
        }
    }
    if network.is_empty() && distances.len() > 1 {
        return std::array::from_fn(|lane| median_by_selection(sorted, lane, counts[lane]));
    }
    sort_lanes(sorted, network);
    std::array::from_fn(|lane| {
        let count = counts[lane];
        let upper = sorted[count / 2][lane];
        match count {
            0 => f64::INFINITY,
            count if count % 2 == 1 => upper,
            count => 0.5 * (sorted[count / 2 - 1][lane] + upper),
        }
    })
}

/// Median of the `count` finite values of one lane.
fn median_by_selection(values: &[F64Lanes], lane: usize, count: usize) -> f64 {
    if count == 0 {
        return f64::INFINITY;
    }
    let mut one: Vec<f64> = values.iter().map(|v| v[lane]).collect();
    let (below, &mut upper, _) = one.select_nth_unstable_by(count / 2, f64::total_cmp);
    match below.iter().copied().max_by(f64::total_cmp) {
        Some(lower) if count.is_multiple_of(2) => 0.5 * (lower + upper),
        _ => upper,
    }
}
