//! Reads the surface materials database LMT108 (Strese et al. 2017; method.md §7).
//!
//! Training trials are by the expert; Testing trial u is by `user{u}`. Any part of the database can
//! be opened; a remark says which one.

mod name;

use std::collections::BTreeSet;
use std::collections::btree_map::{BTreeMap, Entry};
use std::path::{Path, PathBuf};

use name::NamePart;

use crate::library::files::{self, Listed};
use crate::library::loader::{Headers, Remarks, SourceFiles};
use crate::library::recording;
use crate::library::{Library, LibraryError, Opened};
use crate::printable::counted;
use crate::scene::{Domain, Scene, SourceBlock, SourceId, SourceSpec};
use crate::trial::{EXPERT, TrialKey};

/// Names of the database's folders. One such folder is enough to recognise the database.
pub(super) const FOLDERS: [&str; 6] = [
    "AccelScansComponents",
    "SoundScans",
    "FricScans",
    "ReflectanceScans",
    "MetalDetectionScans",
    "ImageScans",
];

/// Rate in Hz of all sources in text files; only sounds have another rate.
const TEXT_RATE_HZ: f64 = 10_000.0;

/// Most levels of nested folders that are read; `FricScans/FSR1/Training` has three.
const DEEPEST: usize = 4;

/// Whether a folder that holds the items `listed` is the root of the LMT108 database.
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
    item.is_dir && FOLDERS.iter().any(|name| item.name.eq_ignore_ascii_case(name))
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
    let mut remarks = Vec::new();
    if !entries.is_empty() {
        let keys = entries.iter().map(|entry| (&entry.key, entry.sources.as_slice()));
        remarks = summary(&keys.collect::<Vec<_>>(), defaults);
    }
    remarks.extend(headers.remarks.lines());
    if entries.is_empty() {
        if let Some(error) = LibraryError::of_all(bad) {
            return Err(error);
        }
        let mut problem = "the LMT108 database, but without a single whole recording; looked for \
                           names such as SoundScans/Movement/Training/\
                           G1EpoxyRasterPlate_Sound_Movement_train1.wav"
            .to_string();
        remarks.iter().for_each(|remark| problem += &format!("\n  {remark}"));
        return Err(LibraryError::file(root, problem));
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
                self.pass_over(&item, why);
            } else if item.is_dir {
                if above.len() < DEEPEST {
                    self.walk(&item, above)?;
                } else {
                    self.pass_over(&item, "not used, the database has no folders at this depth");
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
        let part = match name::parse(folders, stem) {
            Ok(part) => part,
            Err(why) => return self.pass_over(&item, &format!("not used, {why}")),
        };
        let expected: &[&str] = match part.source {
            "ca1" | "ca2" => &["jpg", "jpeg", "png"],
            "mi1" | "mi2" => &["wav"],
            _ => &["txt"],
        };
        if !expected.contains(&extension.as_str()) {
            let why = format!("not used, expected a .{} file for this", expected[0]);
            return self.pass_over(&item, &why);
        }
        let NamePart { key, source, channel, contradicts } = part;
        if contradicts {
            self.pass_over(
                &item,
                "its folder and its name disagree whether it is for training; the folder decides",
            );
        }
        let channels = self.trials.entry(key).or_default().entry(source).or_default();
        if let Entry::Vacant(free) = channels.entry(channel) {
            free.insert(item.path);
        } else {
            self.pass_over(&item, "not used, another file holds the same recording; remove one");
        }
    }

    fn pass_over(&mut self, item: &Listed, why: &str) {
        self.passed.add(why, item.name.clone());
    }
}

/// The names of the channels whose file is missing. Fails if scene and database disagree about the
/// source's number of channels.
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
            let fail = |problem| LibraryError::file(&paths[0], problem);
            spec.check_rate(TEXT_RATE_HZ).map_err(fail)?;
            SourceFiles::Columns { paths, rate_hz: TEXT_RATE_HZ }
        }
    })
}

/// Up to three lines of text that say which sources were found and which are missing.
fn summary(entries: &[(&TrialKey, &[SourceId])], scene: &Scene) -> Vec<String> {
    let surfaces: BTreeSet<_> = entries.iter().map(|(key, _)| key.surface.as_str()).collect();
    let experts = entries.iter().filter(|(key, _)| key.user == EXPERT).count();
    let (mut found, mut missing, mut gaps) = (Vec::new(), Vec::new(), Vec::new());
    for spec in scene.sources() {
        let holds = |is_expert: bool| {
            let of_split = entries.iter().filter(|(key, _)| (key.user == EXPERT) == is_expert);
            of_split.filter(|(_, sources)| sources.contains(&spec.id)).count()
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
