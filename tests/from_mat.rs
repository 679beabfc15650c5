//! `tools/python/from_mat`: LMT108 in its authors' processed form becomes a library.
//!
//! The fixtures are those that `fixtures/make_mat.py` wrote. Runs where `SURFACED_PYTHON` names a
//! Python that has what `tools/python/requirements.txt` asks for.

mod common;

use std::path::{Path, PathBuf};
use std::process::Command;

use common::{says, write_file};
use surfaced::dataset;
use surfaced::library::{Entry, Library};
use surfaced::scene::Scene;
use surfaced::trial::{Signal, TrialKey};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn processed() -> PathBuf {
    root().join("tests/fixtures/processed")
}

/// Converts `data` and opens the library; what was said, where there is none. `None` without Python.
fn converted(data: &Path) -> Option<(Result<Library, String>, String)> {
    let Some(python) = std::env::var_os("SURFACED_PYTHON") else {
        use std::io::Write;
        let _ = writeln!(std::io::stderr(), "SKIPPED: a test, since SURFACED_PYTHON is not set");
        return None;
    };
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("library");
    let script = root().join("tools/python/from_mat");
    let output = Command::new(python).arg(script).arg(data).arg(&out).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    if !output.status.success() {
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0, "nothing is left: {said}");
        return Some((Err(said.clone()), said));
    }
    let mut library = dataset::open(&out, &Scene::lmt108()).unwrap();
    // Read now, since the folder goes.
    let entries = library.entries.iter().map(|entry| Entry::in_memory(entry.load().unwrap()));
    library.entries = entries.collect();
    Some((Ok(library), said))
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

/// A copy of the fixtures that may be changed.
fn changeable() -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("processed");
    copy(&processed(), &data);
    (dir, data)
}

#[test]
fn trials_are_converted_whole_with_labels_users_and_numbers() {
    for data in [processed(), processed().join("DataLMT108")] {
        let Some((library, said)) = converted(&data) else { return };
        let library = library.unwrap();
        let keys: Vec<_> = library.entries.iter().map(|entry| entry.key.clone()).collect();
        assert_eq!(keys.len(), 12);
        let of_mesh = [("expert", 1), ("expert", 2), ("user1", 1), ("user2", 2)];
        assert_eq!(keys[..4], of_mesh.map(|(user, n)| TrialKey::new("G1Mesh", user, n)));
        assert_eq!(library.surfaces(), ["G1Mesh", "G4Wood", "G7FoamVersion1"]);
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
        // The lists lie beside DataLMT108; below it they are missed.
        assert_eq!(said.contains("there is no list"), data.ends_with("DataLMT108"), "{said}");
        says(&said, &["wrote 12 trials", "next: surfaced eval"]);
    }
}

#[test]
fn an_uncompressed_file_and_a_row_vector_are_converted() {
    let dir = tempfile::tempdir().unwrap();
    let bytes = std::fs::read(root().join("tests/fixtures/uncompressed.mat")).unwrap();
    write_file(&dir.path().join("DataLMT108/Library/G1Mesh_train1.mat"), bytes);
    let Some((library, _)) = converted(dir.path()) else { return };
    let trial = library.unwrap().entries[0].load().unwrap();
    let samples = |id: &str| match &trial.signals[id] {
        Signal::Series(series) => series.samples().to_vec(),
        Signal::Image(_) => vec![],
    };
    assert_eq!(samples("fr"), [1.0, -2.0, 3.0, -4.0, 5.5, -6.5]);
    assert_eq!(samples("me"), [0.0, 1.0, 1.0]);
}

#[test]
fn a_list_that_cannot_be_read_is_replaced_by_the_names_of_the_files() {
    let (_dir, data) = changeable();
    write_file(&data.join("surfaceList_LMT108train.mat"), "x");
    let Some((library, said)) = converted(&data) else { return };
    assert_eq!(library.unwrap().entries.len(), 12);
    says(&said, &["surfaceList_LMT108train.mat", "numbered by their files' names"]);
}

#[test]
fn a_list_that_names_no_file_numbers_them_in_their_order() {
    let (_dir, data) = changeable();
    let folder = data.join("DataLMT108/Library");
    let names = ["G1Mesh", "G4Wood", "G7FoamVersion1"].map(|s| [1, 2].map(|n| (s, n)));
    for (at, (surface, number)) in names.as_flattened().iter().enumerate() {
        let name = format!("{surface}_train{number}.mat");
        std::fs::rename(folder.join(name), folder.join(format!("{}.mat", at + 7))).unwrap();
    }
    let Some((library, said)) = converted(&data) else { return };
    let library = library.unwrap();
    let wood = library.entries.iter().find(|e| e.key == TrialKey::new("G4Wood", "expert", 2));
    // File 10 is the fourth, though its name comes first among letters; its level is that of G4Wood.
    let Signal::Series(ir) = &wood.unwrap().load().unwrap().signals["ir"] else { panic!() };
    let mean = ir.samples().iter().sum::<f32>() / ir.frames() as f32;
    assert!((mean - 20.0).abs() < 3.0, "{mean}");
    says(&said, &["in their order"]);
}

#[test]
fn what_cannot_be_read_names_the_file_and_the_remedy() {
    let error = |bytes: &[u8]| {
        let (_dir, data) = changeable();
        write_file(&data.join("DataLMT108/Library/G1Mesh_train1.mat"), bytes);
        Some(converted(&data)?.0.unwrap_err())
    };
    let mut hdf5 = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".to_vec();
    hdf5.resize(124, b' ');
    hdf5.extend([0x00, 0x02, b'I', b'M']);
    hdf5.resize(600, 0);
    let Some(said) = error(&hdf5) else { return };
    says(&said, &["G1Mesh_train1.mat", "save('NAME.mat', '-v7')"]);
    says(&error(b"").unwrap(), &["G1Mesh_train1.mat", "not a whole MATLAB file of level 5"]);
    let path = processed().join("DataLMT108/Library/G1Mesh_train1.mat");
    let whole = std::fs::read(path).unwrap();
    says(&error(&whole[..whole.len() / 2]).unwrap(), &["not a whole MATLAB file of level 5"]);
}
