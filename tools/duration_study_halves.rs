//! Odd trials against even ones, by all three rules: the part of `duration_study` on recordings.
//!
//! On LMT108's dragging sounds `pooled` agrees on 14 of 20 surfaces. It is no jump between two
//! crossings, but what five trials of 4.8 s can show: at T* the dependence has a standard error of
//! 0.016 (median), and it falls by 0.11 while the lag grows by a factor of e. So ln T* has a standard
//! error of 0.15, and halves lie within a factor of 1.5 in 84 % of cases if each has a T*; one half
//! of G2StoneTileVersion2 has too little data for one. Ten trials against ten would come to 90 %.

use std::collections::BTreeMap;
use std::path::Path;

use surfaced::duration::{
    Algorithm1Settings, CORRELATION, Estimator, PooledSettings, Question, Rule, SourceDuration,
    report,
};
use surfaced::kernel::Threshold;
use surfaced::library::Library;
use surfaced::scene::Scene;

use super::Failure;

/// T* of odd trials against that of even ones, by the three rules.
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
    // For each source and surface the cells of the three rules; and the counts for each source.
    let mut cells: BTreeMap<(String, String), Vec<String>> = BTreeMap::new();
    let mut counts: BTreeMap<(String, &str), [usize; 3]> = BTreeMap::new();
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
    Ok(())
}

/// Within a factor of 1.5 or one lag, or without a T* for the same reason.
fn agree(a: &SourceDuration, b: &SourceDuration) -> bool {
    match (a.t_star_samples, b.t_star_samples) {
        (Some(x), Some(y)) => x.abs_diff(y) <= 1 || 2 * x.max(y) <= 3 * x.min(y),
        (None, None) => kind(a) == kind(b),
        _ => false,
    }
}

/// What a reason begins with.
fn kind(row: &SourceDuration) -> &str {
    row.reason.as_deref().and_then(|reason| reason.split(':').next()).unwrap_or_default()
}

fn cell(row: &SourceDuration) -> String {
    row.t_star_s.map_or_else(|| kind(row).chars().take(24).collect(), |t| format!("{:.2}", 1e3 * t))
}
