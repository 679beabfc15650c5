//! The best fit that never rises.

/// Least-squares fit of a sequence that never rises, by pooling adjacent violators (M. Ayer et al.,
/// Ann. Math. Statist. 26, 1955).
pub fn antitonic(values: &[f64]) -> Vec<f64> {
    // Mean and length of each level stretch so far.
    let mut levels: Vec<(f64, usize)> = Vec::new();
    for &value in values {
        let mut level = (value, 1);
        while let Some(&(before, length)) = levels.last()
            && before < level.0
        {
            levels.pop();
            let all = length + level.1;
            level = ((before * length as f64 + level.0 * level.1 as f64) / all as f64, all);
        }
        levels.push(level);
    }
    levels.into_iter().flat_map(|(mean, length)| std::iter::repeat_n(mean, length)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The minimax formula: max over later ends of min over earlier starts of the mean between.
    fn by_minimax(values: &[f64]) -> Vec<f64> {
        let mean = |a: usize, b: usize| values[a..=b].iter().sum::<f64>() / (b - a + 1) as f64;
        (0..values.len())
            .map(|i| {
                (0..=i)
                    .map(|a| {
                        (i..values.len()).map(|b| mean(a, b)).fold(f64::NEG_INFINITY, f64::max)
                    })
                    .fold(f64::INFINITY, f64::min)
            })
            .collect()
    }

    #[test]
    fn pooling_gives_the_minimax_fit() {
        let mut x = 12_345u64;
        for length in [0, 1, 2, 7, 30] {
            let values: Vec<f64> = (0..length)
                .map(|i| {
                    x = x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                    (x >> 40) as f64 / 1e7 - f64::from(i) * 0.03
                })
                .collect();
            let got = antitonic(&values);
            for (g, w) in got.iter().zip(by_minimax(&values)) {
                assert!((g - w).abs() < 1e-12);
            }
            assert!(got.windows(2).all(|w| w[0] >= w[1]) && got.len() == values.len());
        }
    }
}
