//! Reads the surface materials database LMT108 (Strese et al. 2017; `src/method/README.md` §1).
//!
//! Training trials are by the expert; Testing trial u is by `user{u}`. Any part of the database can
//! be opened; a remark says which one.

use std::collections::BTreeSet;
use std::collections::btree_map::{self, BTreeMap};
use std::path::{Path, PathBuf};

use crate::library::files::{self, Listed};
use crate::library::loader::{Headers, Remarks, SourceFiles};
use crate::library::{Entry, Library, LibraryError, Opened, recording};
use crate::printable::counted;
use crate::scene::{Domain, Scene, SourceBlock, SourceSpec};
use crate::trial::{EXPERT, TrialKey};

/// Names of the database's folders. One such folder is enough to recognise the database.
pub(super) const FOLDERS: &str =
    "AccelScansComponents SoundScans FricScans ReflectanceScans MetalDetectionScans ImageScans";

/// Rate in Hz of all sources in text files; only sounds have another rate.
const TEXT_RATE_HZ: f64 = 10_000.0;

/// Most levels of nested folders that are read; `FricScans/FSR1/Training` has three.
const DEEPEST: usize = 4;

pub(super) fn is_root(listed: &[Listed]) -> bool {
    listed.iter().any(|item| is_scans(item) && holds_recordings(item))
}

/// Whether a folder with one of the names in [`FOLDERS`] holds recordings of the database, or no
/// files. A folder with other files may be a surface with this name in another library.
fn holds_recordings(folder: &Listed) -> bool {
    let mut found = FoundFiles::default();
    // True for a folder that cannot be listed: reading it will report the error.
    found.walk(folder, &mut Vec::new()).is_err()
        || !found.trials.is_empty()
        || found.passed.0.is_empty()
}

fn is_scans(item: &Listed) -> bool {
    item.is_dir && is(&item.name, FOLDERS)
}

pub(super) fn open(
    root: &Path,
    listed: &[Listed],
    defaults: &Scene,
) -> Result<Opened, LibraryError> {
    let mut found = FoundFiles::default();
    for item in listed.iter().filter(|item| is_scans(item)) {
        found.walk(item, &mut Vec::new())?;
    }
    let mut headers = Headers::new(root, found.passed);
    let (mut entries, mut bad) = (Vec::new(), Vec::new());
    for (key, parts) in found.trials {
        let mut sources = BTreeMap::new();
        for (source, channels) in parts {
            let Some(spec) = defaults.get(source) else {
                let what = format!("not used, the scene describes no source `{source}`");
                headers.remarks.add(what, key.to_string());
                continue;
            };
            let missing = missing(spec, &channels)?;
            if !missing.is_empty() {
                let missing = missing.join(", ");
                let what = format!("source `{source}` not used, files missing: {missing}");
                headers.remarks.add(what, key.to_string());
                continue;
            }
            match source_files(&mut headers, spec, channels.into_values().collect()) {
                Ok(files) => drop(sources.insert(spec.id.clone(), files)),
                Err(error) => bad.push(error),
            }
        }
        if !sources.is_empty() {
            entries.push(recording::entry(key, sources, None));
        }
    }
    let mut remarks = if entries.is_empty() { Vec::new() } else { summary(&entries, defaults) };
    remarks.extend(headers.remarks.lines());
    if entries.is_empty() {
        let problem = "the LMT108 database, but without a single whole recording; looked for names such \
                       as SoundScans/Movement/Training/G1EpoxyRasterPlate_Sound_Movement_train1.wav";
        return Err(recording::nothing_found(root, bad, problem.into(), &remarks));
    }
    let (name, scene) = ("LMT108".into(), defaults.clone());
    Ok(Opened { library: Library { name, scene, entries, synthetic: false, remarks }, bad })
}

type Channels = BTreeMap<usize, PathBuf>;

#[derive(Default)]
struct FoundFiles {
    trials: BTreeMap<TrialKey, BTreeMap<&'static str, Channels>>,
    passed: Remarks,
}

impl FoundFiles {
    /// Adds all files below `folder`; `above` holds the names of its parent folders, in lower case.
    fn walk(&mut self, folder: &Listed, above: &mut Vec<String>) -> Result<(), LibraryError> {
        above.push(folder.name.to_ascii_lowercase());
        for item in files::list(&folder.path)? {
            if item.is_hidden() {
                continue;
            }
            if let Some(why) = item.unusable {
                self.passed.add(why, item.name.clone());
            } else if item.is_dir {
                if above.len() < DEEPEST {
                    self.walk(&item, above)?;
                } else {
                    self.passed
                        .add("not used, the database has no folders at this depth", item.name);
                }
            } else {
                self.file(item, above);
            }
        }
        above.pop();
        Ok(())
    }

    fn file(&mut self, item: Listed, folders: &[String]) {
        let (stem, extension) = item.stem_and_extension();
        let part = match parse_name(folders, stem) {
            Ok(part) => part,
            Err(why) => return self.passed.add(format!("not used, {why}"), item.name),
        };
        let expected: &[&str] = match part.source {
            "ca1" | "ca2" => &["jpg", "jpeg", "png"],
            "mi1" | "mi2" => &["wav"],
            _ => &["txt"],
        };
        if !expected.contains(&extension.as_str()) {
            let why = format!("not used, expected a .{} file for this", expected[0]);
            return self.passed.add(why, item.name);
        }
        let NamePart { key, source, channel, contradicts } = part;
        if contradicts {
            self.passed.add(
                "its folder and its name disagree whether it is for training; the folder decides",
                item.name.clone(),
            );
        }
        let channels = self.trials.entry(key).or_default().entry(source).or_default();
        if let btree_map::Entry::Vacant(free) = channels.entry(channel) {
            free.insert(item.path);
        } else {
            self.passed
                .add("not used, another file holds the same recording; remove one", item.name);
        }
    }
}

/// The channels whose file is missing. Fails if the scene has another number of channels.
fn missing(spec: &SourceSpec, found: &Channels) -> Result<Vec<&'static str>, LibraryError> {
    let names: &[&'static str] = match spec.id.as_str() {
        "ac" => &["X", "Y", "Z"],
        "fr" => &["FSR1", "FSR2"],
        _ => &[""],
    };
    let image = spec.domain == Domain::Image;
    let is_image = matches!(spec.id.as_str(), "ca1" | "ca2");
    if image != is_image || !image && spec.channels != names.len() {
        let path = found.values().next().cloned().unwrap_or_default();
        let problem = format!(
            "the database has {} for source `{}`; correct its description in the configuration",
            if is_image { "an image".into() } else { counted(names.len(), "channel") },
            spec.id,
        );
        return Err(LibraryError::file(&path, problem));
    }
    let missing = (0..names.len()).filter(|at| !found.contains_key(at)).map(|at| names[at]);
    Ok(missing.collect())
}

fn source_files(
    headers: &mut Headers,
    spec: &SourceSpec,
    mut paths: Vec<PathBuf>,
) -> Result<SourceFiles, LibraryError> {
    Ok(match spec.id.as_str() {
        // Indexing is safe: no file is missing.
        "mi1" | "mi2" => {
            // The band of a sound is as binding as one in `library.toml`.
            let band_hz = spec.domain.band_hz().map(<[f64; 2]>::from);
            let declared = SourceBlock { band_hz, ..SourceBlock::default() };
            headers.series(spec, &declared, &paths.remove(0))?
        }
        "ca1" | "ca2" => SourceFiles::Picture(paths.remove(0)),
        _ => {
            let fail = LibraryError::at(&paths[0]);
            spec.check_rate(TEXT_RATE_HZ).map_err(fail)?;
            SourceFiles::Columns { paths, rate_hz: TEXT_RATE_HZ }
        }
    })
}

/// Up to three lines of text that say which sources were found and which are missing.
fn summary(entries: &[Entry], scene: &Scene) -> Vec<String> {
    let surfaces: BTreeSet<_> = entries.iter().map(|entry| entry.key.surface.as_str()).collect();
    let experts = entries.iter().filter(|entry| entry.key.user == EXPERT).count();
    let (mut found, mut missing, mut gaps) = (Vec::new(), Vec::new(), Vec::new());
    for spec in scene.sources() {
        let holds = |is_expert: bool| {
            let of_split = entries.iter().filter(|entry| (entry.key.user == EXPERT) == is_expert);
            of_split.filter(|entry| entry.sources.contains(&spec.id)).count()
        };
        let (expert, users) = (holds(true), holds(false));
        match (expert, users) {
            (0, 0) => missing.push(spec.id.to_string()),
            (_, 0) => found.push(format!("{} × {expert} (expert)", spec.id)),
            (0, _) => found.push(format!("{} × {users} (users)", spec.id)),
            _ => found.push(format!("{} × {expert} (expert) + {users} (users)", spec.id)),
        }
        let lacking = entries.len() - expert - users;
        if lacking > 0 && lacking < entries.len() {
            gaps.push(format!("{} in {lacking} of {} trials", spec.id, entries.len()));
        }
    }
    let mut remarks = vec![format!(
        "found: {}, trials: {experts} of the expert, {} of users; {}",
        counted(surfaces.len(), "surface"),
        entries.len() - experts,
        found.join(", "),
    )];
    if !missing.is_empty() {
        remarks.push(format!("missing: {}", missing.join(", ")));
    }
    if !gaps.is_empty() {
        remarks.push(format!("missing here and there: {}", gaps.join(", ")));
    }
    remarks
}

#[derive(Debug, PartialEq)]
struct NamePart {
    key: TrialKey,
    source: &'static str,
    /// Index of the channel, from 0; 0 if the file holds all channels of the source.
    channel: usize,
    /// Whether folder and file name disagree about the split: training or test.
    contradicts: bool,
}

/// Words that may follow the surface in a file's name.
const WORDS: &str = "movement tapping sound image reflectance metaldetection metal friction frictionfsr1 \
    frictionfsr2 fsr1 fsr2";

/// Names of the database are partly inferred, so parsing is lenient: case does not matter, and a name
/// need not repeat its folders' names. `folders` holds the folders from the database's root down to the
/// file, in lower case. The error says why no trial has the file.
fn parse_name(folders: &[String], stem: &str) -> Result<NamePart, &'static str> {
    let in_folder = |name: &str| folders.iter().any(|folder| folder == name);
    let said = is_training(folders);
    let (rest, by_name, number) = cut_number(stem)?;
    let is_training =
        said.or(by_name).ok_or("neither its folder nor its name says train or test")?;
    let contradicts = by_name.is_some_and(|name| name != is_training);

    let mut parts: Vec<&str> = rest.split('_').filter(|part| !part.is_empty()).collect();
    let mut flash = in_folder("flash");
    if parts.first().is_some_and(|first| is(first, "flash noflash")) {
        flash |= is(parts.remove(0), "flash");
    }
    let words_at = parts.iter().skip(1).position(|part| is(part, WORDS)).map(|at| at + 1);
    let (surface, words) = parts.split_at(words_at.ok_or("its name does not say what it is")?);
    let words: Vec<String> = words.iter().map(|word| word.to_ascii_lowercase()).collect();
    let has = |word: &str| words.iter().any(|w| w == word);
    let tap = has("tapping") || !has("movement") && in_folder("tapping");

    let mut trial = number;
    let (source, channel) = if has("image") {
        // Image names hold two numbers: (1, 1), (10, 2), (2, 3), …. The first is the trial.
        if let Some(number) = words.last().and_then(|word| word.parse().ok()) {
            trial = number;
        }
        (if flash { "ca2" } else { "ca1" }, 0)
    } else if has("sound") || in_folder("soundscans") {
        (if tap { "mi1" } else { "mi2" }, 0)
    } else if words.iter().any(|word| word.ends_with("fsr1")) || in_folder("fsr1") {
        ("fr", 0)
    } else if words.iter().any(|word| word.ends_with("fsr2")) || in_folder("fsr2") {
        ("fr", 1)
    } else if has("reflectance") {
        ("ir", 0)
    } else if has("metaldetection") || has("metal") {
        ("me", 0)
    } else if has("friction") {
        return Err("its name does not say which of the two force sensors it is");
    } else {
        let axis =
            words.last().and_then(|word| ["x", "y", "z"].iter().position(|axis| axis == word));
        match (tap, axis) {
            (true, Some(2)) => ("act", 0),
            (true, _) => return Err("of the tapping acceleration only axis Z is known"),
            (false, Some(axis)) => ("ac", axis),
            (false, None) => return Err("its name does not say which axis it is"),
        }
    };
    let user = if is_training { EXPERT.to_string() } else { format!("user{trial}") };
    Ok(NamePart {
        key: TrialKey::new(surface.join("_"), user, trial),
        source,
        channel,
        contradicts,
    })
}

fn is(part: &str, words: &str) -> bool {
    words.split(' ').any(|word| part.eq_ignore_ascii_case(word))
}

/// The folder names of the two splits, each with true for training and false for test.
const SPLITS: [(&str, bool); 4] =
    [("training", true), ("train", true), ("testing", false), ("test", false)];

fn is_training(folders: &[String]) -> Option<bool> {
    let named = |folder: &String| SPLITS.iter().find(|(name, _)| folder == name);
    folders.iter().rev().find_map(named).map(|(_, is_training)| *is_training)
}

/// Cuts a suffix such as `_train7` off a name: the text before, the split (true: training), the number.
fn cut_number(stem: &str) -> Result<(&str, Option<bool>, u32), &'static str> {
    let head = stem.trim_end_matches(|c: char| c.is_ascii_digit());
    let number = stem[head.len()..].parse().map_err(|_| "its name does not end with a number")?;
    let head = head.trim_end_matches('_');
    for (word, is_training) in SPLITS {
        let at = head.len().wrapping_sub(word.len());
        if head.get(at..).is_some_and(|end| end.eq_ignore_ascii_case(word)) {
            return Ok((head[..at].trim_end_matches('_'), Some(is_training), number));
        }
    }
    Ok((head, None, number))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(path: &str) -> Result<String, &'static str> {
        let mut folders: Vec<String> = path.split('/').map(str::to_ascii_lowercase).collect();
        folders.pop();
        let stem = path.rsplit('/').next().unwrap().rsplit_once('.').unwrap().0;
        let NamePart { key: TrialKey { surface, user, number, .. }, source, channel, .. } =
            parse_name(&folders, stem)?;
        Ok(format!("{surface} {user} {number} {source} {channel}"))
    }

    #[test]
    fn every_name_of_the_database_is_understood() {
        // The first number of an image is its trial; case and missing words do not matter.
        let table = "
            AccelScansComponents/Movement/Training/G1Mesh_Movement_Y_train7.txt G1Mesh expert 7 ac 1
            AccelScansComponents/Tapping/Training/G1Mesh_Tapping_Z_train10.txt G1Mesh expert 10 act 0
            SoundScans/Movement/Testing/G1Mesh_Sound_Movement_test2.wav G1Mesh user2 2 mi2 0
            SoundScans/Tapping/Training/G1Mesh_Sound_Tapping_train2.wav G1Mesh expert 2 mi1 0
            FricScans/FSR1/Training/G1Mesh_FrictionFSR1_Movement_train1.txt G1Mesh expert 1 fr 0
            FricScans/FSR2/Testing/G1Mesh_FrictionFSR2_Movement_test1.txt G1Mesh user1 1 fr 1
            ReflectanceScans/Training/G1Mesh_Reflectance_Movement_train3.txt G1Mesh expert 3 ir 0
            MetalDetectionScans/Testing/G1Mesh_MetalDetection_Movement_test3.txt G1Mesh user3 3 me 0
            ImageScans/NoFlash/Training/G1Mesh_Image_1_train1.jpg G1Mesh expert 1 ca1 0
            ImageScans/NoFlash/Training/G1Mesh_Image_10_train2.jpg G1Mesh expert 10 ca1 0
            ImageScans/NoFlash/Testing/G1Mesh_Image_9_test0.jpg G1Mesh user9 9 ca1 0
            ImageScans/Flash/Training/Flash_G1Mesh_Image_2_train3.jpg G1Mesh expert 2 ca2 0
            ImageScans/Flash/Training/G1Mesh_Image_2_train3.jpg G1Mesh expert 2 ca2 0
            soundscans/g4Oak_sound_movement_TRAIN3.WAV g4Oak expert 3 mi2 0
            SoundScans/Tapping/Training/G4Oak_Sound_3.wav G4Oak expert 3 mi1 0
            FricScans/FSR2/Testing/G4Oak_Friction_Movement_test4.txt G4Oak user4 4 fr 1
            MetalDetectionScans/Testing/G4Oak_Metal_Movement_test4.txt G4Oak user4 4 me 0";
        for line in table.trim().lines() {
            let (path, expected) = line.trim().split_once(' ').unwrap();
            assert_eq!(parsed(path).as_deref(), Ok(expected), "{path}");
        }
    }

    #[test]
    fn the_folder_wins_over_the_name() {
        let folders = ["soundscans".to_string(), "testing".to_string()];
        let part = parse_name(&folders, "G1Mesh_Sound_Movement_train3").unwrap();
        assert_eq!((part.key.user.as_str(), part.contradicts), ("user3", true));
    }

    #[test]
    fn what_is_not_understood_says_why() {
        for (path, why) in [
            ("SoundScans/Movement/Training/readme.txt", "number"),
            ("SoundScans/G1Mesh_Sound_Movement_3.wav", "train or test"),
            ("FricScans/Training/G1Mesh_Friction_Movement_1.txt", "which"),
        ] {
            assert!(parsed(path).unwrap_err().contains(why), "{path}");
        }
    }

    proptest::proptest! {
        #[test]
        fn no_name_is_too_odd(stem in "\\PC{0,40}|[a-zA-Z_0-9ä]{0,30}") {
            let _ = parse_name(&["training".to_string()], &stem);
        }
    }
}
