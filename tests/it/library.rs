//! The recording format, version 1: what is written is read, and what is wrong is said.

use crate::common::{self, id, open, picture, says, series, temp, trial, write_file, write_wav};
use proptest::prelude::*;
use surfaced::dataset;
use surfaced::library::{About, recording};
use surfaced::record::{TrialOptions, write_library_toml, write_trial};
use surfaced::scene::Scene;
use surfaced::trial::{Series, Signal, Trial, TrialKey};
use unicode_normalization::UnicodeNormalization;

fn quick() -> TrialOptions {
    TrialOptions { durable: false, ..TrialOptions::default() }
}

#[test]
fn a_written_library_is_read_back_whole() {
    let (_dir, path) = temp();
    let scene = Scene::lmt108();
    let trials = [
        trial("Oak", "expert", 2),
        trial("Oak", "user1", 1),
        trial("../etc/passwd", "ex pert/..", 1),
        trial("Stahl, gebürstet · 鋼", "expert", 10),
    ];
    write_library_toml(&path, &scene, "ours", false).unwrap();
    for trial in &trials {
        let folder = write_trial(&path, trial, &scene, &TrialOptions::default()).unwrap();
        assert_eq!(
            folder.canonicalize().unwrap().parent().unwrap().parent().unwrap(),
            path.canonicalize().unwrap()
        );
    }
    let library = open(&path).unwrap();
    common::assert_outlines_are_true(&library);
    assert_eq!((library.name.as_str(), library.synthetic), ("ours", false));
    assert_eq!(library.remarks, Vec::<String>::new());
    assert!(library.entries.is_sorted_by_key(|entry| &entry.key));
    assert_eq!(library.surfaces(), ["../etc/passwd", "Oak", "Stahl, gebürstet · 鋼"]);
    let read: Vec<Trial> = library.entries.iter().map(|entry| entry.load().unwrap()).collect();
    assert!(trials.iter().all(|trial| read.contains(trial)));
    assert_eq!(library.entries[0].sources.len(), 8);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    #[test]
    fn whatever_is_written_is_read_back_identical(
        surface in "\\PC{1,12}|[./\\\\ %]{1,3}|.{1,4}", user in "[a-z. /]{1,6}", number: u32,
        rate in 1u32..200_000,
        samples in prop_oneof![
            prop::collection::vec(any::<i16>().prop_map(|x| f32::from(x) / 32768.0), 2..60),
            prop::collection::vec(-1e18f32..1e18, 2..60),
            // Far apart in magnitude, and none larger than a recording may hold.
            prop::collection::vec((prop::num::f32::NORMAL).prop_map(|x| x % 1e18), 2..60),
            prop::collection::vec(prop::num::f32::SUBNORMAL, 2..8),
        ],
    ) {
        let (_dir, path) = temp();
        let scene = Scene::from_toml("format = 1\n[sources.q]\ndomain = \"time\"\nchannels = 2").unwrap();
        let even = samples.len() / 2 * 2;
        let signal = Series::new(f64::from(rate), 2, samples[..even].to_vec()).unwrap();
        // Labels are read in normal form C.
        let surface: String = surface.nfc().collect();
        let key = TrialKey::new(surface, user, number);
        let trial = Trial { key, signals: [(id("q"), Signal::Series(signal))].into() };
        write_trial(&path, &trial, &scene, &quick()).unwrap();
        let library = dataset::open(&path, &scene).unwrap();
        let read = library.entries[0].load().unwrap();
        prop_assert_eq!(&read, &trial);
        let (Signal::Series(a), Signal::Series(b)) = (&read.signals["q"], &trial.signals["q"]) else {
            panic!("series became images");
        };
        let bits = |s: &Series| s.samples().iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        prop_assert_eq!(bits(a), bits(b));
    }

    #[test]
    fn damaged_files_never_panic(at in 0usize..120, byte: u8, cut in 0usize..300, image: bool) {
        let (_dir, path) = temp();
        let whole = Trial {
            key: TrialKey::new("S", "expert", 1),
            signals: [if image { (id("ca1"), picture(1)) } else { (id("ir"), series(10_000.0, 1, 50, 1)) }].into(),
        };
        let folder = write_trial(&path, &whole, &Scene::lmt108(), &quick()).unwrap();
        let file = folder.join(if image { "ca1.png" } else { "ir.wav" });
        let mut bytes = std::fs::read(&file).unwrap();
        let end = bytes.len().saturating_sub(cut);
        bytes[at] = byte;
        std::fs::write(&file, &bytes[..end]).unwrap();
        if let Ok(library) = open(&path) {
            let _ = library.entries[0].load();
        }
    }
}

#[test]
fn a_ninth_source_needs_only_library_toml() {
    let (_dir, path) = temp();
    write_file(
        &path.join("library.toml"),
        "format = 1\nname = \"nine\"\n[sources.pac]\n\
        domain = \"spectrum\"\nband_hz = [0, 1000]\nalign_mean = true\nchannels = 1\nrate_hz = 2200\n",
    );
    write_wav(&path.join("Oak/trial7/pac.wav"), 2200, 1, &[16384, -32768]);
    write_wav(&path.join("Oak/trial7/mi2.wav"), 48_000, 1, &[1]);
    let library = open(&path).unwrap();
    assert_eq!(library.scene.sources().len(), 9);
    let read = library.entries[0].load().unwrap();
    assert_eq!(read.key, TrialKey::new("Oak", "expert", 7));
    assert_eq!(
        read.signals["pac"],
        Signal::Series(Series::new(2200.0, 1, vec![0.5, -1.0]).unwrap())
    );
    let Signal::Series(sound) = &read.signals["mi2"] else { panic!("a sound is a series") };
    assert_eq!(sound.rate_hz(), 48_000.0, "the header counts where library.toml is silent");
}

#[test]
fn files_of_24_bits_are_scaled_to_one() {
    let (_dir, path) = temp();
    let file = path.join("Oak/1/fr.wav");
    std::fs::create_dir_all(file.parent().unwrap()).unwrap();
    let spec = hound::WavSpec {
        channels: 2,
        sample_rate: 10_000,
        bits_per_sample: 24,
        sample_format: hound::SampleFormat::Int,
    };
    let mut writer = hound::WavWriter::create(&file, spec).unwrap();
    [-(1 << 23), 1 << 22].iter().for_each(|&x| writer.write_sample(x).unwrap());
    writer.finalize().unwrap();
    let read = open(&path).unwrap().entries[0].load().unwrap();
    assert_eq!(read.signals["fr"], Signal::Series(Series::new(1e4, 2, vec![-1.0, 0.5]).unwrap()));
}

#[test]
fn what_trial_toml_says_wins_over_the_folders() {
    let (_dir, path) = temp();
    write_wav(&path.join("a/b/mi2.wav"), 44_100, 1, &[1]);
    write_file(
        &path.join("a/b/trial.toml"),
        "surface = \"Öl / Stein\"\nuser = \"u\"\ntrial = 4\nsynthetic = true\nnotes = \"n\"\n\
         started_at = 2025-01-31T12:00:00Z\ndevices = { mi2 = \"hw:1\" }\nscan = { drag_s = [0.5, 5.3] }",
    );
    let library = open(&path).unwrap();
    assert_eq!(library.entries[0].key, TrialKey::new("Öl / Stein", "u", 4));
    assert!(library.synthetic);
    let about = About::read(&path.join("a/b")).unwrap();
    assert_eq!(about.scan, Some(toml::toml! { drag_s = [0.5, 5.3] }), "kept as it stands");
}

#[test]
fn a_synthetic_library_says_so() {
    let (_dir, path) = temp();
    write_library_toml(&path, &Scene::lmt108(), "made \"up\"", true).unwrap();
    write_trial(&path, &trial("A", "expert", 1), &Scene::lmt108(), &quick()).unwrap();
    let library = open(&path).unwrap();
    assert!(library.synthetic && library.name == "made \"up\"");
}

#[test]
fn what_is_passed_over_is_said() {
    let (_dir, path) = temp();
    write_wav(&path.join("Oak/1/mi2.wav"), 44_100, 1, &[1]);
    for number in 1..=3 {
        write_file(&path.join(format!("Oak/{number}/depth.png")), "PNG");
    }
    write_wav(&path.join("Oak/mi2.wav"), 44_100, 1, &[1]);
    write_wav(&path.join("Oak/9/mi2.wav"), 44_100, 1, &[1]);
    write_file(&path.join("Oak/9/trial.toml"), "incomplete = true");
    write_file(&path.join("Oak/.expert-10.1.unfinished/mi2.wav"), "RIFF");
    write_file(&path.join("Oak/1/notes.md"), "anything");
    let library = open(&path).unwrap();
    assert_eq!(library.entries.len(), 1);
    let remarks = library.remarks.join("\n");
    says(
        &remarks,
        &[
            "Oak/1/depth.png and 2 more: not used, since no source is called `depth`; to use it, add to \
         library.toml: [sources.depth] domain = \"image\"",
            "Oak/9: not used, trial.toml says incomplete = true",
            "Oak/mi2.wav: not used, it lies in no TRIAL folder",
            "Oak/.expert-10.1.unfinished: not used, it was never finished",
            "Oak/2 and 1 more: not used, it holds no file of any source",
        ],
    );
}

#[test]
fn a_source_that_no_table_knows_needs_a_name_and_nothing_else() {
    let (_dir, path) = temp();
    for number in 1..=2 {
        write_wav(&path.join(format!("Oak/{number}/tilt.wav")), 400, 3, &[1, 2, 3]);
    }
    write_wav(&path.join("Oak/3/tilt.wav"), 400, 2, &[1, 2]);
    let opened = recording::open_usable(&path, &Scene::lmt108()).unwrap();
    let says_what = "Oak/1/tilt.wav: no source is called `tilt`, so it is taken as a series of \
                     3 channels at 400 Hz";
    assert!(opened.library.remarks.join("\n").contains(says_what), "{:?}", opened.library.remarks);
    assert_eq!((opened.library.entries.len(), opened.bad.len()), (2, 1));
    says(&opened.bad[0].to_string(), &["Oak/3/tilt.wav: 2 channels, but source `tilt` has 3"]);
    // The same where its name alone is described.
    write_file(&path.join("library.toml"), "format = 1\n[sources.tilt]\n");
    let opened = recording::open_usable(&path, &Scene::lmt108()).unwrap();
    let spec = opened.library.scene.get("tilt").unwrap().clone();
    assert_eq!((spec.channels, opened.library.entries.len()), (3, 2));
    assert!(opened.library.remarks.is_empty(), "{:?}", opened.library.remarks);
}

#[test]
fn writing_refuses_what_could_not_be_read() {
    let (_dir, path) = temp();
    let scene = Scene::lmt108();
    let write =
        |trial: &Trial| write_trial(&path, trial, &scene, &quick()).unwrap_err().to_string();
    let with = |name: &str, signal| Trial {
        key: TrialKey::new("S", "expert", 1),
        signals: [(id(name), signal)].into(),
    };
    says(&write(&with("zzz", picture(0))), &["source `zzz`", "does not describe it"]);
    says(
        &write(&with("ac", series(1e4, 2, 9, 0))),
        &["source `ac`: 2 channels, but the scene says 3"],
    );
    says(
        &write(&with("ir", series(5e3, 1, 9, 0))),
        &["source `ir`: 5000 Hz, but the scene says 10000 Hz"],
    );
    says(&write(&with("ir", picture(0))), &["an image, but the scene says a series"]);
    says(&write(&trial("", "expert", 1)), &["name of its surface"]);
    assert!(
        std::fs::read_dir(path.join("S")).unwrap().next().is_none(),
        "nothing half-written stays"
    );
    write_trial(&path, &trial("S", "expert", 1), &scene, &quick()).unwrap();
    says(
        &write(&trial("S", "expert", 1)),
        &["there is a recording of S · expert · trial 1 already"],
    );
}
