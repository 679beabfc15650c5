//! Lists the trials of a library by the names that edits use.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde::Serialize;

use super::REMOVED;
use crate::library::files::{self, Listed};
use crate::library::{About, Entry, LibraryError, recording};
use crate::record::folder_name::{is_plain, is_trial};
use crate::scene::{Scene, SourceId};
use crate::trial::{EXPERT, TrialKey, normal};

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ListedTrial {
    /// The trial's name for edits: its folder `SURFACE/TRIAL`, or its first file `SURFACE/FILE.wav`
    /// if it has no folder of its own.
    pub trial: String,
    /// The trial's label, user and number.
    #[serde(flatten)]
    pub key: TrialKey,
    /// When the trial was recorded, as its `trial.toml` says.
    pub started_at: Option<String>,
    pub sources: Vec<SourceId>,
    /// Duration of the trial's longest series, in seconds.
    pub seconds: f64,
}

#[doc(hidden)]
pub use crate::library::files::name_within as trial_name;

/// The trials of a library that can be read.
pub(super) fn trials(library: &Path, scene: &Scene) -> Result<Vec<Entry>, LibraryError> {
    Ok(recording::open_part(library, library, scene)?.library.entries)
}

/// The removed trials of a library that can be read.
pub(super) fn removed(library: &Path, scene: &Scene) -> Result<Vec<Entry>, LibraryError> {
    let bin = library.join(REMOVED);
    if !bin.exists() {
        return Ok(Vec::new());
    }
    // `library.toml` in the library's folder describes the sources of removed trials, too.
    Ok(recording::open_part(&bin, library, scene)?.library.entries)
}

/// The trials of a library that can be read, sorted.
///
/// # Errors
/// If the library cannot be read.
pub fn list(library: &Path, scene: &Scene) -> Result<Vec<ListedTrial>, LibraryError> {
    Ok(trials(library, scene)?.iter().map(|entry| listed(library, entry)).collect())
}

/// The removed trials of a library, which can be restored, sorted. A trial that cannot be read is
/// listed without its sources.
///
/// # Errors
/// If the folder of removed trials cannot be read.
pub fn list_removed(library: &Path, scene: &Scene) -> Result<Vec<ListedTrial>, LibraryError> {
    let bin = library.join(REMOVED);
    let entries = removed(library, scene)?;
    let mut all: BTreeMap<String, ListedTrial> = BTreeMap::new();
    // A trial of several files is listed by its first file.
    let others = entries.iter().flat_map(|entry| entry.places().into_iter().skip(1));
    let others: BTreeSet<String> = others.map(|place| trial_name(&bin, place)).collect();
    for (surface, trial) in places(&bin) {
        let name = format!("{surface}/{trial}");
        if others.contains(&name) {
            continue;
        }
        let stem = Path::new(&trial).file_stem().unwrap_or_default().to_string_lossy();
        let number = files::number_in(&stem).unwrap_or_default();
        let (key, sources) = (TrialKey::new(normal(&surface), EXPERT, number), Vec::new());
        let one = ListedTrial { trial: name.clone(), key, started_at: None, sources, seconds: 0.0 };
        all.insert(name, one);
    }
    all.extend(entries.iter().map(|entry| (entry.name_in(&bin), listed(&bin, entry))));
    Ok(all.into_values().collect())
}

/// All folders and files that may hold a trial, each as `(SURFACE, TRIAL)`.
pub(super) fn places(root: &Path) -> Vec<(String, String)> {
    let within = |folder: &Path, is_wanted: fn(&Listed) -> bool| {
        let items = files::list(folder).unwrap_or_default().into_iter();
        let names = items.filter(is_wanted).map(|item| item.name);
        names.filter(|name| is_plain(name)).collect::<Vec<_>>()
    };
    let of_surface = |surface: String| {
        let trials = within(&root.join(&surface), |item| item.is_dir || item.is_series());
        trials.into_iter().map(move |trial| (surface.clone(), trial))
    };
    within(root, |item| item.is_dir).into_iter().flat_map(of_surface).collect()
}

fn listed(root: &Path, entry: &Entry) -> ListedTrial {
    // Unreadable sources are left out here; `surfaced check` reports them.
    let seconds = entry.outlines().unwrap_or_default();
    let seconds = seconds.values().map(|of| of.frames as f64 / of.rate_hz);
    ListedTrial {
        trial: entry.name_in(root),
        key: entry.key.clone(),
        started_at: entry.about().ok().and_then(|about| about.started_at),
        sources: entry.sources.clone(),
        seconds: seconds.fold(0.0, f64::max),
    }
}

/// The next free number for each surface and user; removed trials keep theirs for a restore.
pub fn numbers_after(
    library: &Path,
    scene: &Scene,
) -> Result<BTreeMap<(String, String), u32>, LibraryError> {
    let mut numbers = BTreeMap::new();
    if !library.exists() {
        return Ok(numbers);
    }
    for entry in trials(library, scene)?.into_iter().chain(removed(library, scene)?) {
        let next = numbers.entry((entry.key.surface, entry.key.user)).or_insert(1);
        *next = entry.key.number.saturating_add(1).max(*next);
    }
    Ok(numbers)
}

/// The name `SURFACE/TRIAL` of the trial whose `trial.toml` has these notes. Tries `likely` first.
pub fn trial_of_note(library: &Path, notes: &str, likely: Option<&str>) -> Option<String> {
    let is = |name: &&str| is_trial(name) && notes_of(library, name).as_deref() == Some(notes);
    let likely = likely.filter(is).map(String::from);
    likely.or_else(|| trials_by_note(library).remove(notes))
}

/// The names of all trials that have notes, by these notes.
pub fn trials_by_note(library: &Path) -> BTreeMap<String, String> {
    let mut trials = BTreeMap::new();
    for (surface, trial) in places(library) {
        let name = format!("{surface}/{trial}");
        if let Some(notes) = notes_of(library, &name) {
            trials.entry(notes).or_insert(name);
        }
    }
    trials
}

/// The notes of the trial of this name, also of one among the removed trials.
pub fn notes_of(library: &Path, name: &str) -> Option<String> {
    About::read(&library.join(name)).ok()?.notes
}
