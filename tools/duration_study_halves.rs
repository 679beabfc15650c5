//! The part of `duration_study` on recordings: T* of odd trials against even ones, by three rules.
//!
//! On LMT108's dragging sounds, `pooled` agrees on 14 of 20 surfaces. The cause is the little that
//! five trials of 4.8 s can show, not a jump between two crossings: at T*, the dependence has a
//! standard error of 0.016 (median), and it falls by 0.11 while the lag grows by a factor of e. So
//! ln T* has a standard error of 0.15. A line below each table gives the share of agreement for a
//! steady process of the same T*. One half of G2StoneTileVersion2 has too little data for a T*.

use std::collections::BTreeMap;
use std::path::Path;

use rayon::prelude::*;
use surfaced::independence::{
    Algorithm1Settings, CORRELATION, Estimator, PooledSettings, Question, Rule, SourceDuration,
    VALUES, at_needed_rate, report,
};
use surfaced::kernel::Threshold;
use surfaced::library::Library;
use surfaced::recognise::LibraryShape;
use surfaced::scene::Scene;
use surfaced::seed;

use super::{Failure, simulate};

/// Prints T* of odd trials and of even ones, by the three rules.
pub fn halves(folder: &Path) -> Result<(), Failure> {
    let library = surfaced::dataset::open(folder, &Scene::lmt108())?;
    println!("\n{}: T* [ms] of odd trials · of even trials\n", library.name);
    let half = |odd: bool| {
        let of_half = |number: u32| (number % 2 == 1) == odd;
        let entries = library.entries.iter().filter(|e| of_half(e.key.number)).cloned().collect();
        Library { entries, ..library.clone() }
    };
    let algorithm1 = |rule| {
        Estimator::Algorithm1(Algorithm1Settings {
            rule,
            threshold: Threshold::Gamma,
            largest_lag: 5512,
            ..Algorithm1Settings::default()
        })
    };
    let estimators = [
        ("pooled", Estimator::Pooled(PooledSettings { dependence: CORRELATION })),
        ("quantile", algorithm1(Rule::Quantile)),
        ("mean-ci", algorithm1(Rule::MeanCi)),
    ];
    // For each source and surface: the cells of the three rules. For each source and rule: counts.
    let mut cells: BTreeMap<(String, String), Vec<String>> = BTreeMap::new();
    let mut counts: BTreeMap<(String, &str), [usize; 3]> = BTreeMap::new();
    // For each source: the share of cases in which an ideal process agrees, surface by surface.
    let mut ideal: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    let shape = LibraryShape::of(&library.entries.iter().collect::<Vec<_>>())?;
    for (name, estimator) in estimators {
        let sources = report(&half(true), &Question::default(), |_, _| {})?;
        let sources = sources.scene.into_iter().map(|s| s.source).collect();
        let question = Question { sources, as_time: true, estimator, ..Question::default() };
        let [odd, even] = [true, false].map(|odd| report(&half(odd), &question, |_, _| {}));
        for (a, b) in odd?.durations.iter().zip(&even?.durations) {
            assert_eq!((&a.surface, &a.source), (&b.surface, &b.source), "halves of one library");
            let agree = agree(a, b);
            let key = (a.source.to_string(), a.surface.clone());
            let mark = if agree { "" } else { " ✗" };
            cells.entry(key).or_default().push(format!("{} · {}{mark}", cell(a), cell(b)));
            let count = counts.entry((a.source.to_string(), name)).or_default();
            count[0] += usize::from(agree);
            count[1] += usize::from(a.t_star_s.is_some() && b.t_star_s.is_some());
            count[2] += 1;
            if let ("pooled", Some(x), Some(y)) = (name, a.t_star_s, b.t_star_s)
                && let Some(shape) = shape.get(&a.source)
            {
                let trial_s = shape.median_frames as f64 / shape.rate_hz;
                let share = ideal_share((x * y).sqrt(), a.trials.min(b.trials), trial_s);
                ideal.entry(a.source.to_string()).or_default().push(share);
            }
        }
    }
    println!("| source | surface | pooled | quantile | mean-ci |\n|---|---|---|---|---|");
    for ((source, surface), row) in &cells {
        println!("| {source} | {surface} | {} |", row.join(" | "));
    }
    println!("\n| source | rule | agree | both with a T* |\n|---|---|---|---|");
    for ((source, rule), [agree, both, all]) in &counts {
        println!("| {source} | {rule} | {agree} of {all} ({} %) | {both} |", 100 * agree / all);
    }
    println!();
    for (source, shares) in &ideal {
        println!(
            "{source}: where both halves have a T*, an Ornstein–Uhlenbeck process with the same T*, \
             trials and seconds agrees with itself in {:.0} % of cases by `pooled` (surfaces: {}; \
             cases each: {CASES}).",
            100.0 * shares.iter().sum::<f64>() / shares.len() as f64,
            shares.len()
        );
    }
    Ok(())
}

/// Number of cases that are simulated for a surface.
const CASES: u64 = 100;

/// The share of cases in which two halves of an Ornstein–Uhlenbeck process with this T* agree. Each
/// half has `trials` trials of `trial_s` seconds.
fn ideal_share(t_star_s: f64, trials: usize, trial_s: f64) -> f64 {
    /// Number of samples within T*.
    const RESOLUTION: f64 = 100.0;
    let rate_hz = RESOLUTION / t_star_s;
    let (frames, tau) = ((trial_s * rate_hz) as usize, RESOLUTION / -CORRELATION.ln());
    let agrees = |case: &u64| {
        let t_star = |half: u64| {
            let mut rng = seed::rng(2 * case + half, &[b"halves"]);
            let make = || simulate::ar1(frames, tau, &mut rng);
            let series = simulate::trials(trials, rate_hz, make).ok()?;
            at_needed_rate(&series, frames, CORRELATION, VALUES)?.t_star_samples()
        };
        match (t_star(0), t_star(1)) {
            (Some(x), Some(y)) => is_near(x, y),
            (x, y) => x == y,
        }
    };
    (0..CASES).into_par_iter().filter(agrees).count() as f64 / CASES as f64
}

/// Whether two T* agree within a factor of 1.5 or one lag, or are missing for the same reason.
fn agree(a: &SourceDuration, b: &SourceDuration) -> bool {
    match (a.t_star_samples, b.t_star_samples) {
        (Some(x), Some(y)) => is_near(x, y),
        (None, None) => kind(a) == kind(b),
        _ => false,
    }
}

/// Whether two numbers of samples agree within a factor of 1.5 or by one.
fn is_near(x: usize, y: usize) -> bool {
    x.abs_diff(y) <= 1 || 2 * x.max(y) <= 3 * x.min(y)
}

/// The first words of the reason for a missing T*, up to the colon.
fn kind(row: &SourceDuration) -> &str {
    row.reason.as_deref().and_then(|reason| reason.split(':').next()).unwrap_or_default()
}

fn cell(row: &SourceDuration) -> String {
    row.t_star_s.map_or_else(|| kind(row).chars().take(24).collect(), |t| format!("{:.2}", 1e3 * t))
}
