//! The LMT108 database in its own layout: a small one made here, and the real one if it is there.

use std::path::{Path, PathBuf};

use crate::common::{self, shared, shared_lmt108, write_file, write_wav};
use surfaced::dataset;
use surfaced::library::Library;
use surfaced::scene::Scene;
use surfaced::trial::{Signal, TrialKey};

const ROOT: &str = "LMT_108_SurfaceMaterials_Database";

fn open(path: &Path) -> Library {
    dataset::open(path, &Scene::lmt108()).unwrap()
}

fn jpeg() -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image::RgbImage::from_pixel(480, 320, image::Rgb([200, 30, 30]))
        .write_to(&mut bytes, image::ImageFormat::Jpeg)
        .unwrap();
    bytes.into_inner()
}

/// One surface, three trials in each split, all files.
fn small_tree() -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join(ROOT);
    let s = "G1Mesh";
    for (split, short) in [("Training", "train"), ("Testing", "test")] {
        for n in 1..=3 {
            let write = |path: String, text: &str| write_file(&root.join(path), text);
            for (axis, text) in
                [("X", "1\r\n2\n3\n"), ("Y", " 0.5\n0.25\n"), ("Z", "-1e-1\n7\n8\n9\n")]
            {
                write(
                    format!(
                        "AccelScansComponents/Movement/{split}/{s}_Movement_{axis}_{short}{n}.txt"
                    ),
                    text,
                );
            }
            for fsr in [1, 2] {
                write(
                    format!(
                        "FricScans/FSR{fsr}/{split}/{s}_FrictionFSR{fsr}_Movement_{short}{n}.txt"
                    ),
                    &format!("{fsr}\n{n}\n\n"),
                );
            }
            write(
                format!("ReflectanceScans/{split}/{s}_Reflectance_Movement_{short}{n}.txt"),
                "4\n5",
            );
            write(
                format!("MetalDetectionScans/{split}/{s}_MetalDetection_Movement_{short}{n}.txt"),
                "0\n1\n",
            );
            for kind in ["Movement", "Tapping"] {
                let path = format!("SoundScans/{kind}/{split}/{s}_Sound_{kind}_{short}{n}.wav");
                write_wav(&root.join(path), 44_100, 1, &[n, 2, 3]);
            }
            let j = (n + 1) % 11;
            for (flash, prefix) in [("NoFlash", ""), ("Flash", "Flash_")] {
                let path =
                    format!("ImageScans/{flash}/{split}/{prefix}{s}_Image_{n}_{short}{j}.jpg");
                write_file(&root.join(path), jpeg());
            }
        }
    }
    write_file(
        &root.join(format!("AccelScansComponents/Tapping/Training/{s}_Tapping_Z_train1.txt")),
        "1\n2\n",
    );
    (dir, root)
}

fn samples(signal: &Signal) -> (f64, usize, &[f32]) {
    match signal {
        Signal::Series(series) => (series.rate_hz(), series.channels(), series.samples()),
        Signal::Image(_) => panic!("expected a series"),
    }
}

#[test]
fn a_small_tree_is_read_whole() {
    let (dir, root) = small_tree();
    for path in [root.as_path(), dir.path()] {
        let library = open(path);
        common::assert_outlines_are_true(&library);
        let keys: Vec<_> = library.entries.iter().map(|entry| entry.key.clone()).collect();
        let expected =
            [("expert", 1), ("expert", 2), ("expert", 3), ("user1", 1), ("user2", 2), ("user3", 3)];
        assert_eq!(keys, expected.map(|(user, n)| TrialKey::new("G1Mesh", user, n)));
        let trial = library.entries[4].load().unwrap();
        assert_eq!(trial.signals.len(), 8);
        assert_eq!(samples(&trial.signals["ac"]), (1e4, 3, &[1.0, 0.5, -0.1, 2.0, 0.25, 7.0][..]));
        assert_eq!(samples(&trial.signals["fr"]), (1e4, 2, &[1.0, 2.0, 2.0, 2.0][..]));
        assert_eq!(samples(&trial.signals["ir"]), (1e4, 1, &[4.0, 5.0][..]));
        assert_eq!(samples(&trial.signals["me"]), (1e4, 1, &[0.0, 1.0][..]));
        assert_eq!(
            samples(&trial.signals["mi2"]),
            (44_100.0, 1, &[2.0, 2.0, 3.0].map(|x| x / 32768.0)[..])
        );
        assert!(matches!(trial.signals["ca2"], Signal::Image(_)));
        assert_eq!(
            library.remarks,
            [
                "found: 1 surface, trials: 3 of the expert, 3 of users; ac × 3 (expert) + 3 (users), \
             ca1 × 3 (expert) + 3 (users), ca2 × 3 (expert) + 3 (users), fr × 3 (expert) + 3 (users), \
             ir × 3 (expert) + 3 (users), me × 3 (expert) + 3 (users), mi1 × 3 (expert) + 3 (users), \
             mi2 × 3 (expert) + 3 (users)",
                "G1Mesh · expert · trial 1: not used, the scene describes no source `act`",
            ]
        );
        assert!(!library.synthetic);
    }
}

#[test]
fn tapping_acceleration_is_a_source_if_the_scene_says_so() {
    let (_dir, root) = small_tree();
    let more = Scene::from_toml("format = 1\n[sources.act]\ndomain = \"time\"").unwrap();
    let library = dataset::open(&root, &Scene::lmt108().with(more)).unwrap();
    assert_eq!(
        samples(&library.entries[0].load().unwrap().signals["act"]),
        (1e4, 1, &[1.0, 2.0][..])
    );
}

#[test]
fn what_is_missing_or_strange_is_said() {
    let (_dir, root) = small_tree();
    let drag = root.join("AccelScansComponents/Movement");
    std::fs::remove_file(drag.join("Training/G1Mesh_Movement_Y_train1.txt")).unwrap();
    std::fs::remove_dir_all(root.join("ImageScans")).unwrap();
    write_file(&root.join("SoundScans/readme.txt"), "hello");
    let remarks = open(&root).remarks.join("\n");
    for part in [
        "G1Mesh · expert · trial 1: source `ac` not used, files missing: Y",
        "missing: ca1, ca2\n",
        "missing here and there: ac in 1 of 6 trials",
        "readme.txt: not used, its name does not end with a number",
    ] {
        assert!(remarks.contains(part), "`{part}` is not in: {remarks}");
    }
}

#[test]
fn a_bad_number_is_named_with_file_and_line() {
    for (text, says) in [
        (
            "1\n0,5\n",
            "line 2: `0,5` is not a number; expected one number a line; write decimals with a point",
        ),
        ("1\n2\nNaN\n", "line 3: NaN; expected a finite number"),
        ("", "the file is empty (0 bytes)"),
        ("\n", "it holds no numbers"),
    ] {
        let (_dir, root) = small_tree();
        let file = root.join("ReflectanceScans/Training/G1Mesh_Reflectance_Movement_train1.txt");
        write_file(&file, text);
        let error = open(&root).entries[0].load().unwrap_err().to_string();
        assert!(error.contains(&file.display().to_string()) && error.contains(says), "{error}");
    }
}

#[test]
fn two_copies_and_empty_ones_are_refused_clearly() {
    let dir = tempfile::tempdir().unwrap();
    let error = || dataset::open(dir.path(), &Scene::lmt108()).unwrap_err().to_string();
    std::fs::create_dir_all(dir.path().join("matlab/DataLMT108/Library")).unwrap();
    assert!(error().contains("`tools/python/from_mat FOLDER LIBRARY`"), "{}", error());
    std::fs::create_dir_all(dir.path().join("raw/SoundScans")).unwrap();
    assert!(error().contains("more than one copy of the LMT108 database (`matlab`, `raw`)"));
    std::fs::remove_dir_all(dir.path().join("matlab")).unwrap();
    assert!(error().contains("without a single whole recording"), "{}", error());
}

#[test]
fn the_real_recordings_are_read() {
    let (Some(path), Some(names)) = (shared_lmt108(), shared("data/lmt108_surfaces.txt")) else {
        return;
    };
    let library = open(&path);
    let known = std::fs::read_to_string(names).unwrap();
    assert_eq!((library.entries.len(), library.surfaces().len()), (200, 20));
    assert!(library.surfaces().iter().all(|surface| known.contains(surface)));
    assert_eq!(
        library.remarks,
        [
            "found: 20 surfaces, trials: 200 of the expert, 0 of users; mi2 × 200 (expert)",
            "missing: ac, ca1, ca2, fr, ir, me, mi1",
            "G1EpoxyRasterPlate · user1 · trial 1: source `ac` not used, files missing: Y, Z",
        ]
    );
    for entry in library.entries.iter().step_by(37) {
        let trial = entry.load().unwrap();
        let (rate_hz, channels, samples) = samples(&trial.signals["mi2"]);
        assert_eq!((rate_hz, channels, samples.len()), (44_100.0, 1, 211_611));
        assert!(samples.iter().any(|&x| x != 0.0));
    }
}
