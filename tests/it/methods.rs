//! The method `embedding`, on the real sounds where they are there, and on made ones.
//!
//! Bounds on accuracy lie below what was measured with all ten folds (README): they catch what
//! breaks, not what wavers.

use std::sync::Arc;

use crate::common::{id, picture, real_sounds, series};
use surfaced::evaluate::{Evaluation, Fold};
use surfaced::library::Entry;
use surfaced::recognise::{
    Embedding, EmbeddingModel, EmbeddingOptions, FollowOptions, FreshFrames, LeftOutBy,
    LibraryShape, Method, MethodName, MethodSpec, Model, Ranking, RecogniseError, ReferenceOptions,
    TrialFrames,
};
use surfaced::scene::{Colour, Domain, Scene, SourceId};
use surfaced::seed;
use surfaced::trial::{Series, Signal, Trial, TrialKey};

fn embedding(scene: &Scene) -> Embedding {
    Embedding::new(scene.clone(), EmbeddingOptions::default())
}

fn accuracy(method: &dyn Method, entries: &[Entry], folds: &[Fold], seconds: Option<f64>) -> f64 {
    let scene = Scene::lmt108();
    let evaluation = Evaluation::new(&scene, entries, folds);
    let run = Evaluation { query_seconds: seconds, ..evaluation }.prepare(method).unwrap();
    run.measure().unwrap().outcome.accuracy_mean
}

#[test]
fn embedding_names_real_sounds_whole_and_short() {
    let Some((scene, entries, folds)) = real_sounds(3) else { return };
    let method = embedding(&scene);
    assert!(accuracy(&method, &entries, &folds, None) >= 0.98);
    assert!(accuracy(&method, &entries, &folds, Some(1.0)) >= 0.93);
    assert!(accuracy(&method, &entries, &folds, Some(0.5)) >= 0.88);
}

/// The band below 80 Hz alone, which gives away the room and the session. It is a scene, so that every
/// chart can show it, and may not come near the method itself.
#[test]
fn negative_controls_stay_far_below() {
    let Some((_, entries, folds)) = real_sounds(3) else { return };
    let control = |band: &str, align: bool| {
        let text = format!(
            "format = 1\n[sources.mi2]\ndomain = \"spectrum\"\nband_hz = {band}\n\
             align_mean = {align}\n"
        );
        accuracy(&embedding(&Scene::from_toml(&text).unwrap()), &entries, &folds, None)
    };
    let below_80_hz = control("[0, 80]", false);
    assert!((0.3..0.9).contains(&below_80_hz), "{below_80_hz}");
}

#[test]
fn a_hand_that_presses_a_little_more_or_less_changes_no_name() {
    let Some((scene, entries, folds)) = real_sounds(1) else { return };
    let method = embedding(&scene);
    let library: Vec<Trial> =
        folds[0].library.iter().map(|&i| entries[i].load().unwrap()).collect();
    let model = trained(&scene, &method, &library);
    for &query in folds[0].queries.iter().step_by(6) {
        let trial = entries[query].load().unwrap();
        let plain = rank(&model, &trial).unwrap();
        for gain in [0.8, 1.25] {
            let mut pressed = trial.clone();
            for signal in pressed.signals.values_mut() {
                if let Signal::Series(series) = signal {
                    series.view_mut().mapv_inplace(|x| x * gain);
                }
            }
            assert_eq!(plain.surface(), rank(&model, &pressed).unwrap().surface());
        }
    }
}

#[test]
fn of_a_sources_configuration_the_band_alone_counts() {
    let (library, query) = (made_library(3, 1.2), made(2, 9, 1.2));
    let plain = Scene::lmt108();
    let expected = fit_and_rank(&plain, &library, &query);
    let other = plain.clone().changed(|spec| {
        spec.align_mean = !spec.align_mean;
        match spec.domain {
            Domain::Spectrum { band_hz } => spec.domain = Domain::Time { band_hz: Some(band_hz) },
            Domain::Time { band_hz: Some(band_hz) } => spec.domain = Domain::Spectrum { band_hz },
            Domain::Time { band_hz: None } => {}
            Domain::Image => spec.colour = Colour::Value,
        }
    });
    assert_eq!(fit_and_rank(&other, &library, &query), expected);
}

#[test]
fn what_a_band_excludes_changes_nothing() {
    let scene = "format = 1\n[sources.ac]\ndomain = \"time\"\nchannels = 3\nband_hz = [0, 1000]\n";
    let scene = Scene::from_toml(scene).unwrap();
    let library = made_library(3, 1.2);
    let model = trained(&scene, &embedding(&scene), &library);
    let query = made(2, 9, 1.2);
    let mut disturbed = query.clone();
    if let Some(Signal::Series(series)) = disturbed.signals.get_mut(&id("ac")) {
        for (t, mut frame) in series.view_mut().rows_mut().into_iter().enumerate() {
            // 3.2 kHz, as loud as the scan, and an offset.
            let hum = ((t * 8 % 25) as f32 / 25.0 * std::f32::consts::TAU).sin();
            frame.mapv_inplace(|x| x + 0.08 * hum + 0.25);
        }
    }
    let (plain, hummed) = (rank(&model, &query).unwrap(), rank(&model, &disturbed).unwrap());
    assert_eq!(plain.surface(), hummed.surface());
    assert!((plain.margin - hummed.margin).abs() < 0.05 * plain.margin, "{plain:?} {hummed:?}");
}

fn trained(scene: &Scene, method: &Embedding, library: &[Trial]) -> EmbeddingModel {
    let entries: Vec<Entry> = library.iter().cloned().map(Entry::in_memory).collect();
    let shape = Arc::new(LibraryShape::of(&entries.iter().collect::<Vec<_>>()).unwrap());
    let framed = |t: &Trial| Arc::new(TrialFrames::new(&t.key, t, scene, &shape, Some(1)).unwrap());
    method.train(library.iter().map(framed).collect(), &shape).unwrap()
}

fn rank(model: &EmbeddingModel, query: &Trial) -> Result<Ranking, RecogniseError> {
    model.rank_trial(query.clone())
}

/// Coloured noise: each surface has a spectrum and a roughness of its own. About `seconds` long.
fn made(surface: usize, number: u32, seconds: f64) -> Trial {
    use rand::RngExt;
    let mut rng = seed::rng(7, &[&surface.to_le_bytes(), &number.to_le_bytes()]);
    let mut noise = |rate_hz: f64, channels: usize| {
        let pole = 0.1 + 0.2 * surface as f32;
        let frames = (rate_hz * seconds) as usize;
        let mut state = vec![0f32; channels];
        let mut samples = Vec::with_capacity(frames * channels);
        for _ in 0..frames {
            for (c, x) in state.iter_mut().enumerate() {
                let pole = pole / (1.0 + 0.3 * c as f32);
                *x = pole * *x + rng.random_range(-0.1f32..0.1);
                samples.push(*x);
            }
        }
        Signal::Series(Series::new(rate_hz, channels, samples).unwrap())
    };
    let flat = Signal::Series(Series::new(1e4, 1, vec![0.0; (1e4 * seconds) as usize]).unwrap());
    let signals = [
        ("ac", noise(10_000.0, 3)),
        ("ca1", picture(100 * number + surface as u32)),
        ("fr", noise(10_000.0, 2)),
        ("ir", noise(10_000.0, 1)),
        ("me", flat),
        ("mi2", noise(44_100.0, 1)),
    ];
    Trial {
        key: TrialKey::new(format!("s{surface}"), "expert", number),
        signals: signals.into_iter().map(|(name, signal)| (id(name), signal)).collect(),
    }
}

fn made_library(trials: u32, seconds: f64) -> Vec<Trial> {
    (0..4).flat_map(|s| (1..=trials).map(move |n| made(s, n, seconds))).collect()
}

fn fit_and_rank(scene: &Scene, library: &[Trial], query: &Trial) -> Ranking {
    rank(&trained(scene, &embedding(scene), library), query).unwrap()
}

fn checked(ranking: &Ranking, surfaces: usize) {
    assert_eq!(ranking.ranked.len(), surfaces);
    assert!(ranking.ranked.iter().all(|r| r.score.is_finite()), "{ranking:?}");
    assert!(ranking.ranked.windows(2).all(|pair| pair[0].score <= pair[1].score));
    assert!(ranking.margin.is_finite() && ranking.margin >= 0.0);
}

#[test]
fn neither_the_order_of_a_library_nor_the_number_of_threads_matters() {
    let scene = Scene::lmt108();
    let library = made_library(3, 1.2);
    let mut reversed = library.clone();
    reversed.reverse();
    let query = made(2, 9, 1.2);
    let ranked = |library: &[Trial]| fit_and_rank(&scene, library, &query);
    let expected = ranked(&library);
    checked(&expected, 4);
    assert_eq!(expected.surface(), "s2");
    assert_eq!(ranked(&reversed), expected);
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert_eq!(one.install(|| ranked(&library)), expected);
}

#[test]
fn tiny_short_and_patchy_libraries_give_a_full_ranking() {
    let scene = Scene::lmt108();
    for (trials, seconds) in [(1, 1.2), (1, 0.02), (2, 0.3), (1, 0.0003)] {
        let mut library = made_library(trials, seconds);
        let query = made(1, 9, seconds);
        checked(&fit_and_rank(&scene, &library, &query), 4);
        // One surface loses all but a picture, one trial its picture.
        library[0].signals.retain(|name, _| name == &id("ca1"));
        let last = library.len() - 1;
        library[last].signals.remove(&id("ca1"));
        checked(&fit_and_rank(&scene, &library, &query), 4);
    }
}

#[test]
fn one_trial_a_surface_states_no_probability() {
    let scene = Scene::lmt108().only(&[id("mi2"), id("ir")]).unwrap();
    let model = trained(&scene, &embedding(&scene), &made_library(1, 1.2));
    let ranking = rank(&model, &made(3, 5, 1.2)).unwrap();
    assert_eq!((ranking.surface(), ranking.confidence), ("s3", None));
}

/// White noise under three names, which can be told apart by shared samples alone.
#[test]
fn trials_that_share_samples_are_left_out_together() {
    let scene = Scene::lmt108().only(&[id("mi2")]).unwrap();
    let noise = |name: String| -> Vec<f32> {
        let mut rng = seed::rng(1, &[name.as_bytes()]);
        (0..30_000).map(|_| 0.1 * seed::normal(&mut rng) as f32).collect()
    };
    let trial = |surface: &str, number: usize, samples: &[f32]| {
        let series = Series::new(10_000.0, 1, samples.to_vec()).unwrap();
        Trial::of_series(TrialKey::new(surface, "expert", number as u32), id("mi2"), series)
    };
    let library = |of: &dyn Fn(&str, usize) -> Trial| -> Vec<Trial> {
        let of_surface = |surface| (1..=12).map(move |number| of(surface, number));
        ["a", "b", "c"].into_iter().flat_map(of_surface).collect()
    };
    let copies = library(&|surface, number| {
        trial(surface, number, &noise(format!("{surface} {}", number.div_ceil(2)))[..4_000])
    });
    let model = trained(&scene, &embedding(&scene), &copies);
    let accuracy = model.left_out_accuracy();
    assert_eq!(accuracy.trials(), 36);
    let whole = accuracy.points().last().unwrap().accuracy;
    assert!(whole < 0.65, "{whole}");
    // Excerpts that overlap by half are one recording a surface: nothing can be left out.
    let excerpts = library(&|surface, number| {
        trial(surface, number, &noise(surface.into())[2_000 * number..2_000 * number + 4_000])
    });
    let model = trained(&scene, &embedding(&scene), &excerpts);
    assert_eq!(model.left_out_accuracy().trials(), 0);
    assert_eq!(rank(&model, &excerpts[0]).unwrap().confidence, None);
}

#[test]
fn no_probability_is_beyond_what_the_library_can_show() {
    let scene = Scene::lmt108().only(&[id("mi2"), id("ir")]).unwrap();
    let model = trained(&scene, &embedding(&scene), &made_library(3, 1.2));
    assert_eq!(model.left_out_accuracy().trials(), 12);
    let ranking = rank(&model, &made(3, 5, 1.2)).unwrap();
    let most = 12.5 / 13.0;
    assert!((0.5..=most + 1e-12).contains(&ranking.confidence.unwrap()), "{ranking:?}");
}

#[test]
fn scans_are_called_unknown_by_all_trials_also_those_of_a_surface_that_one_person_recorded() {
    let by = |user: &str, surfaces: std::ops::Range<usize>| -> Vec<Trial> {
        let numbered = |surface| (1..=3).map(move |number| (surface, number));
        let trials = surfaces.flat_map(numbered).map(|(surface, number)| {
            let mut trial = made(surface, number + user.len() as u32, 1.0);
            trial.key.user = user.into();
            trial
        });
        trials.collect()
    };
    let scene = Scene::lmt108();
    let library = [by("anna", 0..2), by("b", 0..3)].concat();
    let rejection = trained(&scene, &embedding(&scene), &library).rejection(None).unwrap();
    assert_eq!(rejection.left_out, LeftOutBy::People);
    assert_eq!(rejection.trials, library.len());
}

#[test]
fn a_query_that_says_nothing_is_not_named() {
    let scene = Scene::lmt108().only(&[id("mi2"), id("ir")]).unwrap();
    let model = trained(&scene, &embedding(&scene), &made_library(2, 1.2));
    let short = made(1, 9, 0.0003);
    let mut silent = made(1, 9, 1.2);
    for name in ["mi2", "ir"] {
        let flat = Series::new(10_000.0, 1, vec![0.25; 12_000]).unwrap();
        silent.signals.insert(id(name), Signal::Series(flat));
    }
    silent.signals.remove(&id("mi2"));
    for query in [short, silent] {
        let error = rank(&model, &query).unwrap_err();
        assert!(matches!(error, RecogniseError::TooLittle), "{error}");
    }
}

#[test]
fn surfaces_that_differ_by_the_level_of_a_constant_channel_alone_are_told_apart() {
    let scene = Scene::of_series(id("ir"), 1, 1000.0, None).unwrap();
    let level = |surface: usize, number: u32| {
        let level = 0.1 + 0.2 * surface as f32 + 0.001 * (number as f32 * 0.7).sin();
        let key = TrialKey::new(["oak", "steel"][surface], "expert", number);
        Trial::of_series(key, id("ir"), Series::new(1000.0, 1, vec![level; 2000]).unwrap())
    };
    // One surface has a trial more than the other, as where trials are left out one at a time.
    let library: Vec<Trial> =
        (1..=7).map(|n| level(0, n)).chain((1..=8).map(|n| level(1, n))).collect();
    for (surface, number) in [(0, 9), (0, 10), (1, 9), (1, 10)] {
        let query = level(surface, number);
        let ranking = fit_and_rank(&scene, &library, &query);
        assert_eq!(ranking.surface(), query.key.surface);
        assert!(ranking.probabilities()[0] > 0.8, "{ranking:?}");
    }
}

#[test]
fn constant_and_silent_sources_never_make_nan() {
    let scene = Scene::lmt108();
    let constant = |surface: usize, number: u32| {
        let mut trial = made(surface, number, 1.2);
        for (name, rate_hz, channels) in [("mi2", 44_100.0, 1), ("ac", 1e4, 3), ("ir", 1e4, 1)] {
            let samples = vec![0.0; (rate_hz * 1.2) as usize * channels];
            let flat = Series::new(rate_hz, channels, samples).unwrap();
            trial.signals.insert(id(name), Signal::Series(flat));
        }
        trial
    };
    let library: Vec<Trial> = (0..3).flat_map(|s| (1..=2).map(move |n| constant(s, n))).collect();
    for query in [constant(1, 8), made(1, 8, 1.2)] {
        checked(&fit_and_rank(&scene, &library, &query), 3);
    }
}

#[test]
fn a_scan_in_pieces_is_the_scan_at_once() {
    let scene = Scene::lmt108();
    let model = Arc::new(trained(&scene, &embedding(&scene), &made_library(2, 1.2)));
    let mut follower = Arc::clone(&model).follow(&FollowOptions::default());
    for seconds in [0.1, 0.4, 1.2] {
        let whole = made(1, 7, seconds);
        follower.begin();
        for (name, signal) in &whole.signals {
            let series = match signal {
                Signal::Series(series) => series,
                Signal::Image(image) => {
                    follower.add_picture(name, image);
                    continue;
                }
            };
            let (rate_hz, channels) = (series.rate_hz(), series.channels());
            // Pieces of 37 ms, as they would come from a ring.
            let step = (rate_hz * 0.037) as usize * channels;
            for samples in series.samples().chunks(step) {
                follower.add(FreshFrames { source: name, rate_hz, channels, samples }).unwrap();
            }
        }
        let guess = follower.look(seconds).unwrap().unwrap();
        // A source that rests in a scan so far is left out of it; the metal detector may rest.
        let ranking = rank(&model, &whole).unwrap();
        assert_eq!(guess.named[0].0, ranking.surface());
        assert!((guess.named[0].1 - ranking.confidence.unwrap()).abs() < 1e-4, "{seconds} s");
    }
}

#[test]
fn rates_may_differ_where_the_band_is_the_same_and_are_refused_where_it_is_not() {
    let scene =
        Scene::from_toml("format = 1\n[sources.mi2]\ndomain = \"spectrum\"\nband_hz = [0, 7500]\n")
            .unwrap();
    let at = |rate_hz: f64, surface: usize| Trial {
        key: TrialKey::new(format!("s{surface}"), "expert", 1),
        signals: [(id("mi2"), tone(rate_hz, 500.0 * (surface + 1) as f64))].into_iter().collect(),
    };
    let library: Vec<Trial> = (0..3).map(|s| at(44_100.0, s)).collect();
    for rate_hz in [48_000.0, 22_050.0, 96_000.0] {
        let query = at(rate_hz, 1);
        assert_eq!(fit_and_rank(&scene, &library, &query).surface(), "s1");
    }
    let model = trained(&scene, &embedding(&scene), &library);
    let error = rank(&model, &at(8_000.0, 1)).unwrap_err();
    assert!(error.to_string().contains("8000 Hz in the query"), "{error}");
}

fn tone(rate_hz: f64, hz: f64) -> Signal {
    let Signal::Series(noise) = series(rate_hz, 1, (rate_hz * 1.5) as usize, 3) else {
        unreachable!("a series was asked for")
    };
    let wave = |i: usize| (std::f64::consts::TAU * hz * i as f64 / rate_hz).sin() as f32;
    let samples: Vec<f32> =
        (noise.samples().iter().enumerate()).map(|(i, x)| 0.3 * wave(i) + 0.001 * x).collect();
    Signal::Series(Series::new(rate_hz, 1, samples).unwrap())
}

#[test]
fn a_query_without_a_common_source_is_refused() {
    let scene = Scene::lmt108();
    let mut query = made(1, 1, 0.5);
    query.signals.retain(|name: &SourceId, _| name == &id("ir"));
    let mut library = made_library(1, 0.5);
    library.iter_mut().for_each(|t| t.signals.retain(|name, _| name != &id("ir")));
    let model = trained(&scene, &embedding(&scene), &library);
    let error = rank(&model, &query).unwrap_err().to_string();
    assert!(error.contains("no source in common: the query has ir"), "{error}");
}

#[test]
fn a_spec_survives_being_written_and_says_only_what_is_unusual() {
    for name in MethodName::ALL {
        let spec = MethodSpec::from(name);
        let text = toml::to_string(&spec).unwrap();
        assert_eq!(toml::from_str::<MethodSpec>(&text).unwrap(), spec, "{text}");
        assert_eq!(spec.name(), name);
        assert_eq!(spec.build(&Scene::lmt108()).name(), name.as_str());
    }
    let options = ReferenceOptions { samples: 100, repetitions: 1, ..Default::default() };
    let text = toml::to_string(&MethodSpec::Reference(options)).unwrap();
    assert_eq!(text, "method = \"reference\"\nn = 100\nrepetitions = 1\n");
}

#[test]
fn settings_of_another_method_are_refused() {
    let spec = |text: &str| toml::from_str::<MethodSpec>(text);
    assert!(spec("method = \"reference\"\nneighbours = 3").is_ok());
    for text in ["method = \"embedding\"\nn = 3", "method = \"svm\"\nn = 3", "method = \"joint\""] {
        assert!(spec(text).is_err(), "{text}");
    }
}
