//! HSIC and its thresholds against the values of the authors' program.

use std::path::PathBuf;

use ndarray::Array2;
use surfaced::kernel::{Threshold, centred, kernel_matrix, permuted, quantile, test_independence};
use surfaced::seed;

struct Case {
    name: String,
    x: Array2<f64>,
    y: Array2<f64>,
    /// σ_x, σ_y, HSIC_b, mean of κ, sd of κ
    want: [f64; 5],
}

fn path(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(name)
}

fn matrix(name: &str) -> Array2<f64> {
    let text = std::fs::read_to_string(path(name)).unwrap();
    let rows: Vec<Vec<f64>> = text
        .lines()
        .map(|line| line.split(',').map(|x| x.trim().parse().unwrap()).collect())
        .collect();
    let shape = (rows.len(), rows[0].len());
    Array2::from_shape_vec(shape, rows.concat()).unwrap()
}

fn cases() -> Vec<Case> {
    let text = std::fs::read_to_string(path("hsic_cases.csv")).unwrap();
    text.lines()
        .skip(1)
        .map(|line| {
            let fields: Vec<&str> = line.split(',').collect();
            let number = |i: usize| fields[i].parse::<f64>().unwrap();
            Case {
                name: fields[0].into(),
                x: matrix(&format!("hsic_{}_x.csv", fields[0])),
                y: matrix(&format!("hsic_{}_y.csv", fields[0])),
                want: [3, 4, 5, 6, 7].map(number),
            }
        })
        .collect()
}

#[test]
fn hsic_and_its_length_scales_agree_to_1e_9() {
    let cases = cases();
    assert_eq!(cases.len(), 8);
    for case in cases {
        let mut rng = seed::rng(1, &[case.name.as_bytes()]);
        let (x, y) = (case.x.view(), case.y.view());
        let got = test_independence(x, y, 0.05, Threshold::Gamma, &mut rng).unwrap();
        for (got, want) in [got.sigma_x, got.sigma_y, got.hsic].into_iter().zip(case.want) {
            assert!((got / want - 1.0).abs() < 1e-9, "case {}: {got} {want}", case.name);
        }
    }
}

#[test]
fn kappa_by_permutations_lies_within_three_standard_deviations() {
    for case in cases() {
        let mut rng = seed::rng(2, &[case.name.as_bytes()]);
        let k = centred(kernel_matrix(case.x.view(), case.want[0]));
        let l = kernel_matrix(case.y.view(), case.want[1]);
        let (mean, sd) = (case.want[3], case.want[4]);
        let mut sum = 0.0;
        for _ in 0..100 {
            let kappa = quantile(permuted(&k, &l, 100, &mut rng), 0.05);
            // A hundred draws: the largest of them may lie further out than three.
            assert!((kappa - mean).abs() < 5.0 * sd, "case {}: {kappa} {mean}", case.name);
            sum += kappa;
        }
        // The mean of 100 draws against the mean of 400.
        let error = sd * (1.0f64 / 100.0 + 1.0 / 400.0).sqrt();
        assert!((sum / 100.0 - mean).abs() < 3.0 * error, "case {}: {}", case.name, sum / 100.0);
        let one = test_independence(
            case.x.view(),
            case.y.view(),
            0.05,
            Threshold::Permutations(100),
            &mut rng,
        )
        .unwrap();
        assert!((one.kappa - mean).abs() < 3.0 * sd, "case {}: {}", case.name, one.kappa);
    }
}

#[test]
fn kappa_by_gamma_agrees_with_20_000_permutations() {
    let mut off = Vec::new();
    for case in cases() {
        let mut rng = seed::rng(3, &[case.name.as_bytes()]);
        let k = centred(kernel_matrix(case.x.view(), case.want[0]));
        let l = kernel_matrix(case.y.view(), case.want[1]);
        let want = quantile(permuted(&k, &l, 20_000, &mut rng), 0.05);
        let (x, y) = (case.x.view(), case.y.view());
        let got = test_independence(x, y, 0.05, Threshold::Gamma, &mut rng).unwrap().kappa;
        println!("case {} n {}: {:+.2} %", case.name, case.x.nrows(), 100.0 * (got / want - 1.0));
        off.push((case.x.nrows(), (got / want - 1.0).abs()));
    }
    for (n, off) in off {
        assert!(off < if n < 20 { 0.1 } else { 0.03 }, "{n}: {off}");
    }
}
