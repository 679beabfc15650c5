//! The authors' processed form of LMT108: fixtures that SciPy wrote (`fixtures/make_mat.py`).

mod common;

use std::path::{Path, PathBuf};

use common::write_file;
use surfaced::dataset;
use surfaced::library::Library;
use surfaced::scene::Scene;
use surfaced::trial::{Signal, TrialKey};

fn fixtures() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures")
}

fn open(path: &Path) -> Library {
    dataset::open(path, &Scene::lmt108()).unwrap()
}

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for item in std::fs::read_dir(from).unwrap() {
        let item = item.unwrap();
        let target = to.join(item.file_name());
        if item.path().is_dir() {
            copy(&item.path(), &target);
        } else {
            std::fs::copy(item.path(), target).unwrap();
        }
    }
}

fn processed() -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("processed");
    copy(&fixtures().join("processed"), &root);
    (dir, root)
}

#[test]
fn trials_are_read_whole_with_labels_users_and_numbers() {
    let root = fixtures().join("processed");
    for path in [root.clone(), root.join("DataLMT108")] {
        let library = open(&path);
        let keys: Vec<_> = library.entries.iter().map(|entry| entry.key.clone()).collect();
        assert_eq!(keys.len(), 12);
        let of_mesh = [("expert", 1), ("expert", 2), ("user1", 1), ("user2", 2)];
        assert_eq!(keys[..4], of_mesh.map(|(user, n)| TrialKey::new("G1Mesh", user, n)));
        assert_eq!(library.surfaces(), ["G1Mesh", "G4Wood", "G7FoamVersion1"]);
        common::assert_outlines_are_true(&library);
        let trial = library.entries[4].load().unwrap();
        let shape = |id: &str| match &trial.signals[id] {
            Signal::Series(series) => (series.rate_hz(), series.frames(), series.channels()),
            Signal::Image(_) => (0.0, 0, 0),
        };
        assert_eq!(shape("ac"), (1e4, 240, 3));
        assert_eq!(shape("fr"), (1e4, 240, 2));
        assert_eq!(shape("ir"), (1e4, 240, 1));
        assert_eq!(shape("me"), (1e4, 240, 1));
        assert_eq!(shape("mi1"), (44_100.0, 200, 1));
        assert_eq!(shape("mi2"), (44_100.0, 500, 1));
        let Signal::Image(image) = &trial.signals["ca1"] else { panic!("expected an image") };
        let [r, g, b] = image.pixel(100, 100);
        assert!((40..70).contains(&r) && (160..190).contains(&g) && (60..90).contains(&b));
    }
    let remarks = open(&root).remarks;
    assert_eq!(remarks.len(), 1, "the lists fit: {remarks:?}");
    assert!(remarks[0].contains("3 surfaces, trials: 6 of the expert, 6 of users"), "{remarks:?}");
    let missing = open(&root.join("DataLMT108")).remarks.join("\n");
    assert!(missing.contains("taken in the order of their files' names"), "{missing}");
}

#[test]
fn an_uncompressed_file_and_a_row_vector_are_read() {
    let dir = tempfile::tempdir().unwrap();
    let bytes = std::fs::read(fixtures().join("uncompressed.mat")).unwrap();
    write_file(&dir.path().join("DataLMT108/Library/G1Mesh_train1.mat"), bytes);
    let trial = open(dir.path()).entries[0].load().unwrap();
    let samples = |id: &str| match &trial.signals[id] {
        Signal::Series(series) => series.samples().to_vec(),
        Signal::Image(_) => vec![],
    };
    assert_eq!(samples("fr"), [1.0, -2.0, 3.0, -4.0, 5.5, -6.5]);
    assert_eq!(samples("me"), [0.0, 1.0, 1.0]);
}

#[test]
fn a_list_that_cannot_be_read_is_replaced_by_the_names_of_the_files() {
    let (_dir, root) = processed();
    write_file(&root.join("surfaceList_LMT108train.mat"), "x");
    let library = open(&root);
    assert_eq!(library.entries.len(), 12);
    let remarks = library.remarks.join("\n");
    assert!(remarks.contains("surfaceList_LMT108train.mat") && remarks.contains("names"));
}

#[test]
fn what_cannot_be_read_names_the_file_and_the_remedy() {
    let error = |bytes: &[u8]| {
        let (_dir, root) = processed();
        write_file(&root.join("DataLMT108/Library/G1Mesh_train1.mat"), bytes);
        dataset::open(&root, &Scene::lmt108()).unwrap_err().to_string()
    };
    let mut hdf5 = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".to_vec();
    hdf5.resize(600, b' ');
    let said = error(&hdf5);
    assert!(
        said.contains("G1Mesh_train1.mat") && said.contains("save('NAME.mat', '-v7')"),
        "{said}"
    );
    assert!(error(b"").contains("not a MATLAB file of level 5"));
    let path = fixtures().join("processed/DataLMT108/Library/G1Mesh_train1.mat");
    let whole = std::fs::read(path).unwrap();
    assert!(error(&whole[..whole.len() / 2]).contains("cut short"));
}
