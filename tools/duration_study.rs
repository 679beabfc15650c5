//! The studies behind the documentation of `surfaced::duration`: processes of known correlation
//! time, noise, a sine, and real dragging sounds. Seeds are fixed; one thread.
//!
//!     cargo run --release --example duration_study            simulations
//!     cargo run --release --example duration_study -- DATA    real sounds: the folder that holds
//!                                                             SoundScans/

use std::collections::BTreeMap;
use std::path::Path;

use rand_chacha::ChaCha8Rng;
use surfaced::duration::{Estimate, Outcome, Rule, Search, Settings, Trials, simulate};
use surfaced::kernel::Threshold;
use surfaced::seed;
use surfaced::trial::Series;

type Failure = Box<dyn std::error::Error>;
const REPETITIONS: u64 = 50;
const RULES: [Rule; 2] = [Rule::Quantile, Rule::MeanCi];

fn main() -> Result<(), Failure> {
    match std::env::args().nth(1) {
        Some(folder) => sounds(Path::new(&folder)),
        None => simulations(),
    }
}

/// Both rules on `REPETITIONS` sets of trials of one process.
fn repeat(
    q: usize,
    name: &str,
    draws: usize,
    make: impl Fn(&mut ChaCha8Rng) -> Vec<f32>,
) -> Result<[Vec<Estimate>; 2], Failure> {
    let mut found = [Vec::new(), Vec::new()];
    for repetition in 0..REPETITIONS {
        let mut rng = seed::rng(repetition, &[b"study", name.as_bytes(), &q.to_le_bytes()]);
        let trials = Trials::new(simulate::trials(q, 1e4, || make(&mut rng))?)?;
        let settings = Settings {
            draws,
            threshold: Threshold::Gamma,
            seed: repetition,
            ..Settings::default()
        };
        let mut search = Search::new(&trials, settings)?;
        for (rule, found) in RULES.into_iter().zip(&mut found) {
            found.push(search.find(rule));
        }
    }
    Ok(found)
}

/// Where Algorithm 1 as printed stops.
fn first_stop(estimate: &Estimate) -> Option<usize> {
    match estimate.outcome {
        Outcome::Found { lag } | Outcome::Returns { first: lag, .. } => Some(lag),
        Outcome::NotInRange { .. } => None,
    }
}

fn simulations() -> Result<(), Failure> {
    println!("| process | Q | rule | T* = 1 sample | no T* |");
    println!("|---|---|---|---|---|");
    for (name, q) in [("noise", 10), ("noise", 30), ("sine", 10), ("sine", 30)] {
        let found = repeat(q, name, 200, |rng| match name {
            "noise" => simulate::ar1(22_000, 0.0, rng),
            _ => simulate::sine(22_000, 210.0, rng),
        })?;
        for (rule, estimates) in RULES.into_iter().zip(found) {
            let count = |wanted: Option<usize>| {
                100 * estimates.iter().filter(|e| e.t_star() == wanted).count() / estimates.len()
            };
            println!("| {name} | {q} | {rule} | {} % | {} % |", count(Some(1)), count(None));
        }
    }
    println!("\n| process | Q | rule | T* median (5–95 %) | stops too early | no T* |");
    println!("|---|---|---|---|---|---|");
    let cases =
        [(20.0, 10), (20.0, 30), (20.0, 100), (100.0, 10), (100.0, 20), (100.0, 30), (100.0, 50)];
    for (tau, q) in cases {
        let draws = if q > 50 { 100 } else { 200 };
        let found = repeat(q, "ar1", draws, |rng| simulate::ar1(22_000, tau, rng))?;
        for (rule, estimates) in RULES.into_iter().zip(found) {
            let mut lags: Vec<usize> = estimates.iter().filter_map(Estimate::t_star).collect();
            lags.sort_unstable();
            let at = |share: f64| match lags.len() {
                0 => "–".into(),
                n => lags[((n - 1) as f64 * share).round() as usize].to_string(),
            };
            let early = (estimates.iter().filter_map(first_stop))
                .filter(|&lag| (-(lag as f64) / tau).exp() > 0.1)
                .count();
            println!(
                "| AR(1), τ = {tau} | {q} | {rule} | {} ({}–{}) | {} % | {} % |",
                at(0.5),
                at(0.05),
                at(0.95),
                100 * early / estimates.len(),
                100 * (estimates.len() - lags.len()) / estimates.len()
            );
        }
    }
    Ok(())
}

fn sounds(folder: &Path) -> Result<(), Failure> {
    let training = folder.join("SoundScans/Movement/Training");
    let mut surfaces: BTreeMap<String, Vec<std::path::PathBuf>> = BTreeMap::new();
    for file in std::fs::read_dir(&training)? {
        let path = file?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if let Some((surface, _)) = name.split_once("_Sound_Movement_train") {
            surfaces.entry(surface.into()).or_default().push(path);
        }
    }
    println!("| surface | Q | quantile | mean-ci | HSIC/κ at 1 s/8 |");
    println!("|---|---|---|---|---|");
    for (surface, mut paths) in surfaces {
        paths.sort();
        let series: Result<Vec<Series>, Failure> = paths.iter().map(|path| read(path)).collect();
        let trials = Trials::new(series?)?;
        let settings = Settings { largest_lag: 5512, ..Settings::default() };
        let mut search = Search::new(&trials, settings)?;
        let cells = RULES.map(|rule| show(&search.find(rule)));
        let far = search.at(5512);
        println!(
            "| {surface} | {} | {} | {} | {:.2} |",
            trials.count(),
            cells[0],
            cells[1],
            far.hsic_mean / far.kappa
        );
    }
    Ok(())
}

fn show(estimate: &Estimate) -> String {
    let ms = |lag: usize| lag as f64 / estimate.rate_hz * 1e3;
    match estimate.outcome {
        Outcome::Found { lag } => format!("{lag} ({:.2} ms)", ms(lag)),
        Outcome::NotInRange { largest_lag } => format!("not within {:.0} ms", ms(largest_lag)),
        Outcome::Returns { first, again_at } => {
            format!("none ({first}, back at {again_at} = {:.1} ms)", ms(again_at))
        }
    }
}

fn read(path: &Path) -> Result<Series, Failure> {
    let mut reader = hound::WavReader::open(path)?;
    let spec = reader.spec();
    let samples: Result<Vec<f32>, _> =
        reader.samples::<i16>().map(|s| s.map(|x| f32::from(x) / 32_768.0)).collect();
    Ok(Series::new(f64::from(spec.sample_rate), usize::from(spec.channels), samples?)?)
}
