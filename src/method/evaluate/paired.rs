//! Compares methods on the same queries, by paired tests.

use std::collections::BTreeMap;

use statrs::distribution::{Binomial, DiscreteCDF};

use super::evaluation::Evaluation;
use super::outcome::{Over, Prediction, Share};
use crate::recognise::{MethodName, MethodSpec};

/// A difference is reported if its p-value is below this.
const SIGNIFICANT: f64 = 0.05;

/// Whether each query was named right, with the fold that asked it.
#[doc(hidden)]
pub type Named<'a> = Vec<(&'a str, bool)>;

/// A paired test of two methods.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Paired {
    pub methods: [String; 2],
    /// The number of queries that only the first, and that only the second of the methods names right.
    pub only_right: [usize; 2],
    /// The units that the test counts: queries that only one of the two names right (McNemar's exact test), or
    /// people, sessions or groups in which one names more than the other does (the sign test).
    pub test_over: Over,
    pub p_value: f64,
    /// The p-value with Holm's correction for all pairs.
    pub p_value_holm: f64,
}

/// Tests all pairs of methods, which named the same queries in the same order. From three groups on,
/// the test is over groups, since the queries of one group are not independent.
pub fn paired(methods: &[(&str, Named<'_>)], over: Over) -> Vec<Paired> {
    let mut all = Vec::new();
    for (at, (first, one)) in methods.iter().enumerate() {
        for (second, other) in &methods[at + 1..] {
            let mut groups: BTreeMap<&str, i64> = BTreeMap::new();
            for (&(group, one), &(_, other)) in one.iter().zip(other) {
                *groups.entry(group).or_default() += i64::from(one) - i64::from(other);
            }
            let only_right = [(one, other), (other, one)].map(|(one, other)| {
                one.iter().zip(other).filter(|(one, other)| one.1 && !other.1).count()
            });
            let test_over = over.counted(groups.len());
            let [more, less] = match test_over {
                Over::Queries => only_right,
                _ => [1, -1].map(|sign| groups.values().filter(|&&d| d.signum() == sign).count()),
            };
            let p_value = sign_test(more, less);
            let methods = [first, second].map(|name| (*name).to_string());
            all.push(Paired { methods, only_right, test_over, p_value, p_value_holm: p_value });
        }
    }
    holm(&mut all);
    all
}

/// Corrects p-values for the number of tests (Holm 1979, "A simple sequentially rejective multiple test
/// procedure").
fn holm(all: &mut [Paired]) {
    let mut order: Vec<usize> = (0..all.len()).collect();
    order.sort_by(|&a, &b| all[a].p_value.total_cmp(&all[b].p_value));
    let mut least: f64 = 0.0;
    for (done, &at) in order.iter().enumerate() {
        least = least.max((order.len() - done) as f64 * all[at].p_value).min(1.0);
        all[at].p_value_holm = least;
    }
}

/// Names the queries of an evaluation by `svm`, and compares with `predictions` by the default
/// method, over what the folds leave out ([`paired`]). Returns advice if `svm` is significantly better;
/// `None` if not, or if `svm` fails.
pub fn better_plain(
    evaluation: Evaluation<'_>,
    predictions: &[Prediction],
    over: Over,
) -> Option<String> {
    let plain = MethodName::Svm;
    let method = MethodSpec::from(plain).build(evaluation.scene);
    let by_plain = evaluation.prepare(&*method).ok()?.measure().ok()?.predictions;
    let fold = |p: &Prediction| evaluation.folds[p.fold].name.as_str();
    let named = |predictions: &[Prediction]| -> Vec<(&str, bool)> {
        predictions.iter().map(|p| (fold(p), p.is_correct())).collect()
    };
    let both = [("", named(&by_plain)), ("", named(predictions))];
    let Paired { only_right: [gained, lost], test_over, p_value, .. } =
        paired(&both, over).pop()?;
    let test = match test_over {
        Over::Queries => "McNemar's test".into(),
        over => format!("sign test over {}", over.plural()),
    };
    (gained > lost && p_value < SIGNIFICANT).then(|| {
        let name = plain.as_str();
        let percent = |named: &Named<'_>| 100.0 * Share::count(named.iter().map(|n| n.1)).value();
        let [by_plain, by_default] = [&both[0].1, &both[1].1].map(percent);
        format!(
            "`{name}` names {by_plain:.1} % of the same queries, where this method names \
             {by_default:.1} % ({test}: p = {p_value:.2e}); compare with --method {name}"
        )
    })
}

/// The two-sided p-value of the sign test, which over queries is McNemar's exact test (McNemar 1947,
/// "Note on the sampling error of the difference between correlated proportions or percentages").
/// `one` counts queries or groups in which only the first of two methods is better, `other` those in
/// which only the second is.
fn sign_test(one: usize, other: usize) -> f64 {
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
    use crate::scene::{Scene, SourceId};
    use crate::trial::{Series, Trial, TrialKey};

    #[test]
    fn the_p_value_is_that_of_fair_coins() {
        assert_eq!(sign_test(0, 0), 1.0);
        assert_eq!(sign_test(3, 3), 1.0);
        assert!((sign_test(0, 6) - 2.0 / 64.0).abs() < 1e-12);
        assert!((sign_test(1, 9) - 22.0 / 1024.0).abs() < 1e-12);
        assert_eq!(sign_test(1, 9), sign_test(9, 1));
    }

    fn named(folds: &[&'static str], right: &str) -> Named<'static> {
        folds.iter().copied().zip(right.chars().map(|c| c == '1')).collect()
    }

    #[test]
    fn pairs_are_tested_over_queries_or_over_three_groups_with_holms_correction() {
        let folds = ["a", "a", "b", "b", "c", "c"];
        let all = [
            ("good", named(&folds, "111111")),
            ("worse", named(&folds, "101010")),
            ("bad", named(&folds, "000000")),
        ];
        let rounded = |p: f64| (p * 1e9).round() / 1e9;
        let over = |over| paired(&all, over).iter().map(|p| rounded(p.p_value)).collect::<Vec<_>>();
        assert_eq!(over(Over::Queries), [0.25, 0.03125, 0.25]);
        assert_eq!(over(Over::People), [0.25, 0.25, 0.25], "each of three people, one way");
        let found = paired(&all, Over::Queries);
        assert_eq!(found[1].methods, ["good", "bad"]);
        assert_eq!((found[1].only_right, found[0].only_right), ([6, 0], [3, 0]));
        let holm: Vec<f64> = found.iter().map(|p| rounded(p.p_value_holm)).collect();
        assert_eq!(holm, [0.5, 0.09375, 0.5]);
        let two = paired(
            &[("x", named(&["a", "b"], "11")), ("y", named(&["a", "b"], "00"))],
            Over::People,
        );
        assert_eq!((two[0].test_over, rounded(two[0].p_value)), (Over::Queries, 0.5));
    }

    #[test]
    fn a_better_plain_comparison_is_named_and_an_equal_one_is_not() {
        let scene = Scene::lmt108();
        let entry = |surface: usize, number: u32| {
            let value = |i: usize| ((i * (surface + 2) + number as usize) as f32 * 0.37).sin();
            let series = Series::new(100.0, 1, (0..300).map(value).collect()).unwrap();
            let key = TrialKey::new(format!("s{surface}"), "expert", number);
            Entry::in_memory(Trial::of_series(key, SourceId::new("ir").unwrap(), series))
        };
        let entries: Vec<Entry> =
            (0..3).flat_map(|surface| (1..=5).map(move |n| entry(surface, n))).collect();
        let keys: Vec<TrialKey> = entries.iter().map(|entry| entry.key.clone()).collect();
        let folds = folds(Protocol::LeaveOneTrialOut, &keys).unwrap();
        let evaluation = Evaluation::new(&scene, &entries, &folds);
        let svm = MethodSpec::from(MethodName::Svm).build(&scene);
        let same = evaluation.prepare(&*svm).unwrap().measure().unwrap().predictions;
        assert!(same.iter().all(Prediction::is_correct), "{same:?}");
        assert_eq!(better_plain(evaluation, &same, Over::Queries), None);
        let mut worse = same;
        worse.iter_mut().take(7).for_each(|p| p.surface = "none".into());
        let line = better_plain(evaluation, &worse, Over::Queries).unwrap();
        assert!(line.contains("100.0 %") && line.contains("53.3 %"), "{line}");
        // Even if `svm` is better in each of five groups, p is 2 / 2^5.
        assert_eq!(better_plain(evaluation, &worse, Over::People), None);
    }
}
