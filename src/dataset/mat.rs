//! The authors' processed form of LMT108 (method.md §7): one MATLAB file a trial, in
//! `DataLMT108/{Library,TestingSet}/`, and lists that name the trials in order.
//!
//! `Library` holds the expert's trials; trial u of `TestingSet` is that of user `user{u}`. Read
//! leniently: a list that is missing or cannot be read is replaced by the files' own names, and the
//! library's remarks say so.

mod file;
mod level5;
mod name;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use file::{MatSource, MatTrial};
use name::Listing;

use super::lmt108;
use crate::library::files::{self, Listed};
use crate::library::loader::channels as counted;
use crate::library::seen::Seen;
use crate::library::{Entry, Library, LibraryError, Opened};
use crate::scene::{Domain, Scene, SourceSpec};
use crate::trial::TrialKey;

/// Variables of a trial, and what they are.
const VARIABLES: [(&str, &str); 8] = [
    ("accelDrag_time", "ac"),
    ("forceDrag_time", "fr"),
    ("imageFlash_RGB", "ca2"),
    ("imageNoFlash_RGB", "ca1"),
    ("metalDrag_time", "me"),
    ("reflectDrag_time", "ir"),
    ("soundDrag_time", "mi2"),
    ("soundTap_time", "mi1"),
];

/// Rates of the files, which hold none themselves.
const SOUND_RATE_HZ: f64 = 44_100.0;
const SERIAL_RATE_HZ: f64 = 10_000.0;

const DATA: &str = "DataLMT108";

/// Folders of this form.
pub(super) const FOLDERS: [&str; 3] = [DATA, "Library", "TestingSet"];

/// A half of the database: its folder, its list, the variable in the list.
struct SplitFolder {
    folder: &'static str,
    list: &'static str,
    is_expert: bool,
}

const SPLITS: [SplitFolder; 2] = [
    SplitFolder { folder: "Library", list: "surfaceList_LMT108train.mat", is_expert: true },
    SplitFolder { folder: "TestingSet", list: "surfaceList_LMT108test.mat", is_expert: false },
];

/// Whether a folder with these things in it is the root of the processed form, or its `DataLMT108`.
pub(super) fn is_root(listed: &[Listed]) -> bool {
    let is_list = |item: &Listed| {
        !item.is_dir && SPLITS.iter().any(|split| item.name.eq_ignore_ascii_case(split.list))
    };
    // Surfaces may be called so, too: those hold folders, one a trial.
    let is_split = |item: &Listed| SPLITS.iter().any(|split| is_folder(item, split.folder));
    let holds = |folder: &Listed, may: &dyn Fn(&Listed) -> bool| {
        let inner = files::list(&folder.path).unwrap_or_default();
        inner.iter().all(|item| !item.is_dir || item.is_hidden() || may(item))
    };
    let is_data = |item: &Listed| is_folder(item, DATA) && holds(item, &is_split);
    let has = |split: &SplitFolder| {
        listed.iter().any(|item| is_folder(item, split.folder) && holds(item, &|_| false))
    };
    listed.iter().any(|item| is_data(item) || is_list(item)) || SPLITS.iter().all(has)
}

fn is_folder(item: &Listed, name: &str) -> bool {
    item.is_dir && item.name.eq_ignore_ascii_case(name)
}

/// Opens the processed form at its root; of each file only the names of its variables are read.
///
/// # Errors
/// If a folder cannot be read, if a file is not of MATLAB level 5, if two files are the same trial,
/// or if nothing is found.
pub(super) fn open(
    root: &Path,
    listed: &[Listed],
    defaults: &Scene,
) -> Result<Opened, LibraryError> {
    // The lists and the folders lie in the root or in DataLMT108.
    let mut inside = Vec::new();
    for folder in listed.iter().filter(|item| is_folder(item, DATA)) {
        inside.extend(files::list(&folder.path)?);
    }
    let everywhere: Vec<&Listed> = listed.iter().chain(&inside).collect();
    let mut opening = MatOpening {
        scene: defaults,
        trials: BTreeMap::new(),
        passed: BTreeMap::new(),
        remarks: vec![],
        bad: vec![],
    };
    for split in &SPLITS {
        opening.split(split, &everywhere)?;
    }
    opening.library(root)
}

struct MatOpening<'a> {
    scene: &'a Scene,
    trials: BTreeMap<TrialKey, MatTrial>,
    passed: BTreeMap<String, Seen>,
    remarks: Vec<String>,
    /// Files that cannot be used.
    bad: Vec<LibraryError>,
}

impl MatOpening<'_> {
    fn split(&mut self, split: &SplitFolder, everywhere: &[&Listed]) -> Result<(), LibraryError> {
        let mut found: Vec<Listed> = Vec::new();
        for folder in everywhere.iter().filter(|item| is_folder(item, split.folder)) {
            found.extend(files::list(&folder.path)?);
        }
        found.retain(|item| !item.is_hidden() && !item.is_dir);
        for item in found.extract_if(.., |item| item.unusable.is_some()) {
            item.unusable.iter().for_each(|why| self.pass_over(why, &item.name));
        }
        let (trials, others): (Vec<_>, _) =
            found.into_iter().partition(|item| item.stem_and_extension().1 == "mat");
        for other in others {
            self.pass_over("not used, expected a .mat file for each trial", &other.name);
        }
        if trials.is_empty() {
            return Ok(());
        }
        let is_list = |item: &&&Listed| !item.is_dir && item.name.eq_ignore_ascii_case(split.list);
        let named = match everywhere.iter().find(is_list) {
            None => Err("there is no such list".to_string()),
            Some(list) => file::texts(&list.path).map_err(|error| error.to_string()),
        };
        let stems: Vec<&str> = trials.iter().map(|item| item.stem_and_extension().0).collect();
        let Listing { keys, remarks } = match named {
            Ok(named) => name::by_list(&stems, &named, split.list, split.is_expert),
            Err(why) => {
                let mut listing = name::by_file(&stems, split.is_expert);
                listing.remarks.push(format!(
                    "{}: {why}; trials are taken in the order of their files' names",
                    split.list
                ));
                listing
            }
        };
        self.remarks.extend(remarks);
        for (item, key) in trials.iter().zip(keys) {
            match key {
                Ok(key) => {
                    if let Err(error) = self.trial(item, key) {
                        self.bad.push(error);
                    }
                }
                Err(why) => self.pass_over(&format!("not used, {why}"), &item.name),
            }
        }
        Ok(())
    }

    fn trial(&mut self, item: &Listed, key: TrialKey) -> Result<(), LibraryError> {
        let mut sources = BTreeMap::new();
        for variable in file::variables(&item.path)? {
            let known = VARIABLES.iter().find(|(name, _)| variable.eq_ignore_ascii_case(name));
            let Some((_, id)) = known else { continue };
            let Some(spec) = self.scene.get(id) else {
                self.pass_over(
                    &format!("not used, the scene describes no source `{id}`"),
                    &key.to_string(),
                );
                continue;
            };
            sources.insert(spec.id.clone(), stored(spec, variable, item)?);
        }
        if sources.is_empty() {
            let names: Vec<_> = VARIABLES.iter().map(|(name, _)| *name).collect();
            let why = format!("not used, it holds none of {}", names.join(", "));
            self.pass_over(&why, &item.name);
            return Ok(());
        }
        let trial = MatTrial { key: key.clone(), path: item.path.clone(), sources };
        if let Some(other) = self.trials.get(&key) {
            return Err(LibraryError::file(
                &item.path,
                format!("the same trial ({key}) as {}; remove one", other.path.display()),
            ));
        }
        self.trials.insert(key, trial);
        Ok(())
    }

    fn pass_over(&mut self, why: &str, what: &str) {
        Seen::count(&mut self.passed, why.to_string(), what.to_string());
    }

    fn library(mut self, root: &Path) -> Result<Opened, LibraryError> {
        let entries: Vec<Entry> = (self.trials.into_iter())
            .map(|(key, trial)| {
                let sources = trial.sources.keys().cloned().collect();
                Entry::new(key, sources, Arc::new(trial))
            })
            .collect();
        let passed = self.passed.into_iter().map(|(what, seen)| seen.say(&what));
        self.remarks.extend(passed);
        if entries.is_empty() {
            if let Some(error) = LibraryError::of_all(self.bad) {
                return Err(error);
            }
            let problem = format!(
                "the authors' processed form of LMT108, but without a single trial; looked for \
                 {DATA}/Library/*.mat and {DATA}/TestingSet/*.mat\n  {}",
                self.remarks.join("\n  ")
            );
            let problem = problem.trim_end().to_string();
            return Err(LibraryError::NothingFound { path: root.to_path_buf(), problem });
        }
        let keys: Vec<_> =
            entries.iter().map(|entry| (&entry.key, entry.sources.as_slice())).collect();
        let mut remarks = lmt108::summary(&keys, self.scene);
        remarks.extend(self.remarks);
        let (name, scene) = ("LMT108 (processed)".into(), self.scene.clone());
        let library = Library { name, scene, entries, synthetic: false, remarks };
        Ok(Opened { library, bad: self.bad })
    }
}

/// How a source lies in its variable.
///
/// # Errors
/// If the scene describes the source as something that the database does not have.
fn stored(spec: &SourceSpec, variable: String, item: &Listed) -> Result<MatSource, LibraryError> {
    let channels = match spec.id.as_str() {
        "ac" => 3,
        "fr" => 2,
        _ => 1,
    };
    let is_image = matches!(spec.id.as_str(), "ca1" | "ca2");
    if is_image != (spec.domain == Domain::Image) || !is_image && spec.channels != channels {
        let has = if is_image { "an image".into() } else { counted(channels) };
        let problem = format!(
            "the database has {has} for source `{}`; correct its description in the configuration",
            spec.id
        );
        return Err(LibraryError::file(&item.path, problem));
    }
    if is_image {
        return Ok(MatSource::Image { variable });
    }
    let is_sound = matches!(spec.id.as_str(), "mi1" | "mi2");
    let rate_hz = if is_sound { SOUND_RATE_HZ } else { SERIAL_RATE_HZ };
    spec.check_rate(rate_hz).map_err(|problem| LibraryError::file(&item.path, problem))?;
    Ok(MatSource::Series { variable, channels, rate_hz })
}
