//! Every method on numbers made to hurt: identical and nearly constant trials, 1e±30, heavy tails,
//! duplicates, one outlier. (The kernel's own sums on such samples: `score`.)

use std::collections::BTreeMap;

use crate::common::id;
use proptest::prelude::*;
use surfaced::library::Entry;
use surfaced::recognise::{
    Method, MethodName, MethodSpec, Ranking, RecogniseError, Reference, ReferenceOptions,
    SumPrecision, ready_model,
};
use surfaced::scene::Scene;
use surfaced::trial::{Series, Signal, Trial, TrialKey};

const KINDS: usize = 9;

/// A raw number in −1..1 as a sample of a kind that has broken something somewhere.
fn hostile(kind: usize, x: f64, at: usize) -> f32 {
    let value = match kind {
        0 => x,
        1 => 1e30 * x,
        2 => 1e-30 * x,
        3 => (1.57 * x).tan(),
        4 => (3.0 * x).round(),
        5 => 7.0 + 1e-6 * x,
        6 if at == 100 => 1e8,
        6 => x,
        7 => 3.0,
        _ => x.signum() * 1e4 + x,
    };
    value as f32
}

/// A trial whose sources are of one kind; `draw` numbers its noise.
fn trial(surface: &str, number: u32, kind: usize, draw: u64) -> Trial {
    let series = |name: &str, rate_hz: f64, channels: usize| {
        let mut state = draw ^ name.len() as u64 ^ (u64::from(name.as_bytes()[0]) << 8);
        let mut next = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
        };
        let samples = (0..2000 * channels).map(|at| hostile(kind, next(), at)).collect();
        (id(name), Signal::Series(Series::new(rate_hz, channels, samples).unwrap()))
    };
    let signals: BTreeMap<_, _> =
        [series("mi2", 44_100.0, 1), series("ac", 10_000.0, 3), series("ir", 10_000.0, 1)].into();
    Trial { key: TrialKey::new(surface, "expert", number), signals }
}

/// Three surfaces, each of a kind of its own, three trials each; the query is a trial of the first,
/// the very same one if `identical`.
fn ranking(
    method: &dyn Method,
    kinds: [usize; 3],
    seed: u64,
    identical: bool,
) -> Result<Ranking, RecogniseError> {
    let mut library = Vec::new();
    for (surface, kind) in ["ash", "elm", "oak"].into_iter().zip(kinds) {
        for number in 1..=3 {
            let draw = seed.wrapping_add(u64::from(number)).wrapping_mul(kind as u64 * 2 + 3);
            library.push(Entry::in_memory(trial(surface, number, kind, draw)));
        }
    }
    let draw =
        if identical { seed.wrapping_add(1).wrapping_mul(kinds[0] as u64 * 2 + 3) } else { !seed };
    let query = trial("ash", 9, kinds[0], draw);
    let all = (0..library.len()).collect();
    let model = ready_model(method, &library, &all, None, &|_, _| ())?.model;
    model.rank_trial(query)
}

fn reference(scene: Scene, precision: SumPrecision) -> Reference {
    let options =
        ReferenceOptions { samples: 120, repetitions: 2, precision, ..ReferenceOptions::default() };
    Reference::new(scene, options)
}

/// Eq. 8 adds the library's mean to the query, which at 1e30 leaves nothing of it, and at 1e-30
/// nothing of the library's trial: such pairs have no score that could be held against ours.
fn of_like_size(kinds: [usize; 3]) -> [usize; 3] {
    match kinds.into_iter().find(|kind| [1, 2].contains(kind)) {
        Some(extreme) => [extreme; 3],
        None => kinds,
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn the_fast_reference_ranks_as_its_oracle_does(
        kinds in [0..KINDS, 0..KINDS, 0..KINDS],
        seed in any::<u64>(),
        identical in any::<bool>(),
        source in 0..3usize,
    ) {
        let kinds = of_like_size(kinds);
        let scene = || Scene::lmt108().only(&[id(["mi2", "ac", "ir"][source])]).unwrap();
        let ranked = |precision| ranking(&reference(scene(), precision), kinds, seed, identical);
        let (fast, oracle) = (ranked(SumPrecision::Fast).unwrap(), ranked(SumPrecision::Oracle).unwrap());
        let score = |r: &Ranking, surface: &str| {
            r.ranked.iter().find(|s| s.surface == surface).unwrap().score
        };
        for surface in ["ash", "elm", "oak"] {
            let (a, b) = (score(&fast, surface), score(&oracle, surface));
            prop_assert!(
                a.is_finite() && (a - b).abs() <= 1e-4 * b.max(1.0),
                "{surface}: {a:e} vs {b:e} for {kinds:?}"
            );
        }
    }

    #[test]
    fn every_method_ranks_all_surfaces_with_finite_scores(
        kinds in [0..KINDS, 0..KINDS, 0..KINDS],
        seed in any::<u64>(),
        identical in any::<bool>(),
    ) {
        let ranked = |name: MethodName| {
            let method: Box<dyn Method> = match name {
                MethodName::Reference => Box::new(reference(Scene::lmt108(), SumPrecision::Fast)),
                other => MethodSpec::from(other).build(&Scene::lmt108()),
            };
            ranking(&*method, kinds, seed, identical)
        };
        let rankings = MethodName::ALL.map(ranked);
        for (method, ranking) in rankings.into_iter().enumerate() {
            let ranking = match ranking {
                // A query at rest throughout is not named by `embedding`.
                Err(RecogniseError::TooLittle) if MethodName::ALL[method] == MethodName::Embedding => {
                    continue;
                }
                ranking => ranking.unwrap(),
            };
            prop_assert_eq!(ranking.ranked.len(), 3);
            let fine = |s: f64| s.is_finite() && s >= 0.0;
            prop_assert!(
                ranking.ranked.iter().all(|r| fine(r.score)) && fine(ranking.margin),
                "method {method} for {kinds:?}: {ranking:?}"
            );
        }
    }
}

#[test]
fn answers_of_every_method_depend_on_seed_and_data_alone() {
    let said = |name: MethodName, threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let method = MethodSpec::from(name).build(&Scene::lmt108());
        pool.install(|| format!("{:?}", ranking(&*method, [0, 0, 0], 7, false).unwrap()))
    };
    for name in MethodName::ALL {
        let one = said(name, 1);
        for threads in [1, 2, 5] {
            assert_eq!(said(name, threads), one, "{name:?} on {threads} threads");
        }
    }
}
