//! A library: labelled trials that scans are compared with. Trials are read when they are needed.

mod about;
pub mod cache;
#[doc(hidden)]
pub mod files;
pub(crate) mod loader;
#[cfg(feature = "lossy")]
mod lossy;
pub mod recording;
pub(crate) mod series_file;
pub(crate) mod shape;
pub(crate) mod wav;

pub use about::{ABOUT_FILE, About};

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rayon::prelude::*;

use crate::scene::{Scene, SceneError, SourceId};
use crate::seed;
use crate::trial::{Series, Signal, Trial, TrialKey};

#[derive(Debug, thiserror::Error)]
pub enum LibraryError {
    /// a file or folder that cannot be read, or does not hold what it should; the problem says what is wrong,
    /// what was expected, and what to do
    #[error("{}: {problem}", path.display())]
    File { path: PathBuf, problem: String },
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
        let Self::File { path, .. } = self else { return None };
        Some(path)
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

    /// The content of the trial's `trial.toml`; empty for a trial without a folder.
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
    /// A library in memory. Its trials have one source, a series, and all have the channels and the rate
    /// of the first. `band_hz` is that of [`Scene::of_series`].
    ///
    /// # Errors
    /// If there are no trials, if channels or rates differ, and the errors of [`Scene::of_series`].
    pub fn of_series(
        source: &SourceId,
        band_hz: Option<(f64, f64)>,
        trials: impl IntoIterator<Item = (TrialKey, Series)>,
    ) -> Result<Self, SceneError> {
        let trials: Vec<(TrialKey, Series)> = trials.into_iter().collect();
        let like = |series: &Series| (series.channels(), series.rate_hz());
        let Some((channels, rate_hz)) = trials.first().map(|(_, first)| like(first)) else {
            return Err(SceneError("there are no trials".into()));
        };
        if let Some((key, other)) = trials.iter().find(|(_, s)| like(s) != (channels, rate_hz)) {
            let (found, found_hz) = like(other);
            return Err(SceneError(format!(
                "{key} has {found} channels at {found_hz} Hz; expected {channels} at {rate_hz} Hz, like \
                 the first trial"
            )));
        }
        let scene = Scene::of_series(source.clone(), channels, rate_hz, band_hz)?;
        let entry = |(key, series)| Entry::in_memory(Trial::of_series(key, source.clone(), series));
        let mut entries: Vec<Entry> = trials.into_iter().map(entry).collect();
        entries.sort_by(|a, b| a.key.cmp(&b.key));
        Ok(Self { name: String::new(), scene, entries, synthetic: false, remarks: Vec::new() })
    }

    pub fn surfaces(&self) -> Vec<&str> {
        let surfaces = self.entries.iter().map(|e| e.key.surface.as_str());
        surfaces.collect::<BTreeSet<_>>().into_iter().collect()
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

#[cfg(test)]
mod tests {
    use super::*;

    fn library(rates: [f64; 2], channels: [usize; 2]) -> Result<Library, SceneError> {
        let trials = (1..).zip(rates).zip(channels).map(|((number, rate_hz), channels)| {
            let series = Series::new(rate_hz, channels, vec![0.5; 12]).unwrap();
            (TrialKey::new("oak", "ann", 3 - number), series)
        });
        Library::of_series(&SourceId::new("signal").unwrap(), Some((5.0, 50.0)), trials)
    }

    #[test]
    fn trials_are_sorted_and_have_one_source_of_one_shape() {
        let library_of_two = library([100.0; 2], [2; 2]).unwrap();
        let numbers: Vec<u32> = library_of_two.entries.iter().map(|e| e.key.number).collect();
        assert_eq!(numbers, [1, 2]);
        assert_eq!(library_of_two.scene.get("signal").unwrap().channels, 2);
        let why = library([100.0, 200.0], [2; 2]).unwrap_err().to_string();
        assert!(why.contains("2 channels at 200 Hz; expected 2 at 100 Hz"), "{why}");
        assert!(library([100.0; 2], [2, 3]).is_err());
        let why = library([80.0; 2], [1; 2]).unwrap_err().to_string();
        assert!(why.contains("lower its upper end to 40"), "{why}");
    }
}
