//! Tests that every comparison classifier must pass.

use super::smartcore_models::{boosted, forest, naive_bayes};
use super::*;
use crate::features::SourceFeatures;

/// Four surfaces with six trials each. Each trial has three features; the last feature is constant.
fn library() -> Vec<Prepared> {
    let vector = |surface: usize, number: u32| {
        let wobble = |k: u32| (f64::from(number * 7 + k) * 1.7 + surface as f64).sin() * 0.3;
        let values = vec![
            (surface % 2) as f64 * 3.0 + wobble(1),
            (surface / 2) as f64 * 300.0 + 30.0 * wobble(2),
            4.0,
        ];
        of("x", ["a", "b", "c", "d"][surface], number, values)
    };
    (0..4).flat_map(|s| (1..=6).map(move |n| vector(s, n))).collect()
}

fn of(source: &str, surface: &str, number: u32, values: Vec<f64>) -> Prepared {
    let features = SourceFeatures { values, rate_hz: 10.0 };
    let sources = BTreeMap::from([(SourceId::new(source).unwrap(), features)]);
    let key = TrialKey::new(surface, "expert", number);
    Prepared::Features(Arc::new(FeatureVector { key, sources }))
}

fn check(learn: fn(&Arc<TrainingSet>) -> Scorer) {
    let method = OnFeatures::new("classifier", Scene::lmt108(), learn);
    let (held, rest): (Vec<_>, Vec<_>) = library().into_iter().partition(|v| v.key().number == 3);
    let shape = Arc::default();
    let model = method.fit(rest.clone(), &shape).unwrap();
    for query in &held {
        let ranking = model.rank(query).unwrap();
        assert_eq!(ranking.surface(), query.key().surface, "{}", method.name());
        assert_eq!(ranking.ranked.len(), 4);
        assert_eq!(ranking.nearest.surface, query.key().surface);
        assert!(ranking.ranked.is_sorted_by(|a, b| a.score <= b.score));
        if let Some(p) = ranking.confidence {
            let sum: f64 = ranking.ranked.iter().map(|r| r.score.recip()).sum();
            assert!(
                (sum - 1.0).abs() < 1e-6 && p > 0.5 && p <= 1.0,
                "{}: {sum} {p}",
                method.name()
            );
        }
    }
    // The result depends neither on the order of the library nor on chance.
    let mut turned = rest;
    turned.reverse();
    let again = method.fit(turned, &shape).unwrap();
    assert_eq!(model.rank(&held[1]).unwrap(), again.rank(&held[1]).unwrap());
    // A trial far from everything in the library still gets an answer, with finite scores.
    let far = of("x", "a", 3, vec![1e30, -1e30, 0.0]);
    let ranking = model.rank(&far).unwrap();
    assert!(ranking.ranked.iter().all(|r| r.score.is_finite()), "{}", method.name());
    assert!(model.rank(&of("x", "a", 3, vec![1.0])).is_err(), "another rate");
    let error = model.rank(&of("y", "a", 3, vec![1.0])).unwrap_err().to_string();
    assert!(error.contains("the query has y"), "{error}");
    let one = library().into_iter().filter(|v| v.key().surface == "a").collect();
    assert!(method.fit(one, &shape).is_err());
}

#[test]
fn every_classifier_keeps_the_promises() {
    check(|trials| naive_bayes(trials));
    check(|trials| neighbours::learn(trials, false));
    check(|trials| neighbours::learn(trials, true));
    check(svm::learn);
    check(|trials| forest(trials, 1));
    check(|trials| boosted(trials, 1));
}

#[test]
fn another_seed_is_another_forest() {
    let scores = |seed| {
        let learn = move |trials: &Arc<_>| forest(trials, seed);
        let method = OnFeatures::new("random-forest", Scene::lmt108(), learn);
        let model = method.fit(library(), &Arc::default()).unwrap();
        // A query between surfaces, so that the trees disagree.
        let query = of("x", "a", 9, vec![1.5, 150.0, 4.0]);
        model.rank(&query).unwrap().ranked.iter().map(|r| r.score).collect::<Vec<_>>()
    };
    let forests: Vec<Vec<f64>> = (0..8).map(scores).collect();
    assert!(forests.iter().any(|scores| *scores != forests[0]), "{forests:?}");
}

#[test]
fn a_source_that_a_query_lacks_counts_as_the_mean() {
    let method = OnFeatures::new("naive-bayes", Scene::lmt108(), |trials| naive_bayes(trials));
    let mut both = Vec::new();
    for vector in library() {
        let mut vector = FeatureVector::clone(vector.features(method.name()).unwrap());
        let more = SourceFeatures { values: vec![f64::from(vector.key.number)], rate_hz: 1.0 };
        vector.sources.insert(SourceId::new("y").unwrap(), more);
        both.push(Prepared::Features(Arc::new(vector)));
    }
    let model = method.fit(both, &Arc::default()).unwrap();
    let query = &library()[8];
    let ranking = model.rank(query).unwrap();
    assert_eq!(ranking.surface(), query.key().surface);
    assert_eq!(ranking.sources.len(), 1, "what was not there was not compared");
}
