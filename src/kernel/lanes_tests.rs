use super::*;

/// Points on a lattice or spread out, `C` channels, deterministic.
fn lanes(points: usize, channels: usize, spread: f64, step: f64) -> PaddedPoints {
    let mut lanes = PaddedPoints::default();
    lanes.fill(channels, 1.0, |c| {
        (0..points).map(move |i| {
            let x = ((i * (7 + 2 * c) + 3 * c) as f64 * 0.618_033_988_7).fract() * spread;
            if step > 0.0 { (x / step).round() * step } else { x }
        })
    });
    lanes
}

/// The definition, in f64, on the very coordinates that were filled in.
fn plain_sum(a: &PaddedPoints, b: &PaddedPoints) -> f64 {
    let padded = |l: &PaddedPoints| l.points.next_multiple_of(LANES);
    let mut total = 0.0;
    for i in 0..a.points {
        for j in 0..b.points {
            let q: f64 = (0..a.channels)
                .map(|c| {
                    let (x, y) = (a.values[c * padded(a) + i], b.values[c * padded(b) + j]);
                    (f64::from(x) - f64::from(y)).powi(2)
                })
                .sum();
            total += (-q / 16.0).exp2();
        }
    }
    total
}

#[test]
fn exp2_is_good_to_2e_7() {
    for i in 0..1_260_000 {
        let q = i as f32 * 1.6e-3;
        let exact = (-f64::from(q) / 16.0).exp2();
        let error = (f64::from(exp2_of_minus_sixteenths::<false>(q)) - exact).abs() / exact;
        assert!(error < 2e-7, "2^-{q}/16: {error}");
    }
}

#[test]
fn every_single_value_is_good_to_3e_7() {
    for &set in InstructionSet::available() {
        for i in 0..40_000 {
            let (mut a, mut b) = (PaddedPoints::default(), PaddedPoints::default());
            let x = f64::from(i as f32 * 1.1e-3);
            a.fill(1, 1.0, |_| [0.0].into_iter());
            b.fill(1, 1.0, |_| [x; 16].into_iter());
            let error = lane_sum_with(set, &a, &b) / plain_sum(&a, &b) - 1.0;
            // Far out, rounding q = x² in f32 weighs more than the polynomial.
            let bound = 3e-7 + 4e-9 * x * x;
            assert!(error.abs() < bound, "{set:?} at {x}: {error:e}");
        }
    }
}

#[test]
fn with_several_channels_every_value_is_good_to_what_its_distance_from_the_centre_allows() {
    for &set in InstructionSet::available() {
        for channels in 2..=4 {
            for i in 0..4_000 {
                let place = |k: usize, c: usize| {
                    let x = ((i * (3 + 2 * c) + k) as f64 * 0.618_033_988_7).fract() - 0.5;
                    x * (i % 40) as f64
                };
                let (mut a, mut b) = (PaddedPoints::default(), PaddedPoints::default());
                a.fill(channels, 1.0, |c| [place(0, c); 16].into_iter());
                b.fill(channels, 1.0, |c| [place(0, c) + 0.4 * place(7, c); 16].into_iter());
                let error = lane_sum_with(set, &a, &b) / plain_sum(&a, &b) - 1.0;
                let squared: f64 = (0..channels)
                    .map(|c| place(0, c).powi(2) + (place(0, c) + 0.4 * place(7, c)).powi(2))
                    .sum();
                let bound = 9e-7 + 5e-9 * squared;
                assert!(error.abs() < bound, "{set:?} {channels} at {squared}: {error:e}");
            }
        }
    }
}

#[test]
fn sums_over_spread_out_points_are_good_to_2e_7() {
    for &set in InstructionSet::available() {
        for channels in 1..=4 {
            // At 400 but a few pairs are in reach, and errors hardly average out.
            for (spread, bound) in
                [(3.0, 2e-7), (9.0, 2e-7), (14.0, 2e-7), (30.0, 2e-7), (400.0, 6e-7)]
            {
                let (a, b) = (lanes(400, channels, spread, 0.0), lanes(384, channels, spread, 0.0));
                let error = lane_sum_with(set, &a, &b) / plain_sum(&a, &b) - 1.0;
                let what = format!("{set:?} {channels} × {spread}: {error:e}");
                assert!(error.abs() < bound, "{what}");
            }
        }
    }
}

#[test]
fn a_self_sum_is_the_sum_with_itself() {
    for &set in InstructionSet::available() {
        for points in [1, 15, 16, 17, 90, 400] {
            for channels in 1..=4 {
                let a = lanes(points, channels, 9.0, 0.0);
                let half = lane_self_sum_with(set, &a);
                let error = half / plain_sum(&a, &a) - 1.0;
                assert!(error.abs() < 4e-7, "{set:?} {points} × {channels}: {error:e}");
            }
        }
    }
}

#[test]
fn intrinsics_agree_with_plain_rust_on_lattices_and_outliers() {
    for channels in 1..=4 {
        for step in [0.1, 0.5, 1.0] {
            let mut a = lanes(400, channels, 20.0, step);
            let b = lanes(399, channels, 20.0, step);
            let all = |a: &PaddedPoints| {
                let sum = |&set| lane_sum_with(set, a, &b);
                InstructionSet::available().iter().map(sum).collect::<Vec<f64>>()
            };
            let sums = all(&a);
            assert!(sums.iter().all(|x| (x / sums[0] - 1.0).abs() < 1e-6), "{sums:?}");
            a.fill(channels, 1.0, |_| [1e30, -1e300, 5.0, 1e9].into_iter());
            let sums = all(&a);
            assert!(sums.iter().all(|x| x.is_finite() && (x / sums[0] - 1.0).abs() < 1e-6));
        }
    }
}

#[test]
fn far_points_add_nothing() {
    let one = lanes(1, 1, 0.0, 0.0);
    for &set in InstructionSet::available() {
        let sum = lane_sum_with(set, &one, &one);
        assert!((sum - 1.0).abs() < 1e-9, "{sum}");
    }
}
