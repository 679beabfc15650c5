//! Things that must not matter: the order of the library, the number of threads, the chunks in the rings.

use std::sync::Arc;

use crate::common;
use proptest::prelude::*;
use surfaced::device::Replay;
use surfaced::library::Entry;
use surfaced::recognise::{
    LibraryShape, Method, MethodName, MethodSpec, PositionMode, Ranking, Reference,
    ReferenceOptions,
};
use surfaced::scan::{Event, Options, Session};
use surfaced::scene::Scene;
use surfaced::trial::Trial;

fn reference(positions: PositionMode) -> Reference {
    let options =
        ReferenceOptions { samples: 40, repetitions: 2, positions, ..ReferenceOptions::default() };
    Reference::new(Scene::lmt108(), options)
}

fn library() -> Vec<Entry> {
    let surfaces = ["ash", "cedar", "elm", "juniper"];
    let trials = surfaces.iter().flat_map(|s| (1..=2).map(|n| common::trial(s, "expert", n)));
    trials.map(Entry::in_memory).collect()
}

/// Plays a trial through the rings in chunks of `chunk_s` and gives what came out.
fn played(trial: &Trial, chunk_s: f64) -> Trial {
    let replay = Replay::new(&Scene::lmt108(), vec![Entry::in_memory(trial.clone())]);
    let device = Box::new(Replay { chunk_s, ..replay });
    let session = Session::start(vec![device], Options::default()).unwrap();
    let scan = session.events.iter().find_map(|event| match event {
        Event::Scan(scan) => Some(scan.trial),
        _ => None,
    });
    session.request_stop();
    session.wait().unwrap();
    scan.unwrap()
}

fn name(method: &dyn Method, library: &[Entry], query: &Trial, threads: usize) -> Ranking {
    let work = || {
        let shape = Arc::new(LibraryShape::of(&library.iter().collect::<Vec<_>>()).unwrap());
        let prepared = library.iter().map(|entry| {
            let trial = entry.load().unwrap();
            method.prepare(entry, &trial, &shape).unwrap()
        });
        let model = method.fit(prepared.collect(), &shape).unwrap();
        model.rank_trial(query.clone()).unwrap()
    };
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(work)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    #[test]
    fn neither_order_nor_threads_nor_chunks_change_a_score(
        order in Just((0..8).collect::<Vec<usize>>()).prop_shuffle(),
        threads in 1usize..4,
        chunk_s in 1e-4f64..0.05,
        per_pair in any::<bool>(),
    ) {
        let positions = if per_pair { PositionMode::PerPair } else { PositionMode::Shared };
        let (method, library) = (reference(positions), library());
        let query = common::trial("larch", "user1", 5);
        let plain = name(&method, &library, &query, 1);
        let shuffled: Vec<Entry> = order.iter().map(|&i| library[i].clone()).collect();
        let other = name(&method, &shuffled, &played(&query, chunk_s), threads);
        prop_assert_eq!(plain, other);
    }
}

/// The same recordings under other labels and numbers get the same answers.
#[test]
fn names_and_numbers_of_trials_do_not_matter() {
    // Lengths differ, since `common::trial` draws the same samples for names of one length.
    let surfaces = ["ash", "cedar", "juniper"];
    let others = ["zinc", "beech", "maple"];
    let trials = || surfaces.iter().flat_map(|s| (1..=3).map(|n| common::trial(s, "expert", n)));
    let renamed = trials().map(|mut trial| {
        let place = surfaces.iter().position(|s| *s == trial.key.surface).unwrap();
        trial.key.surface = others[place].into();
        trial.key.number = 10 - trial.key.number;
        Entry::in_memory(trial)
    });
    let (plain, renamed): (Vec<_>, Vec<_>) =
        (trials().map(Entry::in_memory).collect(), renamed.collect());
    let queries = ["ash", "juniper", "sycamores"].map(|name| common::trial(name, "user1", 5));
    // The paper's method draws the samples of a trial by its name.
    let methods = MethodName::ALL.into_iter().filter(|method| *method != MethodName::Reference);
    for method in methods {
        let built = MethodSpec::from(method).build(&Scene::lmt108());
        for query in &queries {
            let (a, b) = (name(&*built, &plain, query, 1), name(&*built, &renamed, query, 2));
            let place = |names: &[&str], r: &Ranking| names.iter().position(|n| *n == r.surface());
            let method = method.as_str();
            assert_eq!(place(&surfaces, &a), place(&others, &b), "{method}");
            let of = |r: &Ranking| (r.confidence, r.p_value, r.margin);
            assert_eq!(of(&a), of(&b), "{method}");
        }
    }
}
