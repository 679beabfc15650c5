//! The studies behind `surfaced duration`: T* (the time between independent samples) where the true
//! T* is known; T* of odd against even trials of recordings; and whether the promised accuracy of a
//! scan time holds. Seeds are fixed. `tools/charts/duration-study DATA` keeps the output.
//!
//!     cargo run --release --example duration_study                         processes
//!     cargo run --release --example duration_study -- DATA …               odd and even trials
//!     cargo run --release --example duration_study -- --promises DATA …    promised, measured

#[path = "duration_study_halves.rs"]
mod halves;
#[path = "duration_study_promise.rs"]
mod promise;
#[path = "../tests/common/simulate.rs"]
mod simulate;

use std::collections::BTreeMap;
use std::path::Path;

use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use surfaced::independence::{
    Algorithm1Settings, CORRELATION, PooledAnswer, PooledEstimate, Rule, Search, Trials, VALUES,
    at_needed_rate,
};
use surfaced::kernel::Threshold;
use surfaced::seed;
use surfaced::trial::Series;

type Failure = Box<dyn std::error::Error>;
type Make = fn(usize, f64, &mut ChaCha8Rng) -> Vec<f32>;
const REPETITIONS: u64 = 50;
/// Numbers of trials and of frames of the simulated recording that gives the true T*.
const TRUTH: (usize, usize) = (20, 500_000);

/// A simulated process, and the T* that is expected of it.
struct Case {
    name: &'static str,
    make: Make,
    channels: usize,
    tau: f64,
    trials: usize,
    frames: usize,
    wanted: Wanted,
}

/// The required T*, in units of the true T* unless a comment says otherwise.
#[derive(Clone, Copy)]
enum Wanted {
    /// Median T*/τ between two numbers; the true value is ln 10.
    InTau(f64, f64),
    /// Median T* between 0.75 and 1.5 of the true T*.
    NearTruth,
    /// Median T* between 0.75 and 1.5 of the true T*; single runs may say "too little data".
    NearTruthOrLittleData,
    /// T* is 1 sample in at least 95 % of runs.
    One,
    /// The answer is "never" in at least 95 % of runs.
    Never,
}

fn main() -> Result<(), Failure> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    match &words[..] {
        [] => {
            pooled_on_processes();
            algorithm1_on_processes()
        }
        [first, folders @ ..] if first == "--promises" => {
            folders.iter().try_for_each(|folder| promise::promises(Path::new(folder)))
        }
        folders => folders.iter().try_for_each(|folder| halves::halves(Path::new(folder))),
    }
}

fn ou(frames: usize, tau: f64, rng: &mut ChaCha8Rng) -> Vec<f32> {
    simulate::ar1(frames, tau, rng)
}

fn three_channels(frames: usize, _: f64, rng: &mut ChaCha8Rng) -> Vec<f32> {
    let channels = [20.0, 50.0, 100.0].map(|tau| simulate::ar1(frames, tau, rng));
    (0..frames).flat_map(|i| [channels[0][i], channels[1][i], channels[2][i]]).collect()
}

/// An Ornstein–Uhlenbeck process with a standard deviation of `steps` steps of a 12-bit converter.
fn quantised(frames: usize, tau: f64, rng: &mut ChaCha8Rng, steps: f32) -> Vec<f32> {
    let to_code = |x: f32| (x * steps).round().clamp(-2048.0, 2047.0);
    ou(frames, tau, rng).into_iter().map(to_code).collect()
}

fn cases() -> Vec<Case> {
    let case = |name, make, tau, wanted| Case {
        name,
        make,
        channels: 1,
        tau,
        trials: 10,
        frames: 48_000,
        wanted,
    };
    let (tau, truth) = (100.0, Wanted::NearTruth);
    vec![
        case("OU", ou, 5.0, Wanted::InTau(2.1, 2.7)),
        case("OU", ou, 20.0, Wanted::InTau(2.1, 2.7)),
        case("OU", ou, 100.0, Wanted::InTau(2.1, 2.7)),
        Case { trials: 5, frames: 10_000, ..case("OU", ou, 20.0, Wanted::InTau(2.0, 3.0)) },
        case("OU", ou, 1000.0, Wanted::NearTruthOrLittleData),
        case("random telegraph", simulate::telegraph, tau, truth),
        Case { channels: 3, ..case("three channels, 20/50/100", three_channels, tau, truth) },
        case("AR, t₂ innovations", simulate::heavy_tailed, tau, truth),
        case("OU, 12 bit, σ = 512 steps", |n, tau, rng| quantised(n, tau, rng, 512.0), tau, truth),
        case("OU, 12 bit, σ = 1 step", |n, tau, rng| quantised(n, tau, rng, 1.0), tau, truth),
        case(
            "OU, 5 % saturated",
            |n, tau, rng| ou(n, tau, rng).into_iter().map(|x| x.min(1.6449)).collect(),
            tau,
            truth,
        ),
        case("stochastic volatility", simulate::volatility, tau, truth),
        case("noise", |n, _, rng| ou(n, 0.0, rng), 1.0, Wanted::One),
        Case {
            trials: 5,
            frames: 10_000,
            ..case("noise", |n, _, rng| ou(n, 0.0, rng), 1.0, Wanted::One)
        },
        case(
            "Cauchy noise",
            |n, _, rng| {
                let mut ratio = || (simulate::normal(rng) / simulate::normal(rng)) as f32;
                (0..n).map(|_| ratio()).collect()
            },
            1.0,
            Wanted::One,
        ),
        case("sine, period 210", |n, _, rng| simulate::sine(n, 210.0, rng), 1.0, Wanted::Never),
        case(
            "sine and noise",
            |n, _, rng| {
                let sine = simulate::sine(n, 210.0, rng);
                sine.into_iter().map(|x| x + simulate::normal(rng) as f32).collect()
            },
            1.0,
            Wanted::Never,
        ),
        case("trend", |n, _, rng| simulate::ramp(n, 0.0, rng), 1.0, Wanted::Never),
        case("trend and noise", |n, _, rng| simulate::ramp(n, 0.5, rng), 1.0, Wanted::Never),
    ]
}

impl Case {
    fn estimate(&self, repetition: u64, (trials, frames): (usize, usize)) -> PooledEstimate {
        let key: [&[u8]; 3] = [b"study", self.name.as_bytes(), &self.tau.to_le_bytes()];
        let mut rng = seed::rng(repetition, &key);
        let series: Vec<Series> = (0..trials)
            .map(|_| Series::new(1e4, self.channels, (self.make)(frames, self.tau, &mut rng)))
            .collect::<Result<_, _>>()
            .expect("finite samples");
        let values = VALUES.max(trials * frames);
        at_needed_rate(&series, frames, CORRELATION, values).expect("samples that change")
    }

    /// The true T*/τ, from very many samples; ln 10 if the autocorrelation is exp(−t/τ).
    fn truth(&self) -> Option<f64> {
        match self.wanted {
            Wanted::InTau(..) | Wanted::NearTruthOrLittleData => Some(10f64.ln()),
            Wanted::NearTruth => match self.estimate(u64::MAX, TRUTH).answer {
                PooledAnswer::Found { t_star, .. } => Some(t_star / self.tau),
                _ => None,
            },
            Wanted::One => Some(1.0),
            Wanted::Never => None,
        }
    }
}

fn pooled_on_processes() {
    println!("Rule `pooled`, {REPETITIONS} runs each, in units of τ (of samples for noise):\n");
    println!(
        "| process | τ | Q × L | truth | T* median (5–95 %) | upper bound, median | below truth | \
         below 0.85 truth | no T* | n_eff off by | as wanted |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|");
    for case in cases() {
        let truth = case.truth();
        let found: Vec<PooledEstimate> = (0..REPETITIONS)
            .into_par_iter()
            .map(|run| case.estimate(run, (case.trials, case.frames)))
            .collect();
        let sorted = |value: fn(&PooledEstimate) -> Option<f64>| -> Vec<f64> {
            let mut all: Vec<f64> = found.iter().filter_map(value).collect();
            all.sort_unstable_by(f64::total_cmp);
            all
        };
        let t_star = sorted(|e| e.t_star_samples().map(|t| t as f64));
        let upper = sorted(|e| e.upper_samples().map(|t| t as f64));
        let cell = |all: &[f64], share| {
            at(all, share).map_or("–".into(), |x| format!("{:.2}", x / case.tau))
        };
        let early = |factor: f64| match truth {
            Some(truth) if !upper.is_empty() => {
                let early = upper.iter().filter(|&&u| u < factor * truth * case.tau).count();
                format!("{} %", 100 * early / found.len())
            }
            _ => "–".into(),
        };
        // This value is exact only for processes whose autocorrelation is exp(−t/τ).
        let inflation = at(&sorted(|e| e.inflation), 0.5);
        let off = match (case.wanted, inflation) {
            (Wanted::InTau(..) | Wanted::NearTruthOrLittleData, Some(inflation)) => {
                let exact = 1.0 / (0.5 / case.tau).tanh();
                format!("{:+.0} %", 100.0 * (exact / inflation - 1.0))
            }
            _ => "–".into(),
        };
        println!(
            "| {} | {} | {} × {} | {} | {} ({}–{}) | {} | {} | {} | {} | {off} | {} |",
            case.name,
            case.tau,
            case.trials,
            case.frames,
            truth.map_or("never".into(), |truth| format!("{truth:.2}")),
            cell(&t_star, 0.5),
            cell(&t_star, 0.05),
            cell(&t_star, 0.95),
            cell(&upper, 0.5),
            early(1.0),
            early(0.85),
            reasons(&found),
            if holds(&case, truth, &found, &t_star, &upper) { "yes" } else { "**no**" },
        );
    }
}

fn at(sorted: &[f64], share: f64) -> Option<f64> {
    sorted.get((sorted.len().saturating_sub(1) as f64 * share).round() as usize).copied()
}

fn reason(answer: PooledAnswer) -> &'static str {
    match answer {
        PooledAnswer::Found { .. } => "",
        PooledAnswer::Never => "never",
        PooledAnswer::NotWithinRange => "not within the range",
        PooledAnswer::TooLittleData { .. } => "too little data",
    }
}

/// The share of runs without a T*, for each reason.
fn reasons(found: &[PooledEstimate]) -> String {
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    for estimate in found {
        *counts.entry(reason(estimate.answer)).or_default() += 1;
    }
    counts.remove("");
    let shares: Vec<String> = (counts.iter())
        .map(|(reason, count)| format!("{} % {reason}", 100 * count / found.len()))
        .collect();
    if shares.is_empty() { "0 %".into() } else { shares.join(", ") }
}

fn holds(
    case: &Case,
    truth: Option<f64>,
    found: &[PooledEstimate],
    t_star: &[f64],
    upper: &[f64],
) -> bool {
    let most = (0.95 * found.len() as f64).ceil() as usize;
    let median = at(t_star, 0.5).map(|t| t / case.tau);
    let near = |low: f64, high: f64| median.is_some_and(|t| (low..=high).contains(&t));
    let near_truth = || truth.is_some_and(|truth| near(0.75 * truth, 1.5 * truth));
    match case.wanted {
        Wanted::InTau(low, high) => {
            let early = upper.iter().filter(|&&u| u < 0.85 * 10f64.ln() * case.tau).count();
            near(low, high) && 10 * early <= found.len()
        }
        Wanted::NearTruth => near_truth(),
        Wanted::NearTruthOrLittleData => {
            let others = found.iter().map(|e| reason(e.answer));
            near_truth() && others.into_iter().all(|r| r.is_empty() || r == "too little data")
        }
        Wanted::One => t_star.iter().filter(|&&t| t == 1.0).count() >= most,
        Wanted::Never => found.iter().filter(|e| e.answer == PooledAnswer::Never).count() >= most,
    }
}

/// Studies the paper's two rules on Ornstein–Uhlenbeck processes.
fn algorithm1_on_processes() -> Result<(), Failure> {
    println!("\nThe published rules, R = 200, κ by moments, {REPETITIONS} runs, in units of τ:\n");
    println!("| process | Q × L | rule | T* median (5–95 %) | below truth | no T* |");
    println!("|---|---|---|---|---|---|");
    for (tau, q) in [(0.0, 10usize), (0.0, 30), (20.0, 10), (20.0, 30), (100.0, 10), (100.0, 30)] {
        let searches = (0..REPETITIONS).into_par_iter().map(|run| {
            let mut rng = seed::rng(run, &[b"study", b"ar1", &q.to_le_bytes()[..]]);
            let make = || simulate::ar1(22_000, tau, &mut rng);
            // This cannot fail: samples of `ar1` are finite, and more than five trials vary.
            let series = simulate::trials(q, 1e4, make).expect("finite samples");
            let trials = Trials::new(series).expect("enough trials");
            let threshold = Threshold::Gamma;
            let settings = Algorithm1Settings {
                draws: 200,
                threshold,
                seed: run,
                ..Algorithm1Settings::default()
            };
            let mut search = Search::new(&trials, settings).expect("possible settings");
            [Rule::Quantile, Rule::MeanCi].map(|rule| search.find(rule).t_star())
        });
        let found: Vec<[Option<usize>; 2]> = searches.collect();
        for (i, rule) in [Rule::Quantile, Rule::MeanCi].into_iter().enumerate() {
            let scale = f64::max(tau, 1.0);
            let mut lags: Vec<f64> =
                found.iter().filter_map(|f| f[i]).map(|t| t as f64 / scale).collect();
            lags.sort_unstable_by(f64::total_cmp);
            let cell = |share| at(&lags, share).map_or("–".into(), |x| format!("{x:.2}"));
            let truth = if tau > 0.0 { 10f64.ln() } else { 1.0 };
            println!(
                "| {} | {q} × 22000 | {rule} | {} ({}–{}) | {} % | {} % |",
                if tau > 0.0 { format!("OU, τ = {tau}") } else { "noise".into() },
                cell(0.5),
                cell(0.05),
                cell(0.95),
                100 * lags.iter().filter(|&&t| t < truth).count() / found.len(),
                100 * (found.len() - lags.len()) / found.len(),
            );
        }
    }
    Ok(())
}
