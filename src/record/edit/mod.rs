//! Edits of a library on disk, each of which can be undone: trials get another label, are removed,
//! and come back.
//!
//! A removed trial lies in `LIBRARY/.removed/SURFACE/TRIAL`, whole, where no reader looks.
//! `LIBRARY/.removed/steps.jsonl` lists the steps, so that the last can be taken back. Nothing is
//! moved while somebody reads the library ([`LibraryLock`]), and a step that a crash cut short can
//! be undone like any other.

mod folders;
mod list;
mod relocate;
mod steps;

pub(crate) use folders::trial_name;
pub use list::{ListedTrial, list, list_removed};
pub use steps::{Move, Step, last_step};

use std::fs;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use self::folders::{REMOVED, name_of, trials};
use self::relocate::{relocate, replace};
use self::steps::{MOST_STEPS, STEPS, steps};
use super::{failed, trial_folder, utc};
use crate::library::lock::LibraryLock;
use crate::library::{Entry, LibraryError};
use crate::scene::Scene;
use crate::trial::TrialKey;

/// A library that is being edited; nobody reads it meanwhile.
pub struct Editor {
    root: PathBuf,
    scene: Scene,
    _lock: LibraryLock,
}

/// The number after those that the trials of a surface by a user have.
///
/// # Errors
/// If the library is there and cannot be read.
pub(crate) fn next_number(
    library: &Path,
    scene: &Scene,
    surface: &str,
    user: &str,
) -> Result<u32, LibraryError> {
    Ok(number_after(&keys(&trials(library, scene)?), surface, user))
}

fn number_after(taken: &[TrialKey], surface: &str, user: &str) -> u32 {
    let of = taken.iter().filter(|key| key.surface == surface && key.user == user);
    of.map(|key| key.number.saturating_add(1)).max().unwrap_or(1)
}

fn keys(entries: &[Entry]) -> Vec<TrialKey> {
    entries.iter().map(|entry| entry.key.clone()).collect()
}

impl Editor {
    /// Waits until nobody reads a library, and takes it for editing.
    ///
    /// # Errors
    /// If there is no such library, or somebody reads it all the time.
    pub fn open(library: &Path, scene: &Scene) -> Result<Self, LibraryError> {
        let lock = LibraryLock::for_editing(library)?;
        Ok(Self { root: library.to_path_buf(), scene: scene.clone(), _lock: lock })
    }

    /// Gives all trials of a surface another label.
    ///
    /// # Errors
    /// If there is no such surface, or the file system refuses; then nothing has changed, as for all
    /// that follow.
    pub fn rename(&self, surface: &str, label: &str) -> Result<Step, LibraryError> {
        let entries = trials(&self.root, &self.scene)?;
        let of_surface: Vec<&Entry> =
            entries.iter().filter(|entry| entry.key.surface == surface).collect();
        if of_surface.is_empty() {
            return Err(self.nothing_called(surface, &entries));
        }
        let what = format!("rename {surface} to {label}");
        self.relabel(&entries, &of_surface, label, what)
    }

    /// Gives some trials another label: those of these names, or all of these surfaces.
    ///
    /// # Errors
    /// As [`Editor::rename`].
    pub fn move_to(&self, names: &[String], label: &str) -> Result<Step, LibraryError> {
        let entries = trials(&self.root, &self.scene)?;
        let chosen = self.choose(&self.root, &entries, names)?;
        let what = format!("move {} to {label}", names.join(", "));
        self.relabel(&entries, &chosen, label, what)
    }

    fn relabel(
        &self,
        entries: &[Entry],
        chosen: &[&Entry],
        label: &str,
        what: String,
    ) -> Result<Step, LibraryError> {
        let mut taken = keys(entries);
        let mut moves = Vec::new();
        for entry in chosen.iter().filter(|entry| entry.key.surface != label) {
            let from = self.folder_of(entry)?;
            let is = free_key(&mut taken, label, &entry.key);
            let to = self.free_folder(&trial_folder(&self.root, &is), &moves);
            moves.push(self.step_of(from, &to, Some((entry.key.clone(), is))));
        }
        self.take(what, moves)
    }

    /// Removes trials: those of these names, or all of these surfaces.
    ///
    /// # Errors
    /// As [`Editor::rename`].
    pub fn remove(&self, names: &[String]) -> Result<Step, LibraryError> {
        let entries = trials(&self.root, &self.scene)?;
        let mut moves = Vec::new();
        for name in names {
            let one = std::slice::from_ref(name);
            match self.choose(&self.root, &entries, one) {
                Ok(chosen) => {
                    for entry in chosen {
                        let from = self.folder_of(entry)?;
                        let key = Some((entry.key.clone(), entry.key.clone()));
                        self.remove_folder(from, key, &mut moves);
                    }
                }
                // One that cannot be read is the more worth removing.
                Err(error) => match self.unreadable(name) {
                    Some(folder) => self.remove_folder(&folder, None, &mut moves),
                    None => return Err(error),
                },
            }
        }
        self.take(format!("remove {}", names.join(", ")), moves)
    }

    fn remove_folder(&self, from: &Path, key: Option<(TrialKey, TrialKey)>, moves: &mut Vec<Move>) {
        let name = trial_name(&self.root, from);
        if moves.iter().all(|other| other.from != name) {
            let to = self.free_folder(&self.root.join(REMOVED).join(&name), moves);
            moves.push(self.step_of(from, &to, key));
        }
    }

    /// Brings removed trials back: those of these names, or all of these surfaces.
    ///
    /// # Errors
    /// As [`Editor::rename`].
    pub fn restore(&self, names: &[String]) -> Result<Step, LibraryError> {
        let mut taken = keys(&trials(&self.root, &self.scene)?);
        let bin = self.root.join(REMOVED);
        let entries = trials(&bin, &self.scene)?;
        let mut moves = Vec::new();
        for entry in self.choose(&bin, &entries, names)? {
            let from = self.folder_of(entry)?;
            let is = free_key(&mut taken, &entry.key.surface, &entry.key);
            let to = self.free_folder(&trial_folder(&self.root, &is), &moves);
            moves.push(self.step_of(from, &to, Some((entry.key.clone(), is))));
        }
        self.take(format!("restore {}", names.join(", ")), moves)
    }

    /// Takes the last step back; gives it.
    ///
    /// # Errors
    /// If there is none, or the file system refuses.
    pub fn undo(&self) -> Result<Step, LibraryError> {
        let mut steps = steps(&self.root)?;
        let Some(step) = steps.pop() else {
            return Err(LibraryError::file(&self.root, "there is no step to undo"));
        };
        for one in step.moves.iter().rev() {
            let (from, to) = (self.root.join(&one.to), self.root.join(&one.from));
            // A step that was cut short has not moved all.
            if from.exists() && !to.exists() {
                relocate(&from, &to, one.was.as_ref())?;
            }
        }
        self.write_steps(&steps)?;
        Ok(step)
    }

    /// The trials of some names: `SURFACE/TRIAL`, or `SURFACE` for all of one.
    fn choose<'e>(
        &self,
        folder: &Path,
        entries: &'e [Entry],
        names: &[String],
    ) -> Result<Vec<&'e Entry>, LibraryError> {
        let mut chosen: Vec<&Entry> = Vec::new();
        for name in names {
            let is = |entry: &&Entry| name_of(folder, entry) == *name || entry.key.surface == *name;
            let before = chosen.len();
            let new = entries.iter().filter(is);
            chosen.extend(
                new.filter(|new| chosen.iter().all(|old| old.key != new.key)).collect::<Vec<_>>(),
            );
            if chosen.len() == before && !entries.iter().any(|entry| is(&entry)) {
                return Err(self.nothing_called(name, entries));
            }
        }
        Ok(chosen)
    }

    /// The folder of a trial, which is what edits move.
    fn folder_of<'e>(&self, entry: &'e Entry) -> Result<&'e Path, LibraryError> {
        let problem = "its trials are files that have no folder of their own, and those are not edited \
                       here: rename or move the files, or put each into SURFACE/TRIAL/SOURCE.wav";
        let surface = self.root.join(&entry.key.surface);
        entry.folder().ok_or_else(|| LibraryError::file(&surface, problem))
    }

    fn nothing_called(&self, name: &str, entries: &[Entry]) -> LibraryError {
        let mut surfaces: Vec<&str> = entries.iter().map(|e| e.key.surface.as_str()).collect();
        surfaces.dedup();
        let there = match surfaces.len() {
            0 => "there is none".to_string(),
            1..=12 => format!("surfaces: {}", surfaces.join(", ")),
            many => format!("there are {many} surfaces; `surfaced library list` names them"),
        };
        let problem = format!("no surface or trial (SURFACE/TRIAL) is called {name:?}; {there}");
        LibraryError::file(&self.root, problem)
    }

    /// The folder of a trial that no reader takes.
    fn unreadable(&self, name: &str) -> Option<PathBuf> {
        let (surface, trial) = name.split_once('/')?;
        let plain = |part: &str| {
            !part.is_empty() && !part.starts_with('.') && !part.contains(['/', '\\', '\0'])
        };
        let folder = self.root.join(surface).join(trial);
        (plain(surface) && plain(trial) && folder.is_dir()).then_some(folder)
    }

    /// A folder like this one that nothing has yet.
    fn free_folder(&self, folder: &Path, moves: &[Move]) -> PathBuf {
        let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let names = (1..).map(|n| if n == 1 { name.clone() } else { format!("{name}-{n}") });
        let mut folders = names.map(|name| folder.with_file_name(name));
        let free = |path: &PathBuf| {
            !path.exists() && moves.iter().all(|other| self.root.join(&other.to) != *path)
        };
        // There is always another number.
        folders.find(free).unwrap_or_else(|| folder.to_path_buf())
    }

    fn step_of(&self, from: &Path, to: &Path, key: Option<(TrialKey, TrialKey)>) -> Move {
        let (was, is) = key.unzip();
        Move { from: trial_name(&self.root, from), to: trial_name(&self.root, to), was, is }
    }

    /// Writes a step down, and does it; a step that fails is taken back.
    fn take(&self, what: String, moves: Vec<Move>) -> Result<Step, LibraryError> {
        let step = Step { what, at: utc(SystemTime::now()), moves };
        let before = steps(&self.root)?;
        let mut all = before.clone();
        all.push(step.clone());
        self.write_steps(&all)?;
        for (at, one) in step.moves.iter().enumerate() {
            let (from, to) = (self.root.join(&one.from), self.root.join(&one.to));
            if let Err(error) = relocate(&from, &to, one.is.as_ref()) {
                for done in step.moves[..at].iter().rev() {
                    let (from, to) = (self.root.join(&done.to), self.root.join(&done.from));
                    // What cannot be taken back stays in the list of steps.
                    relocate(&from, &to, done.was.as_ref())?;
                }
                self.write_steps(&before)?;
                return Err(error);
            }
        }
        Ok(step)
    }

    fn write_steps(&self, steps: &[Step]) -> Result<(), LibraryError> {
        let bin = self.root.join(REMOVED);
        fs::create_dir_all(&bin).map_err(|error| failed(&bin, error))?;
        let newest = &steps[steps.len().saturating_sub(MOST_STEPS)..];
        // Plain structs, numbers and text: nothing here that JSON cannot express.
        let line = |step| serde_json::to_string(step).unwrap_or_default() + "\n";
        let text: String = newest.iter().map(line).collect();
        replace(&bin.join(STEPS), &text)
    }
}

/// A name under a label that no trial has, with the same number if that is free; it is taken now.
fn free_key(taken: &mut Vec<TrialKey>, label: &str, key: &TrialKey) -> TrialKey {
    let mut is = TrialKey::new(label, &key.user, key.number);
    if taken.contains(&is) {
        is.number = number_after(taken, label, &key.user);
    }
    taken.push(is.clone());
    is
}

#[cfg(test)]
mod tests;
