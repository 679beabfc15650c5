//! A library: labelled trials to compare with, loaded when they are needed.

mod about;
pub(crate) mod audit;
pub mod cache;
pub(crate) mod files;
mod flac;
pub(crate) mod loader;
mod loose;
mod picture;
pub mod recording;
pub(crate) mod seen;
pub(crate) mod series_file;
pub(crate) mod series_header;
mod text;
mod wav;

pub use about::About;
pub(crate) use about::FILE as ABOUT_FILE;

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::scene::{Scene, SceneError, SourceId};
use crate::trial::{Signal, SignalError, Trial, TrialKey};

/// Why a trial or a library cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum LibraryError {
    /// the file system refused
    #[error("{}: {error}", path.display())]
    Io {
        /// the file or folder
        path: PathBuf,
        /// its error
        error: std::io::Error,
    },
    /// a file that does not hold what it should
    #[error("{}: {problem}", path.display())]
    File {
        /// the file
        path: PathBuf,
        /// what is wrong, what was expected, what to do
        problem: String,
    },
    /// a file whose data cannot be a signal
    #[error("{}: {error}", path.display())]
    Signal {
        /// the file
        path: PathBuf,
        /// what is wrong with the data
        error: SignalError,
    },
    /// a description of sources that cannot be used
    #[error("{}: {error}", path.display())]
    Scene {
        /// the file
        path: PathBuf,
        /// what is wrong with it
        error: Box<SceneError>,
    },
    /// several files that cannot be used
    #[error("{}", list(.0))]
    Several(Vec<LibraryError>),
    /// a folder without recordings
    #[error("{}: {problem}", path.display())]
    NothingFound {
        /// the folder
        path: PathBuf,
        /// what was looked for, and what to do
        problem: String,
    },
}

/// The size of a series, known before its samples are read.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outline {
    /// Frames a second.
    pub rate_hz: f64,
    /// Samples a frame.
    pub channels: usize,
    /// Length in frames.
    pub frames: usize,
}

/// The outline of each series among the sources of a trial.
pub type Outlines = BTreeMap<SourceId, Outline>;

impl Outline {
    /// The outline of a signal; `None` for a picture.
    fn of(signal: &Signal) -> Option<Self> {
        let Signal::Series(series) = signal else { return None };
        let (rate_hz, channels) = (series.rate_hz(), series.channels());
        Some(Self { rate_hz, channels, frames: series.frames() })
    }

    fn all(trial: &Trial) -> Outlines {
        let outline = |(id, signal): (&SourceId, _)| Some((id.clone(), Self::of(signal)?));
        trial.signals.iter().filter_map(outline).collect()
    }
}

/// All errors as one text: their count, then one line each.
fn list(errors: &[LibraryError]) -> String {
    let lines = errors.iter().map(|error| format!("\n  {error}"));
    format!("{} files cannot be used:{}", errors.len(), lines.collect::<String>())
}

impl LibraryError {
    /// The file or folder that the error is about; `None` for errors of several files.
    pub(crate) fn path(&self) -> Option<&Path> {
        match self {
            Self::Io { path, .. }
            | Self::File { path, .. }
            | Self::Signal { path, .. }
            | Self::Scene { path, .. }
            | Self::NothingFound { path, .. } => Some(path),
            Self::Several(_) => None,
        }
    }

    /// Turns errors of several files into one; `None` if there are none.
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
    /// The part that can be used.
    pub library: Library,
    /// One error for each file or trial that cannot be used.
    pub bad: Vec<LibraryError>,
}

impl Opened {
    /// The library, if all of it can be used.
    ///
    /// # Errors
    /// All errors at once, if any file or trial cannot be used.
    pub fn whole(self) -> Result<Library, LibraryError> {
        LibraryError::of_all(self.bad).map_or(Ok(self.library), Err)
    }
}

/// Something that can produce one trial: files on disk, a generator, memory.
pub trait LoadTrial: Send + Sync + fmt::Debug {
    /// Reads the `wanted` sources of the trial; sources that the trial lacks are skipped.
    ///
    /// # Errors
    /// If one of them cannot be read.
    fn load(&self, wanted: &[SourceId]) -> Result<Trial, LibraryError>;

    /// The outlines of the `wanted` sources; `None` if they cost no less than reading the trial.
    ///
    /// # Errors
    /// If a file cannot be read.
    fn outlines(&self, _wanted: &[SourceId]) -> Result<Option<Outlines>, LibraryError> {
        Ok(None)
    }

    /// A number that changes whenever the data of the `wanted` sources change; `None` if that
    /// cannot be known without reading them.
    fn stamp(&self, _wanted: &[SourceId]) -> Option<u64> {
        None
    }

    /// The paths that hold the trial and nothing else: its folder, or its files.
    fn places(&self) -> Vec<&Path> {
        Vec::new()
    }
}

#[derive(Debug)]
struct InMemory {
    trial: Arc<Trial>,
    /// The entry that the trial was read from, if any.
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

/// An entry whose trial is changed after each load, for example cut short.
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
    /// Its surface, user and number.
    pub key: TrialKey,
    /// Its sources, sorted by name.
    pub sources: Vec<SourceId>,
    loader: Arc<dyn LoadTrial>,
}

impl Entry {
    /// An entry whose trial `loader` will read.
    pub fn new(key: TrialKey, mut sources: Vec<SourceId>, loader: Arc<dyn LoadTrial>) -> Self {
        sources.sort();
        Self { key, sources, loader }
    }

    /// An entry for a trial that is already in memory.
    pub fn in_memory(trial: impl Into<Arc<Trial>>) -> Self {
        let trial = trial.into();
        let sources = trial.signals.keys().cloned().collect();
        Self { key: trial.key.clone(), sources, loader: Arc::new(InMemory { trial, from: None }) }
    }

    /// This entry with its trial held in memory; `trial` is what the entry has loaded.
    pub(crate) fn held(self, trial: Arc<Trial>) -> Self {
        let (key, sources) = (self.key.clone(), self.sources.clone());
        Self { key, sources, loader: Arc::new(InMemory { trial, from: Some(self) }) }
    }

    /// The trial's name in `surfaced library`: `SURFACE/TRIAL`, or its first file
    /// `SURFACE/FILE.wav` if it has no folder; label, user and number if it is not on disk.
    pub(crate) fn name_in(&self, library: &Path) -> String {
        let first = self.places().first().map(|place| files::name_within(library, place));
        first.unwrap_or_else(|| self.key.to_string())
    }

    /// This entry with only those of its sources that `scene` describes; no others are read.
    pub fn within(mut self, scene: &Scene) -> Self {
        self.sources.retain(|id| scene.get(id.as_str()).is_some());
        self
    }

    /// This entry, with `change` applied to its trial at each load.
    pub fn changed(self, change: impl Fn(Trial) -> Trial + Send + Sync + 'static) -> Self {
        let (key, sources) = (self.key.clone(), self.sources.clone());
        Self { key, sources, loader: Arc::new(Changed { entry: self, change }) }
    }

    /// This entry under another name.
    pub(crate) fn renamed(self, key: TrialKey) -> Self {
        let is = key.clone();
        Self { key, ..self.changed(move |trial| Trial { key: is.clone(), ..trial }) }
    }

    /// This entry, reduced to one of its sources.
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

    /// The outline of each source that is a series.
    ///
    /// # Errors
    /// If a file cannot be read.
    pub fn outlines(&self) -> Result<Outlines, LibraryError> {
        match self.loader.outlines(&self.sources)? {
            Some(outlines) => Ok(outlines),
            None => Ok(Outline::all(&self.load()?)),
        }
    }

    /// A number that changes whenever the trial's data change, if known without reading them.
    pub fn stamp(&self) -> Option<u64> {
        self.loader.stamp(&self.sources)
    }

    /// The paths that hold the trial and nothing else, sorted: its folder, or its files if it has
    /// no folder of its own. Empty for a trial that is not on disk.
    pub fn places(&self) -> Vec<&Path> {
        self.loader.places()
    }

    /// The trial's name in a cache.
    pub(crate) fn cache_name(&self) -> String {
        let TrialKey { surface, user, number } = &self.key;
        format!("{surface}\n{user}\n{number}")
    }
}

/// Labelled trials, and the description of their sources.
#[derive(Clone, Debug)]
pub struct Library {
    /// Its name, for people.
    pub name: String,
    /// The sources: the defaults, and those described in the library itself.
    pub scene: Scene,
    /// The trials, sorted by key.
    pub entries: Vec<Entry>,
    /// Whether a generator made the trials; then every report of their numbers says so.
    pub synthetic: bool,
    /// Remarks on what was missing or skipped when the library was opened, one line each.
    pub remarks: Vec<String>,
}

impl Library {
    /// The surfaces, sorted.
    pub fn surfaces(&self) -> Vec<&str> {
        let mut surfaces: Vec<_> = self.entries.iter().map(|e| e.key.surface.as_str()).collect();
        surfaces.sort_unstable();
        surfaces.dedup();
        surfaces
    }
}
