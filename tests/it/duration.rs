//! `surfaced duration` and `surfaced dependence` from outside, and κ by gamma on many data sets.

use std::io::Write;
use std::path::{Path, PathBuf};

use crate::common::simulate;
use assert_cmd::Command;
use ndarray::Array2;
use surfaced::kernel::{
    Threshold, centred, kernel_matrix, length_scale, permuted, quantile, test_independence,
};
use surfaced::seed;

fn surfaced(args: &[&str]) -> (i32, String, String) {
    let output = Command::cargo_bin("surfaced").unwrap().args(args).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
}

/// A library of ten trials of two surfaces: `ir` in time, AR(1) with τ = 20 or 5 samples, and a
/// metal detector that says nothing.
fn library(folder: &Path) {
    let spec = hound::WavSpec {
        channels: 1,
        sample_rate: 10_000,
        bits_per_sample: 32,
        sample_format: hound::SampleFormat::Float,
    };
    let mut rng = seed::rng(1, &[b"library"]);
    for (surface, tau) in [("foam", 20.0), ("wire & mesh", 5.0)] {
        for trial in 1..=10 {
            let trial = folder.join(surface).join(trial.to_string());
            std::fs::create_dir_all(&trial).unwrap();
            let write = |name: &str, samples: Vec<f32>| {
                let mut wav = hound::WavWriter::create(trial.join(name), spec).unwrap();
                samples.into_iter().for_each(|x| wav.write_sample(x).unwrap());
                wav.finalize().unwrap();
            };
            write("ir.wav", simulate::ar1(12_000, tau, &mut rng));
            write("me.wav", vec![0.0; 12_000]);
        }
    }
}

fn json(text: &str) -> serde_json::Value {
    serde_json::from_str(text).unwrap()
}

/// The row of a surface and source in a report.
fn row<'a>(answer: &'a serde_json::Value, surface: &str, source: &str) -> &'a serde_json::Value {
    let rows = answer["durations"].as_array().unwrap();
    rows.iter().find(|r| r["surface"] == surface && r["source"] == source).unwrap()
}

#[test]
fn pooled_gives_t_star_its_bound_and_what_a_trial_is_worth_and_draws_the_curve() {
    let folder = tempfile::tempdir().unwrap();
    library(folder.path());
    let svg = folder.path().join("curve.svg");
    let (path, svg_path) = (folder.path().to_str().unwrap(), svg.to_str().unwrap());
    let (code, stdout, stderr) = surfaced(&["duration", path, "--json", "--svg", svg_path]);
    assert_eq!(code, 0, "{stderr}");
    let answer = json(&stdout);
    assert_eq!(answer["settings"], serde_json::json!({"rule": "pooled", "dependence": 0.1}));
    assert_eq!(answer["durations"].as_array().unwrap().len(), 4);
    for (surface, tau) in [("foam", 20.0), ("wire & mesh", 5.0)] {
        let found = row(&answer, surface, "ir");
        assert_eq!(found["rule"], "pooled");
        let number = |key: &str| found[key].as_f64().unwrap();
        let (t_star, upper) = (number("t_star_samples"), number("t_star_upper_samples"));
        assert!((1.9..2.9).contains(&(t_star / tau)) && upper >= t_star, "{found}");
        assert!((number("t_star_s") - t_star / 1e4).abs() < 1e-12);
        assert!((number("scan_s") - (0.0552 + 399.0 * upper / 1e4)).abs() < 1e-9);
        // 12,000 samples, of which 2τ are worth one.
        let worth = number("effective_samples") / (12_000.0 / (2.0 * tau));
        assert!((0.8..1.2).contains(&worth), "{worth}");
        assert!(number("effective_of_n") <= 400.0);
        assert!(number("lasting_share") < 0.01);
    }
    assert_eq!(answer["scan_s"], row(&answer, "foam", "ir")["scan_s"]);
    let metal = row(&answer, "foam", "me");
    for key in ["t_star_samples", "t_star_upper_samples", "t_star_s", "scan_s", "effective_samples"]
    {
        assert!(metal[key].is_null(), "{key}: {metal}");
    }
    assert!(metal["reason"].as_str().unwrap().contains("constant"));
    let drawn = std::fs::read_to_string(&svg).unwrap();
    assert!(drawn.starts_with("<svg") && drawn.contains("foam (Q = 10)"), "{drawn}");
    assert!(drawn.contains("the other surface") && drawn.contains("T* ="), "{drawn}");
    let (code, _, stderr) = surfaced(&["duration", path, "--source", "me", "--svg", svg_path]);
    assert!(code == 1 && stderr.contains("no surface and source has a curve"), "{stderr}");
}

#[test]
fn pooled_ends_with_what_t_star_means_for_each_source() {
    let folder = tempfile::tempdir().unwrap();
    library(folder.path());
    // A surface on which the sensor never changes has no T*.
    for trial in ["1", "2"] {
        let chalk = folder.path().join("chalk").join(trial);
        std::fs::create_dir_all(&chalk).unwrap();
        std::fs::copy(folder.path().join("foam/1/me.wav"), chalk.join("ir.wav")).unwrap();
    }
    let args = ["duration", folder.path().to_str().unwrap(), "--source", "ir"];
    let (code, stdout, stderr) = surfaced(&args);
    assert_eq!(code, 0, "{stderr}");
    let last = stdout.lines().find(|line| line.starts_with("ir:")).unwrap();
    assert!(last.contains("by less than a correlation of 0.1; a mean over a"), "{last}");
    assert!(last.contains("independent samples or more (foam)"), "{last}");
    assert!(
        last.contains("one of 400 samples of it") && last.contains("; no T* on chalk"),
        "{last}"
    );
}

#[test]
fn the_answer_is_how_long_to_drag_or_how_many_trials_are_lacking_for_it() {
    let folder = tempfile::tempdir().unwrap();
    library(folder.path());
    let path = folder.path().to_str().unwrap();
    let answer = |args: &[&str]| {
        let (code, stdout, stderr) = surfaced(&[&["duration", path, "--json"], args].concat());
        assert_eq!(code, 0, "{stderr}");
        json(&stdout)["answer"].clone()
    };
    let few = answer(&[]);
    assert!(few["scan_s"] == few["whole_s"] && few["trials"] == 20 && few["people"] == 1, "{few}");
    let more = few["more_trials"].as_u64().unwrap();
    assert!(few["reason"].as_str().unwrap().ends_with(&format!("record {more} more")), "{few}");
    let svg = folder.path().join("curve.svg");
    let found = answer(&["--accuracy", "0.9", "--svg", svg.to_str().unwrap()]);
    let drawn = std::fs::read_to_string(svg).unwrap();
    assert!(drawn.contains("scans named right") && drawn.contains("drag for"), "{drawn}");
    let number = |key: &str| found[key].as_f64().unwrap();
    assert!(number("scan_s") > 0.0 && number("scan_s") <= number("whole_s"), "{found}");
    assert!(number("accuracy_low") <= number("accuracy") && number("accuracy") >= 0.9, "{found}");
    assert!((number("whole_s") - 1.2).abs() < 1e-6 && found["target"] == 0.9, "{found}");
    let (_, stdout, _) = surfaced(&["duration", path, "--accuracy", "0.9", "--source", "ir"]);
    let mut lines = stdout.lines();
    let line = lines.next().unwrap();
    assert!(lines.next().unwrap().starts_with("ir: samples "), "{stdout}");
    assert!(
        line.starts_with("drag for at least ")
            && line.ends_with("(for this person, within one session)"),
        "{line}"
    );
}

#[test]
fn a_smaller_dependence_takes_longer_to_reach() {
    let folder = tempfile::tempdir().unwrap();
    library(folder.path());
    let path = folder.path().to_str().unwrap();
    let at = |dependence: &str| {
        let args = ["duration", path, "--source", "ir", "--dependence", dependence, "--json"];
        let (_, stdout, _) = surfaced(&args);
        row(&json(&stdout), "foam", "ir")["t_star_samples"].as_u64().unwrap()
    };
    assert!(at("0.5") < at("0.2"));
    let (code, _, stderr) = surfaced(&["duration", path, "--dependence", "2"]);
    assert!(code == 2 && stderr.contains("between 0 and 1"), "{stderr}");
}

#[test]
fn a_rule_takes_its_own_settings_alone() {
    let folder = tempfile::tempdir().unwrap();
    library(folder.path());
    let path = folder.path().to_str().unwrap();
    let (code, _, stderr) = surfaced(&["duration", path, "--gamma"]);
    assert!(code == 2 && stderr.contains("--rule mean-ci"), "{stderr}");
    let (code, _, stderr) =
        surfaced(&["duration", path, "--rule", "mean-ci", "--dependence", "0.2"]);
    assert!(code == 2 && stderr.contains("`pooled`"), "{stderr}");
}

#[test]
fn the_published_rule_gives_t_star_and_the_longest_scan_and_draws_the_curve() {
    let folder = tempfile::tempdir().unwrap();
    library(folder.path());
    let svg = folder.path().join("curve.svg");
    let (path, svg_path) = (folder.path().to_str().unwrap(), svg.to_str().unwrap());
    let args = ["duration", path, "--rule", "mean-ci", "--gamma", "--draws", "200", "--json"];
    let (code, stdout, stderr) = surfaced(&[&args[..], &["--svg", svg_path]].concat());
    assert_eq!(code, 0, "{stderr}");
    let answer = json(&stdout);
    let rows = answer["durations"].as_array().unwrap();
    assert_eq!(rows.len(), 4);
    let (foam, mesh) = (row(&answer, "foam", "ir"), row(&answer, "wire & mesh", "ir"));
    let lag = |row: &serde_json::Value| row["t_star_samples"].as_u64().unwrap();
    assert!(lag(foam) > 2 * lag(mesh), "{} {}", lag(foam), lag(mesh));
    let t_star_s = foam["t_star_s"].as_f64().unwrap();
    assert!((t_star_s - lag(foam) as f64 / 1e4).abs() < 1e-12);
    let scan_s = foam["scan_s"].as_f64().unwrap();
    assert!((scan_s - (0.0552 + 399.0 * t_star_s)).abs() < 1e-9);
    assert_eq!(answer["scan_s"], foam["scan_s"]);
    let metal = row(&answer, "foam", "me");
    assert!(metal["t_star_samples"].is_null() && metal["scan_s"].is_null());
    assert!(metal["reason"].as_str().unwrap().contains("constant"));
    let drawn = std::fs::read_to_string(svg).unwrap();
    assert!(drawn.contains("T* =") && drawn.contains("wire &amp; mesh · ir (Q = 10)"), "{drawn}");
}

#[test]
fn a_figure_named_pdf_is_a_pdf_with_its_font_or_refused_before_the_work() {
    let folder = tempfile::tempdir().unwrap();
    library(folder.path());
    let pdf = folder.path().join("curve.pdf");
    let args = ["duration", folder.path().to_str().unwrap(), "--width", "85mm", "--out"];
    let (code, _, stderr) = surfaced(&[&args[..], &[pdf.to_str().unwrap()]].concat());
    if cfg!(not(feature = "pdf")) {
        assert!(code == 2 && stderr.contains("--features pdf") && !pdf.exists(), "{stderr}");
        return;
    }
    if stderr.contains("this machine has none of Arial") {
        let _ =
            writeln!(std::io::stderr(), "SKIPPED: a PDF, since this machine has no font for it");
        return;
    }
    assert_eq!(code, 0, "{stderr}");
    let bytes = std::fs::read(&pdf).unwrap();
    let holds = |part: &str| bytes.windows(part.len()).any(|window| window == part.as_bytes());
    assert!(holds("%PDF-") && holds("/FontFile") && holds("/ToUnicode"), "no font is embedded");
    // 85 mm in points of 1/72 inch.
    assert!(holds("240.94"), "another width than was asked for");
}

#[test]
fn an_unknown_surface_user_or_source_is_named() {
    let folder = tempfile::tempdir().unwrap();
    library(folder.path());
    let path = folder.path().to_str().unwrap();
    let (code, _, stderr) = surfaced(&["duration", path, "--surface", "oak"]);
    assert!(
        code == 1 && stderr.contains("`oak`") && stderr.contains("foam, wire & mesh"),
        "{stderr}"
    );
    let (code, _, stderr) = surfaced(&["duration", path, "--user", "nobody"]);
    assert!(code == 1 && stderr.contains("user `nobody`; there are: expert"), "{stderr}");
    let (code, _, stderr) = surfaced(&["duration", path, "--source", "ca1"]);
    assert!(code == 1 && stderr.contains("image"), "{stderr}");
    let (code, _, stderr) = surfaced(&["duration", path, "--rule", "mean-ci", "--source", "mi2"]);
    assert!(code == 1 && stderr.contains("not of domain `time`"), "{stderr}");
    assert!(stderr.contains("--as-time"), "{stderr}");
}

#[test]
fn dependence_agrees_with_the_golden_values() {
    let golden = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/golden");
    for line in std::fs::read_to_string(golden.join("hsic_cases.csv")).unwrap().lines().skip(1) {
        let fields: Vec<&str> = line.split(',').collect();
        let want = |i: usize| fields[i].parse::<f64>().unwrap();
        let side = |s: &str| golden.join(format!("hsic_{}_{s}.csv", fields[0]));
        let (x, y) = (side("x"), side("y"));
        let args = ["dependence", x.to_str().unwrap(), y.to_str().unwrap(), "--json"];
        let (code, stdout, stderr) = surfaced(&args);
        assert_eq!(code, 0, "{stderr}");
        let got = json(&stdout);
        for (key, i) in [("n", 1), ("sigma_x", 3), ("sigma_y", 4), ("hsic", 5)] {
            let got = got[key].as_f64().unwrap();
            assert!((got / want(i) - 1.0).abs() < 1e-9, "case {} {key}: {got}", fields[0]);
        }
        let kappa = got["kappa"].as_f64().unwrap();
        assert!((kappa - want(6)).abs() < 3.0 * want(7), "case {}: {kappa}", fields[0]);
    }
}

#[test]
fn dependence_refuses_what_cannot_be_tested() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let good = file("good.csv", "1\n2\n4\n3\n7\n5\n");
    for (name, text, complaint) in [
        ("constant.csv", "1\n1\n1\n1\n1\n1\n", "constant"),
        ("short.csv", "1\n2\n", "expected pairs"),
        ("nan.csv", "1\nNaN\n1\n1\n1\n1\n", "line 2"),
    ] {
        let (code, _, stderr) = surfaced(&["dependence", &good, &file(name, text)]);
        assert!(code == 1 && stderr.contains(complaint), "{name}: {stderr}");
    }
    let few = file("few.csv", "1\n2\n3\n4\n");
    let (code, _, stderr) = surfaced(&["dependence", &few, &few]);
    assert!(code == 1 && stderr.contains("at least 5"), "{stderr}");
}

/// Q pairs: AR(1) noise, dependent or not, smooth or with ties, one channel or two.
fn pairs(q: usize, case: u64) -> [Array2<f64>; 2] {
    let mut rng = seed::rng(case, &[b"pairs"]);
    let channels = 1 + (case % 2) as usize;
    let rho = [0.0, 0.5, 0.95][(case / 2 % 3) as usize];
    let shape = (q, channels);
    let x = Array2::from_shape_simple_fn(shape, || simulate::normal(&mut rng));
    let noise = Array2::from_shape_simple_fn(shape, || simulate::normal(&mut rng));
    let y = &x * rho + &noise * f64::sqrt(1.0 - rho * rho);
    match case / 6 % 3 {
        0 => [x, y],
        1 => [x.mapv(f64::exp), y],
        _ => [x.mapv(|v| (2.0 * v).round()), y.mapv(|v| (2.0 * v).round())],
    }
}

#[test]
fn kappa_by_gamma_is_that_of_20_000_permutations() {
    for (q, median_bound, largest_bound) in [(10, 0.03, 0.1), (20, 0.03, 0.03), (50, 0.03, 0.03)] {
        let cases = if q == 50 { 18 } else { 54 };
        let mut off: Vec<f64> = (0..cases)
            .map(|case| {
                let [x, y] = pairs(q, case);
                let mut rng = seed::rng(case, &[b"kappa"]);
                let k = centred(kernel_matrix(x.view(), length_scale(x.view())));
                let l = kernel_matrix(y.view(), length_scale(y.view()));
                let want = quantile(permuted(&k, &l, 20_000, &mut rng), 0.05);
                let gamma = Threshold::Gamma;
                let got = test_independence(x.view(), y.view(), 0.05, gamma, &mut rng).unwrap();
                (got.kappa / want - 1.0).abs()
            })
            .collect();
        off.sort_unstable_by(f64::total_cmp);
        let (median, largest) = (off[off.len() / 2], off[off.len() - 1]);
        println!(
            "Q = {q}: {cases} data sets, off by {median:.4} in the median, {largest:.4} at most"
        );
        assert!(median < median_bound && largest < largest_bound, "Q = {q}: {median} {largest}");
    }
}
