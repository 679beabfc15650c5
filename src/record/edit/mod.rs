//! Edits of a library on disk, each of which can be undone: giving trials another label, removing
//! them, and restoring them.
//!
//! A removed trial lies complete in `LIBRARY/.removed/SURFACE/TRIAL`, which readers skip.
//! `LIBRARY/.removed/steps.jsonl` lists the edits, so that the last one can be undone, and one that
//! a crash cut short is finished when the library is next opened. Nothing is moved while somebody
//! reads the library ([`LibraryLock`]).

mod disk;
mod list;
mod lock;
mod moves;
mod plan;
mod steps;

pub use list::{ListedTrial, list, list_removed};
pub(crate) use list::{number_after, numbers_after, trial_name, trial_of_note};
pub use lock::LibraryLock;
pub use steps::{Move, Step, last_step};

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use serde::Serialize;

use self::list::{places, removed, trials};
use self::moves::{carry_out, check, tidy};
use self::plan::Plan;
use self::steps::Steps;
use super::{TrialOptions, append_trial, trial_folder, utc};
use crate::library::{Entry, LibraryError};
use crate::scene::Scene;
use crate::system::identity;
use crate::trial::{Trial, TrialKey, normal};

/// The folder of removed trials.
pub(super) const REMOVED: &str = ".removed";

/// Whether readers accept a folder of this name, and the name leads nowhere else.
pub(crate) fn is_plain(name: &str) -> bool {
    !name.is_empty() && !name.starts_with('.') && !name.contains(['/', '\0'])
}

/// A library that is being edited; nobody reads it meanwhile.
pub struct Editor {
    root: PathBuf,
    scene: Scene,
    steps: Steps,
    _lock: LibraryLock,
}

/// A step that was undone.
#[derive(Clone, Debug, Serialize)]
pub struct Undone {
    /// The step, with the moves that undid it.
    #[serde(flatten)]
    pub step: Step,
    /// Trials of the step that are no longer where it put them, `SURFACE/TRIAL`.
    pub gone: Vec<String>,
}

impl AsRef<Step> for Undone {
    fn as_ref(&self) -> &Step {
        &self.step
    }
}

impl AsRef<Self> for Step {
    fn as_ref(&self) -> &Self {
        self
    }
}

/// Writes a trial into a library as a step that can be undone, under the next number that no trial
/// has, not even a removed one. Returns its name, `SURFACE/TRIAL`. A trial with the same notes is
/// the same trial: it stays where it is, or is restored if it was removed.
///
/// # Errors
/// If the library cannot be read or written.
pub(crate) fn keep(
    library: &Path,
    scene: &Scene,
    mut trial: Trial,
    options: &TrialOptions,
    what: String,
) -> Result<String, LibraryError> {
    // Once the library is locked for editing, nothing moves during the search.
    let mut editor = Editor::open(library, scene)?;
    if let Some(notes) = &options.about.notes {
        if let Some(there) = trial_of_note(library, notes, None) {
            return Ok(there);
        }
        if let Some(gone) = trial_of_note(&library.join(REMOVED), notes, None)
            && let Some(back) = editor.bring_back(&gone, &trial.key, what.clone())?
        {
            return Ok(back);
        }
    }
    trial.key.number = number_after(library, scene, &trial.key.surface, &trial.key.user)?;
    let (number, folder) = append_trial(library, &trial, scene, options)?;
    let to = trial_name(library, &folder);
    let key = Some(TrialKey { number, ..trial.key });
    // Undoing this step removes the trial.
    let from = format!("{REMOVED}/{to}");
    let moves = vec![Move { from, to: to.clone(), was: key.clone(), is: key, inode: None }];
    editor.steps.note(Step { what, at: utc(SystemTime::now()), moves })?;
    Ok(to)
}

impl Editor {
    /// Waits until nobody reads a library, locks it for editing, and finishes an edit cut short.
    ///
    /// # Errors
    /// If there is no such library, somebody reads it all the time, or an edit that was cut short
    /// can be neither finished nor taken back.
    pub fn open(library: &Path, scene: &Scene) -> Result<Self, LibraryError> {
        let lock = LibraryLock::for_editing(library)?;
        let (root, steps) = (library.to_path_buf(), Steps::open(library)?);
        let mut editor = Self { root, scene: scene.clone(), steps, _lock: lock };
        editor.finish_left()?;
        Ok(editor)
    }

    /// Finishes an edit that was cut short, and nothing else.
    fn finish(library: &Path) -> Result<(), LibraryError> {
        Self::open(library, &Scene::lmt108()).map(drop)
    }

    fn finish_left(&mut self) -> Result<(), LibraryError> {
        let Some(last) = self.steps.last() else { return Ok(()) };
        let Some((moves, undoing)) = last.left() else { return Ok(()) };
        let what = format!("{}{}", if undoing { "undo " } else { "" }, last.step.what);
        let (moves, root) = (moves.to_vec(), self.root.display().to_string());
        match self.settle(&moves, undoing)? {
            None => tracing::warn!("{root}: `{what}` was cut short, and is finished now"),
            Some(error) => tracing::warn!(
                "{root}: `{what}` was cut short and cannot be finished, so it is taken back; to go \
                 on, give it again: {error}"
            ),
        }
        Ok(())
    }

    /// Gives all trials of a surface another label.
    ///
    /// # Errors
    /// If there is no such surface, or the file system refuses. Then nothing has changed, which
    /// also holds for the other edits.
    pub fn rename(&mut self, surface: &str, label: &str) -> Result<Step, LibraryError> {
        let entries = trials(&self.root, &self.scene)?;
        let of_surface: Vec<&Entry> =
            entries.iter().filter(|entry| entry.key.surface == surface).collect();
        if of_surface.is_empty() {
            return Err(self.nothing_called(surface, &entries));
        }
        let what = format!("rename {surface} to {label}");
        self.relabel(&entries, &of_surface, label, what)
    }

    /// Gives trials another label; the name of a surface stands for all of its trials.
    ///
    /// # Errors
    /// As [`Editor::rename`].
    pub fn move_to(&mut self, names: &[String], label: &str) -> Result<Step, LibraryError> {
        let entries = trials(&self.root, &self.scene)?;
        let chosen = self.choose(&self.root, &entries, names)?;
        let what = format!("move {} to {label}", names.join(", "));
        self.relabel(&entries, &chosen, label, what)
    }

    fn relabel(
        &mut self,
        entries: &[Entry],
        chosen: &[&Entry],
        label: &str,
        what: String,
    ) -> Result<Step, LibraryError> {
        let label = &*normal(label);
        let gone = removed(&self.root, &self.scene)?;
        let mut plan = Plan::new(&self.root, [entries, &gone], &HashSet::new());
        for entry in chosen.iter().filter(|entry| entry.key.surface != label) {
            let wanted = TrialKey { surface: label.into(), ..entry.key.clone() };
            for place in self.places_of(entry)? {
                plan.rename(place, &entry.key, &wanted)?;
            }
        }
        self.take(what, plan.moves)
    }

    /// Removes trials; the name of a surface stands for all of its trials.
    ///
    /// # Errors
    /// As [`Editor::rename`].
    pub fn remove(&mut self, names: &[String]) -> Result<Step, LibraryError> {
        let entries = trials(&self.root, &self.scene)?;
        let mut plan = Plan::new(&self.root, [&[], &[]], &HashSet::new());
        for name in names {
            match self.choose(&self.root, &entries, std::slice::from_ref(name)) {
                Ok(chosen) => {
                    for entry in chosen {
                        let places = self.places_of(entry)?.into_iter();
                        places.for_each(|place| plan.remove(place, Some(&entry.key)));
                    }
                }
                // A trial that cannot be read can be removed all the same.
                Err(error) => match self.unreadable(&self.root, name) {
                    Some(folder) => plan.remove(&folder, None),
                    None => return Err(error),
                },
            }
        }
        self.take(format!("remove {}", names.join(", ")), plan.moves)
    }

    /// Restores removed trials; the name of a surface stands for all of its trials.
    ///
    /// # Errors
    /// As [`Editor::rename`].
    pub fn restore(&mut self, names: &[String]) -> Result<Step, LibraryError> {
        let bin = self.root.join(REMOVED);
        let (entries, gone) = (trials(&self.root, &self.scene)?, removed(&self.root, &self.scene)?);
        let (mut chosen, mut damaged) = (BTreeMap::new(), Vec::new());
        for name in names {
            match self.choose(&bin, &gone, std::slice::from_ref(name)) {
                Ok(found) => {
                    for entry in found {
                        let places = self.places_of(entry)?.into_iter();
                        chosen.extend(places.map(|place| (place.to_path_buf(), &entry.key)));
                    }
                }
                Err(error) => match self.unreadable(&bin, name) {
                    Some(folder) => damaged.push((folder, self.root.join(name))),
                    None => return Err(error),
                },
            }
        }
        let leaving = chosen.keys().cloned().collect();
        let mut plan = Plan::new(&self.root, [&entries, &gone], &leaving);
        for (place, key) in chosen {
            plan.rename(&place, key, key)?;
        }
        for (from, to) in damaged {
            plan.add(&from, to, None, None);
        }
        self.take(format!("restore {}", names.join(", ")), plan.moves)
    }

    /// Restores a removed trial under another name, as a step; `None` if it is not there. Includes
    /// trials that are not listed because they share their number with another removed one.
    fn bring_back(
        &mut self,
        gone: &str,
        key: &TrialKey,
        what: String,
    ) -> Result<Option<String>, LibraryError> {
        let folder = self.root.join(REMOVED).join(gone);
        let (entries, removed) =
            (trials(&self.root, &self.scene)?, removed(&self.root, &self.scene)?);
        let entry = removed.iter().find(|entry| entry.places() == [&*folder]);
        let surface = gone.split('/').next().unwrap_or_default();
        let was = match entry {
            Some(entry) => entry.key.clone(),
            None if folder.is_dir() => TrialKey { surface: surface.into(), ..key.clone() },
            None => return Ok(None),
        };
        let leaving = HashSet::from([folder.clone()]);
        let mut plan = Plan::new(&self.root, [&entries, &removed], &leaving);
        plan.rename(&folder, &was, &TrialKey { number: was.number, ..key.clone() })?;
        let step = self.take(what, plan.moves)?;
        Ok(step.moves.first().map(|one| one.to.clone()))
    }

    /// Undoes the last step. A trial whose former place is taken goes to a free one beside it.
    ///
    /// # Errors
    /// If there is none, or the file system refuses.
    pub fn undo(&mut self) -> Result<Undone, LibraryError> {
        let Some(last) = self.steps.last() else {
            return Err(LibraryError::file(&self.root, "there is no step to undo"));
        };
        let mut step = last.step.clone();
        let (entries, gone) = (trials(&self.root, &self.scene)?, removed(&self.root, &self.scene)?);
        let is_there = |one: &&Move| identity(&self.root.join(&one.to)).is_some();
        let (there, missing): (Vec<&Move>, Vec<&Move>) =
            step.moves.iter().rev().partition(is_there);
        let leaving = there.iter().map(|one| self.root.join(&one.to)).collect();
        let mut plan = Plan::new(&self.root, [&entries, &gone], &leaving);
        there.iter().for_each(|one| plan.reverse(one));
        let gone = missing.iter().map(|one| one.to.clone()).collect();
        let moves = plan.moves;
        let checked = moves.iter().try_for_each(|one| check(&self.root, one));
        if let Err(error) = checked.and_then(|()| self.steps.undo(moves.clone())) {
            tidy(&self.root, &moves);
            return Err(error);
        }
        let taken_back = self.settle(&moves, true)?;
        step.moves = moves;
        taken_back.map_or(Ok(Undone { step, gone }), Err)
    }

    /// The trials of these names: `SURFACE/TRIAL`, a file of it, or `SURFACE` for all of its
    /// trials.
    fn choose<'e>(
        &self,
        folder: &Path,
        entries: &'e [Entry],
        names: &[String],
    ) -> Result<Vec<&'e Entry>, LibraryError> {
        let (mut chosen, mut missing) = (Vec::new(), names.iter().collect::<BTreeSet<_>>());
        let wanted = missing.clone();
        for entry in entries {
            let places = entry.places().into_iter().map(|place| normal(&trial_name(folder, place)));
            let all: Vec<String> = places.chain([entry.key.surface.clone()]).collect();
            missing.retain(|name| !all.contains(&normal(name)));
            if wanted.iter().any(|name| all.contains(&normal(name))) {
                chosen.push(entry);
            }
        }
        missing.pop_first().map_or(Ok(chosen), |name| Err(self.nothing_called(name, entries)))
    }

    /// The folder of a trial, or its files, which edits move.
    fn places_of<'e>(&self, entry: &'e Entry) -> Result<Vec<&'e Path>, LibraryError> {
        let places = entry.places();
        match places.iter().find(|place| place.parent() == Some(&self.root)) {
            None => Ok(places),
            Some(file) => Err(LibraryError::file(
                file,
                "it lies in no folder of a surface; make one, named after the surface, and put it \
                 there",
            )),
        }
    }

    fn nothing_called(&self, name: &str, entries: &[Entry]) -> LibraryError {
        let mut surfaces: Vec<&str> = entries.iter().map(|e| e.key.surface.as_str()).collect();
        surfaces.dedup();
        let there = match surfaces.len() {
            0 => "there is none".to_string(),
            1..=12 => format!("surfaces: {}", surfaces.join(", ")),
            many => format!("there are {many} surfaces; `surfaced library list` names them"),
        };
        let problem = format!(
            "no surface or trial (SURFACE/TRIAL, SURFACE/FILE.wav) is called {name:?}; {there}"
        );
        LibraryError::file(&self.root, problem)
    }

    /// The folder or file of a trial that cannot be read.
    fn unreadable(&self, root: &Path, name: &str) -> Option<PathBuf> {
        let all = places(root).into_iter();
        let mut named =
            all.filter(|(surface, trial)| normal(&format!("{surface}/{trial}")) == normal(name));
        named.next().map(|(surface, trial)| root.join(surface).join(trial))
    }

    /// Writes a step into the list, and carries it out; a step that fails is undone.
    fn take(&mut self, what: String, moves: Vec<Move>) -> Result<Step, LibraryError> {
        let step = Step { what, at: utc(SystemTime::now()), moves };
        if step.moves.is_empty() {
            return Ok(step);
        }
        let checked = step.moves.iter().try_for_each(|one| check(&self.root, one));
        if let Err(error) = checked.and_then(|()| self.steps.begin(&step)) {
            tidy(&self.root, &step.moves);
            return Err(error);
        }
        self.settle(&step.moves, false)?.map_or(Ok(step), Err)
    }

    /// Carries out the moves of the last step, or those that undo it. If that fails, they are
    /// undone themselves, and the reason is returned.
    ///
    /// # Errors
    /// If they can be neither carried out nor undone; the next opening tries again.
    fn settle(
        &mut self,
        moves: &[Move],
        undoing: bool,
    ) -> Result<Option<LibraryError>, LibraryError> {
        let finished = carry_out(&self.root, moves).and_then(|()| match undoing {
            true => self.steps.undone(),
            false => self.steps.done(),
        });
        let error = finished.err();
        if let Some(error) = &error {
            let back: Vec<Move> = moves.iter().rev().map(Move::reversed).collect();
            carry_out(&self.root, &back).and_then(|()| self.steps.take_back(undoing)).map_err(
                |again| {
                    let problem = format!(
                        "{error}; it could not be taken back either: {again}. The next `surfaced \
                         library list` finishes it or takes it back"
                    );
                    LibraryError::file(&self.root, problem)
                },
            )?;
        }
        tidy(&self.root, moves);
        Ok(error)
    }
}

#[cfg(test)]
mod crashes;
#[cfg(test)]
mod tests;
