//! Tests whether the classifier `svm` names more queries correctly than the default method does.

use std::collections::BTreeMap;

use statrs::distribution::{Binomial, DiscreteCDF};

use super::evaluation::Evaluation;
use super::outcome::{Prediction, Share};
use crate::recognise::{MethodName, MethodSpec};

/// A difference is reported if its p-value is below this.
const SIGNIFICANT: f64 = 0.05;

/// Names the queries of an evaluation by `svm`, and compares with `predictions` by the default
/// method. Returns advice if `svm` is significantly better; `None` if not, or if `svm` fails.
pub(crate) fn better_plain(
    evaluation: Evaluation<'_>,
    predictions: &[Prediction],
) -> Option<String> {
    let plain = MethodName::Svm;
    let method = MethodSpec::from(plain).build(evaluation.scene);
    let by_plain = evaluation.prepare(&*method).ok()?.measure().ok()?.predictions;
    let default: BTreeMap<_, bool> =
        predictions.iter().map(|p| ((p.fold, &p.key), p.is_correct())).collect();
    let pairs: Vec<(bool, bool)> = (by_plain.iter())
        .filter_map(|p| Some((p.is_correct(), *default.get(&(p.fold, &p.key))?)))
        .collect();
    let gained = pairs.iter().filter(|(plain, default)| *plain && !default).count();
    let lost = pairs.iter().filter(|(plain, default)| !plain && *default).count();
    let p_value = mcnemar(gained, lost);
    (gained > lost && p_value < SIGNIFICANT).then(|| {
        let name = plain.as_str();
        let by_plain = 100.0 * Share::count(pairs.iter().map(|(plain, _)| *plain)).value();
        let by_default = 100.0 * Share::count(pairs.iter().map(|(_, default)| *default)).value();
        format!(
            "`{name}` names {by_plain:.1} % of the same queries, where this method names \
             {by_default:.1} % (McNemar's test: p = {p_value:.2e}); compare with --method {name}"
        )
    })
}

/// The two-sided p-value of McNemar's exact test (McNemar 1947, "Note on the sampling error of the
/// difference between correlated proportions or percentages"). `one` counts queries that only the
/// first of two methods names correctly, `other` those that only the second does.
fn mcnemar(one: usize, other: usize) -> f64 {
    match Binomial::new(0.5, (one + other) as u64) {
        Ok(even) if one + other > 0 => (2.0 * even.cdf(one.min(other) as u64)).min(1.0),
        _ => 1.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluate::{Protocol, folds};
    use crate::library::Entry;
    use crate::scene::Scene;
    use crate::trial::{Series, Signal, Trial, TrialKey};

    #[test]
    fn the_p_value_is_that_of_fair_coins() {
        assert_eq!(mcnemar(0, 0), 1.0);
        assert_eq!(mcnemar(3, 3), 1.0);
        assert!((mcnemar(0, 6) - 2.0 / 64.0).abs() < 1e-12);
        assert!((mcnemar(1, 9) - 22.0 / 1024.0).abs() < 1e-12);
        assert_eq!(mcnemar(1, 9), mcnemar(9, 1));
    }

    #[test]
    fn a_better_plain_comparison_is_named_and_an_equal_one_is_not() {
        let scene = "format = 1\n[sources.ir]\ndomain = \"time\"\nrate_hz = 100\n";
        let scene = Scene::from_toml(scene).unwrap();
        let id = || scene.sources().next().unwrap().id.clone();
        let entry = |surface: usize, number: u32| {
            let value = |i: usize| ((i * (surface + 2) + number as usize) as f32 * 0.37).sin();
            let series = Series::new(100.0, 1, (0..300).map(value).collect()).unwrap();
            Entry::in_memory(Trial {
                key: TrialKey::new(format!("s{surface}"), "expert", number),
                signals: [(id(), Signal::Series(series))].into(),
            })
        };
        let entries: Vec<Entry> =
            (0..3).flat_map(|surface| (1..=5).map(move |n| entry(surface, n))).collect();
        let keys: Vec<TrialKey> = entries.iter().map(|entry| entry.key.clone()).collect();
        let folds = folds(Protocol::LeaveOneTrialOut, &keys).unwrap();
        let evaluation = Evaluation::new(&scene, &entries, &folds);
        let svm = MethodSpec::from(MethodName::Svm).build(&scene);
        let same = evaluation.prepare(&*svm).unwrap().measure().unwrap().predictions;
        assert!(same.iter().all(Prediction::is_correct), "{same:?}");
        assert_eq!(better_plain(evaluation, &same), None);
        let mut worse = same;
        worse.iter_mut().take(7).for_each(|p| p.surface = "none".into());
        let line = better_plain(evaluation, &worse).unwrap();
        assert!(line.contains("100.0 %") && line.contains("53.3 %"), "{line}");
    }
}
