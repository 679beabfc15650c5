//! Reading the recording format, version 1.
//!
//! ```text
//! LIBRARY/
//!   library.toml                 optional: name, synthetic, sources that the defaults do not know
//!   SURFACE/TRIAL/
//!     trial.toml                 optional: see [`About`]
//!     mi2.wav  ac.wav  …         one WAV a source
//!     ca1.png or ca1.jpg
//! ```

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::files::{self, Listed};
use super::loader::{FileTrial, Headers, SourceFiles};
use super::{About, Entry, Library, LibraryError};
use crate::scene::{Domain, Scene, SourceId};
use crate::trial::{EXPERT, TrialKey};

/// Name of the file that describes a library.
pub(crate) const DESCRIPTION: &str = "library.toml";

/// End of the name of a folder that a trial is being written into.
pub(crate) const UNFINISHED: &str = ".unfinished";

/// Opens a library in the recording format; data are read when an entry is loaded.
///
/// The sources are those of `defaults` and those that `library.toml` describes; the latter win.
/// [`Library::remarks`] says what was passed over.
///
/// # Errors
/// If a folder or a header cannot be read, `library.toml` or a `trial.toml` is wrong, a file's
/// channels or rate are not those expected, two folders hold one trial, or nothing is found.
pub fn open(path: &Path, defaults: &Scene) -> Result<Library, LibraryError> {
    let folders = files::list(path)?;
    let mut opening = Opening::new(path, defaults.clone())?;
    for surface in &folders {
        if surface.is_dir && !surface.is_hidden() {
            opening.surface(surface)?;
        }
    }
    opening.library()
}

/// Opens a single trial, `LIBRARY/SURFACE/TRIAL`, as a library of one; `library.toml` is heeded.
///
/// # Errors
/// As [`open`].
pub fn open_trial(folder: &Path, defaults: &Scene) -> Result<Library, LibraryError> {
    let folder = folder.canonicalize().map_err(|error| LibraryError::io(folder, error))?;
    let (Some(surface), Some(item)) = (folder.parent(), Listed::folder(&folder)) else {
        return Err(LibraryError::file(&folder, "not the folder of a trial"));
    };
    let mut opening = Opening::new(surface.parent().unwrap_or(surface), defaults.clone())?;
    let label = surface.file_name().unwrap_or_default().to_string_lossy();
    opening.trial(&label, &item)?;
    opening.library()
}

/// An entry whose data lie in files.
pub(crate) fn entry(key: TrialKey, files: BTreeMap<SourceId, SourceFiles>) -> Entry {
    let sources = files.keys().cloned().collect();
    Entry::new(key.clone(), sources, Arc::new(FileTrial { key, sources: files }))
}

fn nothing_found(path: &Path, scene: &Scene, remarks: &[String]) -> LibraryError {
    let known = scene.sources().map(|s| s.id.as_str()).collect::<Vec<_>>().join(", ");
    let mut problem = format!(
        "no recordings found; looked for SURFACE/TRIAL/<source>.wav, .png or .jpg, where <source> \
         is one of {known}, and for the LMT108 database (a folder that holds SoundScans/ or \
         AccelScansComponents/); name the folder that holds the surfaces' folders"
    );
    for remark in remarks {
        problem.push_str("\n  ");
        problem.push_str(remark);
    }
    LibraryError::NothingFound { path: path.to_path_buf(), problem }
}

/// How often something was passed over, and where first.
pub(crate) struct Seen {
    count: usize,
    first: String,
}

impl Seen {
    /// Counts one more.
    pub fn count(all: &mut BTreeMap<String, Self>, what: String, place: String) {
        all.entry(what).or_insert(Self { count: 0, first: place }).count += 1;
    }

    /// The remark: what, how often, where first.
    pub fn say(&self, what: &str) -> String {
        match self.count {
            1 => format!("{}: {what}", self.first),
            count => format!("{} and {} more: {what}", self.first, count - 1),
        }
    }
}

struct Opening<'a> {
    root: &'a Path,
    name: String,
    scene: Scene,
    declared_hz: BTreeMap<SourceId, f64>,
    synthetic: bool,
    headers: Headers,
    trials: BTreeMap<TrialKey, (PathBuf, BTreeMap<SourceId, SourceFiles>)>,
    passed: BTreeMap<String, Seen>,
}

impl<'a> Opening<'a> {
    fn new(root: &'a Path, scene: Scene) -> Result<Self, LibraryError> {
        let mut opening = Self {
            root,
            name: String::new(),
            scene,
            declared_hz: BTreeMap::new(),
            synthetic: false,
            headers: Headers::default(),
            trials: BTreeMap::new(),
            passed: BTreeMap::new(),
        };
        let described = root.join(DESCRIPTION);
        if let Some(text) = files::read_text_if_there(&described)? {
            let (own, synthetic) = Scene::from_library_toml(&text)
                .map_err(|error| LibraryError::Scene { path: described, error: Box::new(error) })?;
            opening.synthetic = synthetic;
            opening.declared_hz =
                own.sources().filter_map(|s| Some((s.id.clone(), s.rate_hz?))).collect();
            opening.name.clone_from(&own.name);
            opening.scene = opening.scene.with(own);
        }
        Ok(opening)
    }

    fn library(self) -> Result<Library, LibraryError> {
        let Opening { root, mut name, scene, trials, passed, synthetic, .. } = self;
        let remarks: Vec<String> = passed.into_iter().map(|(what, seen)| seen.say(&what)).collect();
        if trials.is_empty() {
            return Err(nothing_found(root, &scene, &remarks));
        }
        let entries = trials.into_iter().map(|(key, (_, files))| entry(key, files)).collect();
        if name.is_empty() {
            let folder = root.canonicalize().unwrap_or_else(|_| root.to_path_buf());
            name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        }
        Ok(Library { name, scene, entries, synthetic, remarks })
    }

    fn pass_over(&mut self, path: &Path, why: impl Into<String>) {
        let place = path.strip_prefix(self.root).unwrap_or(path).display().to_string();
        Seen::count(&mut self.passed, why.into(), place);
    }

    fn surface(&mut self, surface: &Listed) -> Result<(), LibraryError> {
        for item in &files::list(&surface.path)? {
            match item.stem_and_extension().1.as_str() {
                _ if item.is_dir && item.name.ends_with(UNFINISHED) => {
                    self.pass_over(&item.path, "not used, it was never finished; remove the folder")
                }
                _ if item.is_hidden() => {}
                _ if item.is_dir => self.trial(&surface.name, item)?,
                "wav" | "png" | "jpg" | "jpeg" => self.pass_over(
                    &item.path,
                    "not used, it lies in no TRIAL folder; expected SURFACE/TRIAL/<source>.wav",
                ),
                _ => {}
            }
        }
        Ok(())
    }

    fn trial(&mut self, surface: &str, folder: &Listed) -> Result<(), LibraryError> {
        let about = About::read(&folder.path)?;
        if about.incomplete {
            self.pass_over(&folder.path, "not used, trial.toml says incomplete = true");
            return Ok(());
        }
        let mut sources = BTreeMap::new();
        for item in files::list(&folder.path)? {
            if let Some((id, files)) = self.source(&item)?
                && sources.insert(id.clone(), files).is_some()
            {
                return Err(LibraryError::file(
                    &item.path,
                    format!("a second file for source `{id}` of this trial; remove one"),
                ));
            }
        }
        if sources.is_empty() {
            self.pass_over(&folder.path, "not used, it holds no file of any source");
            return Ok(());
        }
        let number = match about.trial {
            Some(number) => number,
            None => number_of(folder)?,
        };
        let key = TrialKey {
            surface: about.surface.unwrap_or_else(|| surface.to_string()),
            user: about.user.unwrap_or_else(|| EXPERT.to_string()),
            number,
        };
        self.synthetic |= about.synthetic;
        if let Some((other, _)) = self.trials.get(&key) {
            let why = format!(
                "not used, it is the same trial ({key}) as {}; remove one, or tell them apart by \
                 `trial = N` or `user = \"…\"` in trial.toml",
                other.display()
            );
            self.pass_over(&folder.path, why);
            return Ok(());
        }
        self.trials.insert(key, (folder.path.clone(), sources));
        Ok(())
    }

    /// What one file of a trial is, if it is a source.
    fn source(&mut self, item: &Listed) -> Result<Option<(SourceId, SourceFiles)>, LibraryError> {
        let (stem, extension) = item.stem_and_extension();
        let picture = matches!(extension.as_str(), "png" | "jpg" | "jpeg");
        if item.is_hidden() || item.is_dir || !(picture || extension == "wav") {
            return Ok(None);
        }
        let Some(spec) = self.scene.get(stem) else {
            let what = match SourceId::new(stem) {
                Err(error) => format!("not used: {error}; rename the file"),
                Ok(id) if picture => format!(
                    "not used, since no source is called `{id}`; to use it, add to {DESCRIPTION}: \
                     [sources.{id}] domain = \"image\", channels = 3"
                ),
                Ok(id) => format!(
                    "not used, since no source is called `{id}`; to use it, add to {DESCRIPTION}: \
                     [sources.{id}] domain = \"time\" (or \"spectrum\" with band_hz = [low, high]), \
                     channels = …, rate_hz = …"
                ),
            };
            self.pass_over(&item.path, what);
            return Ok(None);
        };
        if !picture {
            let declared_hz = self.declared_hz.get(stem).copied();
            let files = self.headers.wav(spec, declared_hz, &item.path)?;
            return Ok(Some((spec.id.clone(), files)));
        }
        if spec.domain != Domain::Image {
            let problem = format!("a picture, but source `{stem}` is not; expected {stem}.wav");
            return Err(LibraryError::file(&item.path, problem));
        }
        Ok(Some((spec.id.clone(), SourceFiles::Picture(item.path.clone()))))
    }
}

/// The numeric suffix of a folder's name.
fn number_of(folder: &Listed) -> Result<u32, LibraryError> {
    let stem = folder.name.trim_end_matches(|c: char| c.is_ascii_digit());
    folder.name[stem.len()..].parse().map_err(|_| {
        LibraryError::file(
            &folder.path,
            format!(
                "its name does not end with the number of the trial (0 to {}); rename it, for \
                 example to `trial1`, or say `trial = N` in its trial.toml",
                u32::MAX
            ),
        )
    })
}
