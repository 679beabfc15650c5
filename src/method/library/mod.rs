//! A library: labelled trials that scans are compared with. Trials are read when they are needed.

mod arrays;
pub mod cache;
#[doc(hidden)]
pub mod files;
pub(crate) mod loader;
#[cfg(feature = "lossy")]
mod lossy;
pub mod recording;
pub(crate) mod series_file;
pub(crate) mod wav;

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::scene::{Scene, SourceId};
use crate::seed;
use crate::trial::{Signal, Trial, TrialKey, checked_session, normal};

#[derive(Debug, thiserror::Error)]
pub enum LibraryError {
    /// a file or folder that cannot be read, or does not hold what it should
    #[error("{}: {problem}", path.display())]
    File {
        path: PathBuf,
        /// what is wrong, what was expected, what to do
        problem: String,
    },
    #[error("{}", list(.0))]
    Several(Vec<LibraryError>),
}

/// Rate, channels and length of a series, known before its samples are read.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outline {
    pub rate_hz: f64,
    pub channels: usize,
    pub frames: usize,
}

/// The [`Outline`] (rate, channels, length) of each source of a trial that is a series.
pub type Outlines = BTreeMap<SourceId, Outline>;

fn list(errors: &[LibraryError]) -> String {
    let lines = errors.iter().map(|error| format!("\n  {error}"));
    format!("{} files cannot be used:{}", errors.len(), lines.collect::<String>())
}

impl LibraryError {
    /// The file or folder with the problem; `None` for an error that combines several.
    pub fn path(&self) -> Option<&Path> {
        match self {
            Self::File { path, .. } => Some(path),
            Self::Several(_) => None,
        }
    }

    pub fn of_all(mut errors: Vec<Self>) -> Option<Self> {
        match errors.len() {
            0 | 1 => errors.pop(),
            _ => Some(Self::Several(errors)),
        }
    }
}

/// The usable part of a library, and the reasons why other parts cannot be used.
#[derive(Debug)]
pub struct Opened {
    pub library: Library,
    /// One error for each file or trial that cannot be used.
    pub bad: Vec<LibraryError>,
}

impl Opened {
    /// The library, if all of its files can be used.
    ///
    /// # Errors
    /// If any file or trial cannot be used. The error lists them all.
    pub fn whole(self) -> Result<Library, LibraryError> {
        LibraryError::of_all(self.bad).map_or(Ok(self.library), Err)
    }
}

/// Something that can produce one trial: files on disk, a generator, memory.
pub trait LoadTrial: Send + Sync + fmt::Debug {
    /// Reads the `wanted` sources of the trial; sources that the trial lacks are skipped.
    ///
    /// # Errors
    /// If one of the sources cannot be read.
    fn load(&self, wanted: &[SourceId]) -> Result<Trial, LibraryError>;

    /// The [`Outline`] of each `wanted` series. Reads the trial, unless a loader knows better.
    ///
    /// # Errors
    /// If a file cannot be read.
    fn outlines(&self, wanted: &[SourceId]) -> Result<Outlines, LibraryError> {
        let outline = |(id, signal): (SourceId, Signal)| {
            let Signal::Series(series) = signal else { return None };
            let (rate_hz, channels) = (series.rate_hz(), series.channels());
            Some((id, Outline { rate_hz, channels, frames: series.frames() }))
        };
        Ok(self.load(wanted)?.signals.into_iter().filter_map(outline).collect())
    }

    /// A number that changes whenever the data of `wanted` change; `None` if only reading tells.
    fn stamp(&self, _wanted: &[SourceId]) -> Option<u64> {
        None
    }

    /// The paths that hold only this trial: its folder, or its files.
    fn places(&self) -> Vec<&Path> {
        Vec::new()
    }
}

#[derive(Debug)]
struct InMemory {
    trial: Arc<Trial>,
    /// The entry that `trial` was read from; `None` if it was made in memory.
    from: Option<Entry>,
}

impl LoadTrial for InMemory {
    fn load(&self, wanted: &[SourceId]) -> Result<Trial, LibraryError> {
        let key = self.trial.key.clone();
        let kept = |id: &SourceId| Some((id.clone(), self.trial.signals.get(id)?.clone()));
        Ok(Trial { key, signals: wanted.iter().filter_map(kept).collect() })
    }

    fn stamp(&self, wanted: &[SourceId]) -> Option<u64> {
        self.from.as_ref()?.loader.stamp(wanted)
    }

    fn places(&self) -> Vec<&Path> {
        self.from.as_ref().map_or_else(Vec::new, Entry::places)
    }
}

/// A loader that loads the trial of `entry` and then changes it, for example cuts it short.
struct Changed<F> {
    entry: Entry,
    change: F,
}

impl<F> fmt::Debug for Changed<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Changed").field(&self.entry).finish()
    }
}

impl<F: Fn(Trial) -> Trial + Send + Sync> LoadTrial for Changed<F> {
    fn load(&self, wanted: &[SourceId]) -> Result<Trial, LibraryError> {
        self.entry.loader.load(wanted).map(&self.change)
    }
}

/// One trial of a library: known by name, loaded on demand.
#[derive(Clone, Debug)]
pub struct Entry {
    pub key: TrialKey,
    /// The trial's sources, sorted by name.
    pub sources: Vec<SourceId>,
    loader: Arc<dyn LoadTrial>,
}

impl Entry {
    /// An entry of a library, whose trial `loader` reads on demand.
    pub fn new(key: TrialKey, mut sources: Vec<SourceId>, loader: Arc<dyn LoadTrial>) -> Self {
        sources.sort();
        Self { key, sources, loader }
    }

    pub fn in_memory(trial: impl Into<Arc<Trial>>) -> Self {
        let trial = trial.into();
        let sources = trial.signals.keys().cloned().collect();
        Self { key: trial.key.clone(), sources, loader: Arc::new(InMemory { trial, from: None }) }
    }

    /// This entry with its loaded `trial` kept in memory, so that no file is read again.
    pub(crate) fn held(self, trial: Arc<Trial>) -> Self {
        let (key, sources) = (self.key.clone(), self.sources.clone());
        Self { key, sources, loader: Arc::new(InMemory { trial, from: Some(self) }) }
    }

    /// The trial's name for commands: its folder `SURFACE/TRIAL`, or its first file
    /// `SURFACE/FILE.wav` if it has no folder. If it is not on disk: label, user and number.
    pub fn name_in(&self, library: &Path) -> String {
        let first = self.places().first().map(|place| files::name_within(library, place));
        first.unwrap_or_else(|| self.key.to_string())
    }

    /// Drops the sources that `scene` does not describe from this entry; they are never read.
    pub fn within(mut self, scene: &Scene) -> Self {
        self.sources.retain(|id| scene.get(id.as_str()).is_some());
        self
    }

    /// This entry, with `change` applied to its trial at each load.
    pub fn changed(self, change: impl Fn(Trial) -> Trial + Send + Sync + 'static) -> Self {
        let (key, sources) = (self.key.clone(), self.sources.clone());
        Self { key, sources, loader: Arc::new(Changed { entry: self, change }) }
    }

    pub(crate) fn with_only(&self, source: &SourceId) -> Self {
        Self { sources: vec![source.clone()], ..self.clone() }
    }

    /// Reads the trial.
    ///
    /// # Errors
    /// If one of its sources cannot be read.
    pub fn load(&self) -> Result<Trial, LibraryError> {
        self.loader.load(&self.sources)
    }

    /// The [`Outline`] (rate, channels, length) of each source that is a series.
    ///
    /// # Errors
    /// If a file cannot be read.
    pub fn outlines(&self) -> Result<Outlines, LibraryError> {
        self.loader.outlines(&self.sources)
    }

    /// A number that changes whenever the trial's data change; `None` if only loading can tell.
    pub fn stamp(&self) -> Option<u64> {
        self.loader.stamp(&self.sources)
    }

    /// The paths that hold only this trial, sorted: its folder, or its files if the trial has no
    /// folder. Empty for a trial that is not on disk.
    pub fn places(&self) -> Vec<&Path> {
        self.loader.places()
    }

    /// What the trial's `trial.toml` says; nothing for a trial without a folder.
    ///
    /// # Errors
    /// If the file cannot be read, or is wrong.
    pub fn about(&self) -> Result<About, LibraryError> {
        let folder = self.places().into_iter().find(|place| place.is_dir());
        folder.map_or_else(|| Ok(About::default()), About::read)
    }

    pub(crate) fn cache_name(&self) -> String {
        let TrialKey { surface, user, number, session } = &self.key;
        let session = session.as_ref().map(|session| format!("\n{session}")).unwrap_or_default();
        format!("{surface}\n{user}\n{number}{session}")
    }
}

#[derive(Clone, Debug)]
pub struct Library {
    pub name: String,
    /// Descriptions of the sources: the default ones, and those in the library's `library.toml`.
    pub scene: Scene,
    /// The trials, sorted by key.
    pub entries: Vec<Entry>,
    /// Whether a program generated the trials. Reports of results on such trials say so.
    pub synthetic: bool,
    /// Remarks on what was missing or skipped when the library was opened, one line each.
    pub remarks: Vec<String>,
}

impl Library {
    pub fn surfaces(&self) -> Vec<&str> {
        let mut surfaces: Vec<_> = self.entries.iter().map(|e| e.key.surface.as_str()).collect();
        surfaces.sort_unstable();
        surfaces.dedup();
        surfaces
    }

    /// A hash of all labels and samples, in hexadecimal digits. It is the same on all machines and in any
    /// order of files. A source that cannot be read counts as missing. Reads all recordings.
    pub fn digest(&self) -> String {
        let of_source = |entry: &Entry, id: &SourceId| -> Option<u64> {
            let signal = entry.with_only(id).load().ok()?.signals.remove(id)?;
            let shape = match &signal {
                Signal::Series(series) => (series.rate_hz().to_bits(), series.channels() as u64),
                Signal::Image(_) => (0, 3),
            };
            let numbers = [shape.0, shape.1, signal.content_hash()].map(u64::to_le_bytes);
            Some(seed::stable_hash(&[id.as_str().as_bytes(), numbers.as_flattened()]))
        };
        let of_entry = |entry: &Entry| {
            let sources = entry.sources.iter().filter_map(|id| of_source(entry, id));
            let sources: Vec<u8> = sources.flat_map(u64::to_le_bytes).collect();
            seed::stable_hash(&[entry.cache_name().as_bytes(), &sources])
        };
        digest_of(self.entries.par_iter().map(of_entry).collect())
    }
}

/// A digest of trials, from a hash of each, in any order.
pub(crate) fn digest_of(mut trials: Vec<u64>) -> String {
    trials.sort_unstable();
    let bytes: Vec<u8> = trials.into_iter().flat_map(u64::to_le_bytes).collect();
    format!("{:016x}", seed::stable_hash(&[&bytes]))
}

#[derive(Debug)]
pub struct Unreadable {
    pub entry: usize,
    pub source: SourceId,
    pub error: LibraryError,
}

/// Reads every source of every trial, and returns the sources that cannot be read, in trial order.
pub fn unreadable(entries: &[Entry]) -> Vec<Unreadable> {
    let of_entry = |(at, entry): (usize, &Entry)| {
        let read = |source: &SourceId| {
            let error = entry.with_only(source).load().err()?;
            Some(Unreadable { entry: at, source: source.clone(), error })
        };
        entry.sources.iter().filter_map(read).collect::<Vec<_>>()
    };
    entries.par_iter().enumerate().flat_map_iter(of_entry).collect()
}

/// Name of the file that describes a trial, in the trial's folder.
pub const ABOUT_FILE: &str = "trial.toml";

/// The content of `trial.toml`: surface, user, session, start, notes and devices of one recorded trial.
/// Every key is optional; unknown keys are refused, except in the table `[meta]`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct About {
    /// The label of the surface; if missing, the name of the surface's folder is the label.
    pub surface: Option<String>,
    pub user: Option<String>,
    /// The trial's number; if it is missing, the number at the end of the folder's name counts.
    pub trial: Option<u32>,
    /// The sitting: the same person, sensor, place and day.
    pub session: Option<String>,
    /// Time at which the recording began, as a TOML date or any text.
    #[serde(deserialize_with = "date_or_text")]
    pub started_at: Option<String>,
    pub notes: Option<String>,
    /// Whether a program generated the trial, so that no sensor recorded it.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub synthetic: bool,
    /// Whether the recording was cut short, for example by a power cut; such trials are skipped.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub incomplete: bool,
    /// Times of tap and drag, written by older versions. They are kept in the file, but not used.
    pub scan: Option<toml::Table>,
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub devices: BTreeMap<String, String>,
    /// Frames that `import csv` filled in, by source: their count, and which they are.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub interpolated: BTreeMap<String, String>,
    /// Keys of one's own, such as a force or a tool: text, numbers and truth values. They are kept,
    /// and trials are chosen by them.
    #[serde(skip_serializing_if = "toml::Table::is_empty")]
    pub meta: toml::Table,
}

/// Keys of `trial.toml` that a trial is chosen by, which `[meta]` may not hold as well.
const NOT_META: [&str; 6] = ["surface", "user", "trial", "session", "synthetic", "incomplete"];

fn date_or_text<'de, D: serde::Deserializer<'de>>(from: D) -> Result<Option<String>, D::Error> {
    match toml::Value::deserialize(from)? {
        toml::Value::String(text) => Ok(Some(text)),
        toml::Value::Datetime(date) => Ok(Some(date.to_string())),
        other => Err(serde::de::Error::custom(format!(
            "{} is neither a date nor text; expected for example 2025-01-31T12:00:00Z",
            other.type_str()
        ))),
    }
}

impl About {
    /// Reads `trial.toml` in a trial's folder; a missing file counts as an empty one.
    ///
    /// # Errors
    /// If the file is not TOML, has an unknown key or an impossible value; the error names the line.
    pub fn read(trial: &Path) -> Result<Self, LibraryError> {
        let path = trial.join(ABOUT_FILE);
        match files::read_text_if_there(&path)? {
            None => Ok(Self::default()),
            Some(text) => {
                Self::from_toml(&text).map_err(|problem| LibraryError::file(&path, problem))
            }
        }
    }

    pub fn to_toml(&self) -> String {
        // `About` holds only strings, numbers and tables, which TOML can express.
        toml::to_string(self).expect("what is known of a trial is plain TOML")
    }

    fn from_toml(text: &str) -> Result<Self, String> {
        let mut about: Self = toml::from_str(text).map_err(|error| {
            let advice = match error.message().starts_with("unknown field") {
                true => "\nput keys of your own under a line `[meta]`, at the end of the file",
                false => "",
            };
            format!("{}{advice}", error.to_string().trim_end())
        })?;
        for name in [&mut about.surface, &mut about.user].into_iter().flatten() {
            *name = normal(name);
        }
        let names = [("surface", &about.surface), ("user", &about.user)];
        if let Some((key, _)) = names.iter().find(|(_, name)| name.as_deref() == Some("")) {
            return Err(format!("{key} = \"\"; write a name, or remove the line"));
        }
        about.session = (about.session.as_deref().map(checked_session).transpose())
            .map_err(|problem| format!("session {problem}"))?;
        about.meta.iter().try_for_each(|(key, value)| check_meta(key, value))?;
        Ok(about)
    }
}

/// Refuses a key of `[meta]` that would be overlooked, or that no condition can compare.
fn check_meta(key: &str, value: &toml::Value) -> Result<(), String> {
    if NOT_META.contains(&key) {
        return Err(format!("{key} stands under [meta]; move it above the line `[meta]`"));
    }
    match value {
        toml::Value::String(_)
        | toml::Value::Integer(_)
        | toml::Value::Float(_)
        | toml::Value::Boolean(_) => Ok(()),
        other => Err(format!(
            "{key} under [meta] is of the type {}; expected text in quotes, a number, true or false",
            other.type_str()
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_known_survives_being_written() {
        let about = About {
            surface: Some("steel \"A\"\n".into()),
            user: Some("expert".into()),
            trial: Some(3),
            session: Some("monday".into()),
            started_at: Some("2025-01-31T12:00:00Z".into()),
            notes: Some("pressed hard".into()),
            synthetic: true,
            incomplete: true,
            scan: Some(toml::toml! { drag_s = [0.5, 5.3] }),
            devices: BTreeMap::from([("mi2".into(), "hw:1".into())]),
            interpolated: BTreeMap::from([("acc".into(), "2 of 100: 7-8".into())]),
            meta: toml::toml! { force_n = 1.5
            passes = 3
            tool = "steel tip"
            wet = false },
        };
        assert_eq!(About::from_toml(&about.to_toml()), Ok(about));
        assert_eq!(About::from_toml(""), Ok(About::default()));
    }

    #[test]
    fn an_unknown_key_is_refused_with_the_advice_to_put_it_under_meta() {
        let error = About::from_toml("user = \"anna\"\nforce_n = 2\n").unwrap_err();
        assert!(error.contains("line 2") && error.contains("force_n"), "{error}");
        assert!(error.contains("`[meta]`"), "{error}");
        let other = About::from_toml("trial = \"x\"").unwrap_err();
        assert!(!other.contains("[meta]"), "{other}");
    }

    #[test]
    fn meta_holds_text_numbers_and_truth_values_and_no_key_of_the_trial() {
        let meta = |text: &str| About::from_toml(&format!("[meta]\n{text}"));
        assert!(meta("tool = \"tip\"\nforce_n = 1\nspeed = 0.5\nwet = true").is_ok());
        for (text, expected) in [
            ("user = \"anna\"", "above the line"),
            ("forces = [1, 2]", "type array"),
            ("at = 2026-01-31", "type datetime"),
        ] {
            let error = meta(text).unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
    }

    #[test]
    fn a_session_is_a_label_and_may_be_a_moment() {
        let session = |text: &str| About::from_toml(text).map(|about| about.session);
        assert_eq!(session("session = \" day 2 \""), Ok(Some("day 2".into())));
        let moment = "2026-11-25T10:42";
        assert_eq!(session(&format!("session = \"{moment}\"")), Ok(Some(moment.into())));
        let error = session("session = \"a/b\"").unwrap_err();
        assert!(error.starts_with("session holds '/'"), "{error}");
        assert!(session("session = \"\"").unwrap_err().contains("is empty"));
    }

    #[test]
    fn a_start_may_be_a_date_or_text() {
        let start = |text: &str| About::from_toml(text).map(|about| about.started_at.unwrap());
        assert_eq!(start("started_at = 2025-01-31T12:00:00Z").unwrap(), "2025-01-31T12:00:00Z");
        assert_eq!(start("started_at = \"noon\"").unwrap(), "noon");
        let error = start("notes = \"\"\nstarted_at = 12").unwrap_err();
        assert!(error.contains("line 2") && error.contains("neither a date"), "{error}");
    }
}
