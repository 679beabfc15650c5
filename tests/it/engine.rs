//! The engine's shortcuts against the plain computation, through the method `reference`.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;

use crate::common;
use surfaced::dataset::synth::{self, Parameters};
use surfaced::library::Entry;
use surfaced::recognise::{
    LibraryShape, MethodName, MethodSpec, Ranking, RecogniseError, Reference, ReferenceOptions,
    Stage, SumPrecision, prepare_library,
};
use surfaced::scene::Scene;
use surfaced::trial::{EXPERT, Trial};

/// Small enough to be sampled in a moment: short drags, few samples.
fn options() -> ReferenceOptions {
    ReferenceOptions { samples: 96, repetitions: 3, ..ReferenceOptions::default() }
}

fn scene() -> (Vec<Entry>, Vec<Entry>) {
    let parameters =
        Parameters { surfaces: 4, trials: 3, users: 1, drag_seconds: 0.4, ..Parameters::default() };
    synth::library(&parameters).entries.into_iter().partition(|e| e.key.user == EXPERT)
}

fn rankings(options: ReferenceOptions, library: &[Entry], queries: &[Entry]) -> Vec<Ranking> {
    let method = Reference::new(Scene::lmt108(), options);
    let all = (0..library.len()).collect();
    let library = prepare_library(&method, library, &all, None, &|_, _| ()).unwrap();
    let model = library.fit(&method, &all).unwrap();
    let query = |e: &Entry| model.prepare(e, &e.load().unwrap()).unwrap();
    queries.iter().map(|e| model.rank(&query(e)).unwrap()).collect()
}

fn assert_close(a: &[Ranking], b: &[Ranking], relative: f64) {
    for (a, b) in a.iter().zip(b) {
        assert_eq!(a.nearest, b.nearest);
        for (x, y) in a.ranked.iter().zip(&b.ranked) {
            assert_eq!(x.surface, y.surface);
            assert!((x.score / y.score - 1.0).abs() < relative, "{} vs {}", x.score, y.score);
        }
    }
}

#[test]
fn tables_and_fast_sums_rank_as_the_oracle_does() {
    let (library, queries) = scene();
    let oracle = ReferenceOptions { precision: SumPrecision::Oracle, ..options() };
    let oracle = rankings(oracle, &library, &queries);
    let plain = ReferenceOptions { tabulate: false, ..options() };
    // Eight factors, each within 1e-4 relative or absolute.
    assert_close(&rankings(plain, &library, &queries), &oracle, 2e-3);
    assert_close(&rankings(options(), &library, &queries), &oracle, 2e-3);
}

#[test]
fn halving_that_keeps_all_changes_nothing_and_any_keeps_all_surfaces() {
    let (library, queries) = scene();
    let exact = rankings(options(), &library, &queries);
    let halved = |keep| {
        let halving = vec![Stage { repetitions: 1, keep }];
        rankings(ReferenceOptions { halving, ..options() }, &library, &queries)
    };
    assert_eq!(halved(12), exact);
    for (halved, exact) in halved(4).iter().zip(&exact) {
        assert_eq!(halved.surface(), exact.surface());
        assert_eq!(halved.ranked.len(), 4);
        assert!(halved.ranked.is_sorted_by(|a, b| a.score <= b.score));
    }
}

#[test]
fn neither_the_number_of_threads_nor_the_order_of_the_library_matters() {
    let (library, queries) = scene();
    let halving = vec![Stage { repetitions: 1, keep: 5 }];
    let options = ReferenceOptions { halving, ..options() };
    let with = |threads, library: &[Entry]| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| rankings(options.clone(), library, &queries))
    };
    let one = with(1, &library);
    let backwards: Vec<Entry> = library.iter().rev().cloned().collect();
    assert_eq!(one, with(3, &backwards));
}

/// How many trials of a library on disk a preparation took from the cache, what it remarked, and
/// how a method ranks one of them.
fn prepare(folder: &Path, method: impl Into<MethodSpec>) -> (usize, Vec<String>, Ranking) {
    let library = surfaced::dataset::open(folder, &Scene::lmt108()).unwrap();
    let method = method.into().build(&library.scene);
    let wanted: BTreeSet<usize> = (0..library.entries.len()).collect();
    let made =
        prepare_library(&*method, &library.entries, &wanted, Some(folder), &|_, _| ()).unwrap();
    let model = made.fit(&*method, &wanted).unwrap();
    let query = &library.entries[0];
    let query = model.prepare(query, &query.load().unwrap()).unwrap();
    (made.from_cache, made.remarks, model.rank(&query).unwrap())
}

fn reference() -> MethodSpec {
    MethodSpec::Reference(options())
}

fn on_disk() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (surface, number) in [("oak", 1), ("oak", 2), ("felt", 1), ("felt", 2)] {
        for source in ["mi2", "ir"] {
            let samples: Vec<i16> = (0..3000u32)
                .map(|i| (i * i * (number + surface.len() as u32) % 2003) as i16)
                .collect();
            let path = folder.path().join(format!("{surface}/{number}/{source}.wav"));
            common::write_wav(&path, if source == "ir" { 10_000 } else { 44_100 }, 1, &samples);
        }
    }
    folder
}

#[test]
fn a_cached_library_ranks_exactly_as_a_new_one_by_every_method() {
    let folder = on_disk();
    let others = MethodName::ALL.into_iter().filter(|name| *name != MethodName::Reference);
    for method in others.map(MethodSpec::from).chain([reference()]) {
        let (first, remarks, anew) = prepare(folder.path(), method.clone());
        assert_eq!((first, remarks), (0, Vec::<String>::new()), "{method:?}");
        let (second, remarks, cached) = prepare(folder.path(), method.clone());
        assert_eq!((second, remarks), (4, Vec::<String>::new()), "{method:?}");
        assert_eq!(anew, cached, "{method:?}");
    }
}

#[test]
fn trials_drawn_for_each_pair_are_not_cached() {
    let folder = on_disk();
    let positions = surfaced::recognise::PositionMode::PerPair;
    for _ in 0..2 {
        let method = MethodSpec::Reference(ReferenceOptions { positions, ..options() });
        assert_eq!(prepare(folder.path(), method).0, 0);
    }
    assert!(!folder.path().join(".reference.surfaced-cache").exists());
}

#[test]
fn a_trial_that_another_method_prepared_is_refused_by_name() {
    let (scene, shape) = (Scene::lmt108(), Arc::new(LibraryShape::default()));
    let of = |name: MethodName| MethodSpec::from(name).build(&scene);
    let prepared = |name| {
        let trials = ["oak", "beech"].map(|surface| common::trial(surface, EXPERT, 1));
        let prepare = |trial: Trial| {
            of(name).prepare(&Entry::in_memory(trial.clone()), &trial, &shape).unwrap()
        };
        trials.map(prepare).to_vec()
    };
    let refused = |by: MethodName, of_method: MethodName| {
        of(by).fit(prepared(of_method), &shape).err().unwrap()
    };
    let error = refused(MethodName::Reference, MethodName::Embedding);
    assert!(matches!(error, RecogniseError::PreparedByAnother { by: "embedding", .. }), "{error}");
    let error = refused(MethodName::Svm, MethodName::Reference);
    assert!(error.to_string().contains("was prepared for reference"), "{error}");
    let error = refused(MethodName::Embedding, MethodName::Svm);
    assert!(matches!(error, RecogniseError::NeedsRecordings("embedding")), "{error}");
}

#[test]
fn only_what_changed_is_prepared_anew() {
    let folder = on_disk();
    prepare(folder.path(), reference());
    common::write_wav(&folder.path().join("oak/2/ir.wav"), 10_000, 1, &[5, 7, 9, 11, 13]);
    assert_eq!(prepare(folder.path(), reference()).0, 3);
    assert_eq!(prepare(folder.path(), reference()).0, 4);
}

#[test]
fn other_settings_and_a_damaged_cache_are_prepared_anew_with_a_remark() {
    let folder = on_disk();
    prepare(folder.path(), reference());
    let other = MethodSpec::Reference(ReferenceOptions { seed: 2, ..options() });
    let (from_cache, remarks, _) = prepare(folder.path(), other.clone());
    assert_eq!(from_cache, 0);
    assert!(remarks[0].contains("other settings"), "{remarks:?}");
    let file = folder.path().join(".reference.surfaced-cache");
    let bytes = std::fs::read(&file).unwrap();
    std::fs::write(&file, &bytes[..bytes.len() / 2]).unwrap();
    let (from_cache, remarks, _) = prepare(folder.path(), other.clone());
    assert!(from_cache < 4 && remarks[0].contains("cut short"), "{from_cache} {remarks:?}");
    assert_eq!(prepare(folder.path(), other).0, 4);
}

#[test]
fn a_cache_that_cannot_be_written_is_a_remark() {
    let folder = on_disk();
    // A folder in the place of the file: neither read nor replaced, even by root.
    std::fs::create_dir_all(folder.path().join(".reference.surfaced-cache/in-the-way")).unwrap();
    let (from_cache, remarks, _) = prepare(folder.path(), reference());
    assert_eq!(from_cache, 0);
    assert!(remarks.iter().any(|r| r.contains("not kept")), "{remarks:?}");
}
