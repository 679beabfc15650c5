//! Agreement with values from the authors' own program, to a relative 1e-9.

use std::path::Path;

use ndarray::Array2;
use surfaced::features::hsv;
use surfaced::recognise::{
    DomainSamples, QuerySet, SampleSet, Scratch, SumPrecision, image_grid, score_samples,
};
use surfaced::scene::Colour;
use surfaced::spectrum::amplitude_spectrum;
use surfaced::trial::Image;

const TOLERANCE: f64 = 1e-9;

fn table(name: &str) -> Vec<Vec<String>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(name);
    let text = std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    text.lines().map(|line| line.split(',').map(String::from).collect()).collect()
}

fn numbers(name: &str) -> Array2<f64> {
    let rows = table(name);
    let values = rows.iter().flatten().map(|x| x.trim().parse().unwrap()).collect();
    Array2::from_shape_vec((rows.len(), rows[0].len()), values).unwrap()
}

#[track_caller]
fn assert_agrees(what: &str, ours: f64, golden: f64) {
    let error = (ours - golden).abs() / golden.abs().max(f64::MIN_POSITIVE);
    assert!(error < TOLERANCE || ours == golden, "{what}: {ours} but golden {golden} ({error:e})");
}

#[test]
fn mmd_cases_agree() {
    for case in &table("mmd_cases.csv")[1..] {
        let (id, shift) = (&case[0], case[3] == "1");
        let z = numbers(&format!("mmd_{id}_z.csv"));
        let y = numbers(&format!("mmd_{id}_y.csv"));
        let result = score_samples(z.view(), y.view(), shift, None);
        assert_eq!(
            (result.dims.to_string(), result.n.to_string()),
            (case[1].clone(), case[2].clone())
        );
        assert_agrees(&format!("σ of case {id}"), result.sigma, case[4].parse().unwrap());
        assert_agrees(&format!("score of case {id}"), result.score, case[5].parse().unwrap());
    }
}

/// Holds every fast way of computing a score to its stated error, 1e-4 relative or absolute.
#[track_caller]
fn assert_fast(
    case: &str,
    z: &Array2<f64>,
    y: &Array2<f64>,
    shift: bool,
    sigma: Option<f64>,
    golden: f64,
) {
    let (z, y) = (SampleSet::new(z, sigma), SampleSet::new(y, sigma));
    let mut tabulated = y.clone();
    tabulated.tabulate();
    let query = QuerySet::new(&z, shift, SumPrecision::Fast);
    for y in [&y, &tabulated] {
        let score = query.score(y, &mut Scratch::default());
        let error = (score - golden).abs();
        assert!(error <= 1e-4 * golden.max(1.0), "case {case}: {score} but golden {golden}");
    }
}

#[test]
fn the_fast_path_keeps_its_stated_error_on_the_golden_cases() {
    for case in &table("mmd_cases.csv")[1..] {
        let z = numbers(&format!("mmd_{}_z.csv", case[0]));
        let y = numbers(&format!("mmd_{}_y.csv", case[0]));
        assert_fast(&case[0], &z, &y, case[3] == "1", None, case[5].parse().unwrap());
    }
    for case in &table("metal_cases.csv")[1..] {
        let z = numbers(&format!("metal_{}_z.csv", case[0]));
        let y = numbers(&format!("metal_{}_y.csv", case[0]));
        assert_fast(&case[0], &z, &y, false, Some(1.0), case[1].parse().unwrap());
    }
}

#[test]
fn metal_cases_agree_at_length_scale_one() {
    for case in &table("metal_cases.csv")[1..] {
        let z = numbers(&format!("metal_{}_z.csv", case[0]));
        let y = numbers(&format!("metal_{}_y.csv", case[0]));
        let result = score_samples(z.view(), y.view(), false, Some(1.0));
        let golden: f64 = case[1].parse().unwrap();
        // Case 01 compares identical data: our floor of rounding stands for its exact zero.
        assert!((result.score - golden).abs() <= TOLERANCE * golden.max(1e-2), "case {}", case[0]);
    }
}

#[test]
fn spectrum_agrees_bin_by_bin() {
    let x = numbers("spectrum_x.csv");
    let golden = numbers("spectrum_amp_0_7500Hz.csv");
    let ours =
        amplitude_spectrum(x.into_iter().collect::<Vec<_>>().into_iter(), 44_100.0, (0.0, 7500.0));
    assert_eq!(ours.len(), golden.len());
    for (bin, (ours, golden)) in ours.iter().zip(&golden).enumerate() {
        assert_agrees(&format!("bin {bin}"), *ours, *golden);
    }
}

#[test]
fn hsv_agrees() {
    for row in numbers("hsv.csv").rows() {
        let ours = hsv([row[0] as u8, row[1] as u8, row[2] as u8]);
        for c in 0..3 {
            let error = (ours[c] - row[3 + c]).abs();
            assert!(error <= TOLERANCE * row[3 + c].abs().max(1e-6), "{row}: {ours:?}");
        }
    }
}

fn image(value: impl Fn(usize, usize, usize) -> usize) -> DomainSamples {
    let bytes = (0..Image::ROWS).flat_map(|r| {
        let value = &value;
        (0..Image::COLS).flat_map(move |c| (0..3).map(move |ch| (value(r, c, ch) % 256) as u8))
    });
    DomainSamples::Pixels(
        Image::new(Image::COLS, Image::ROWS, bytes.collect()).unwrap(),
        Colour::Hsv,
    )
}

#[test]
fn image_cases_agree_in_value_and_order() {
    let z = image(|r, c, ch| 7 * r + 13 * c + 29 * ch + 3 * ((r * c) % 17));
    let y = image(|r, c, ch| 5 * r + 11 * c + 41 * ch + 4 * ((r + 2 * c) % 23));
    let first = numbers("image_z_first30_a1_b1.csv");
    let samples = z.at(&image_grid(1, 1));
    for ((row, channel), golden) in first.indexed_iter() {
        assert_agrees(&format!("pixel {row}"), samples[[row, channel]], *golden);
    }
    for case in &table("image_cases.csv")[1..] {
        let origin = image_grid(case[0].parse().unwrap(), case[1].parse().unwrap());
        let result = score_samples(z.at(&origin).view(), y.at(&origin).view(), false, None);
        assert_agrees("σ", result.sigma, case[2].parse().unwrap());
        assert_agrees("score", result.score, case[3].parse().unwrap());
    }
}
