//! Sums over the samples of a channel, in lanes that the processor adds at once.

use multiversion::multiversion;

/// Number of partial sums: their additions need not wait for each other.
const LANES: usize = 8;

/// Σ a·b of two lists of equal length.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
pub fn dot(a: &[f32], b: &[f32]) -> f64 {
    let mut lanes = [0f64; LANES];
    let (a, b) = (a.chunks_exact(LANES), b.chunks_exact(LANES));
    let rest = a.remainder().iter().zip(b.remainder());
    let rest: f64 = rest.map(|(&a, &b)| f64::from(a) * f64::from(b)).sum();
    for (a, b) in a.zip(b) {
        for ((lane, &a), &b) in lanes.iter_mut().zip(a).zip(b) {
            *lane += f64::from(a) * f64::from(b);
        }
    }
    lanes.iter().sum::<f64>() + rest
}

/// One channel of interleaved samples, minus a reference.
pub fn less(samples: &[f32], (channels, channel): (usize, usize), reference: f32) -> Vec<f32> {
    if channels == 1 {
        return samples.iter().map(|x| x - reference).collect();
    }
    samples.chunks_exact(channels).map(|frame| frame[channel] - reference).collect()
}

/// Σ x, Σ x³ and Σ x⁴.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
pub fn powers(x: &[f32]) -> [f64; 3] {
    let mut sums = [[0f64; LANES]; 3];
    let mut add = |lane: usize, x: f32| {
        let x = f64::from(x);
        let square = x * x;
        for (sum, power) in sums.iter_mut().zip([x, square * x, square * square]) {
            sum[lane] += power;
        }
    };
    let chunks = x.chunks_exact(LANES);
    chunks.remainder().iter().for_each(|&x| add(0, x));
    for chunk in chunks {
        (0..LANES).for_each(|lane| add(lane, chunk[lane]));
    }
    sums.map(|lanes| lanes.iter().sum())
}

/// Σ |x − m|, Σ √|x − m| and the number of crossings of m.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
pub fn about(x: &[f32], m: f32) -> [f64; 3] {
    let mut sums = [[0f32; LANES]; 2];
    let mut add = |lane: usize, x: f32| {
        let distance = (x - m).abs();
        sums[0][lane] += distance;
        sums[1][lane] += distance.sqrt();
    };
    let chunks = x.chunks_exact(LANES);
    chunks.remainder().iter().for_each(|&x| add(0, x));
    for chunk in chunks {
        (0..LANES).for_each(|lane| add(lane, chunk[lane]));
    }
    let later = x.get(1..).unwrap_or_default();
    let crosses = |(a, b): (&f32, &f32)| u32::from((*a < m) != (*b < m));
    let crossings: u32 = x.iter().zip(later).map(crosses).sum();
    let [magnitude, root] = sums.map(|lanes| lanes.iter().map(|&x| f64::from(x)).sum());
    [magnitude, root, f64::from(crossings)]
}
