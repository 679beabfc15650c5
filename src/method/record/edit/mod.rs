//! Edits a library on disk: gives trials another label, removes trials, or restores them. Each edit
//! can be undone.
//!
//! A removed trial lies complete in `LIBRARY/.removed/SURFACE/TRIAL`, which readers skip.
//! `LIBRARY/.removed/steps.jsonl` lists the edits. The last edit can be undone, and an edit that a
//! crash cut short is finished when the library is next opened. No trial moves while a program
//! reads the library ([`LibraryLock`]).

mod disk;
mod list;
mod moves;
mod steps;

pub use list::{ListedTrial, list, list_removed};
#[doc(hidden)]
pub use list::{notes_of, numbers_after, trial_name, trial_of_note, trials_by_note};
pub use steps::{Move, Step, last_step};

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use self::list::{places, removed, trials};
use self::moves::{Plan, carry_out, check, tidy};
use self::steps::{StepLine, Steps};
use super::{TrialOptions, append_trial, trial_folder};
use crate::library::{Entry, LibraryError};
use crate::scene::Scene;
use crate::system::{Locked, identity, lock_holder, open_lock};
use crate::trial::{Trial, TrialKey, normal};

/// Name of the folder of removed trials, in the library's folder.
pub(super) const REMOVED: &str = ".removed";

/// A library that is locked for editing: no program reads it meanwhile.
///
/// In the `names` that edits take, a surface stands for all of its trials. An edit fails if there is no
/// such trial or surface, or if the file system refuses. It then leaves the library unchanged, unless
/// the error says that the edit could not be undone.
pub struct Editor {
    root: PathBuf,
    scene: Scene,
    steps: Steps,
    _lock: LibraryLock,
}

/// Writes a trial into a library as a step that can be undone, and returns its name
/// `SURFACE/TRIAL`. The trial gets the next number that no trial has, present or removed. If a
/// trial with the same notes exists, nothing is written: that trial stays, or is restored.
pub fn keep(
    library: &Path,
    scene: &Scene,
    mut trial: Trial,
    options: &TrialOptions,
    what: String,
) -> Result<String, LibraryError> {
    // Locks the library, so that no trial moves during the search for the notes.
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
    let of = (trial.key.surface.clone(), trial.key.user.clone());
    trial.key.number = numbers_after(library, scene)?.remove(&of).unwrap_or(1);
    let (number, folder) = append_trial(library, &trial, scene, options)?;
    let to = trial_name(library, &folder);
    let key = Some(TrialKey { number, ..trial.key });
    // The recorded move starts in the removed trials, so that undoing it removes the trial.
    let from = format!("{REMOVED}/{to}");
    let moves = vec![Move { from, to: to.clone(), was: key.clone(), is: key, inode: None }];
    editor.steps.add([StepLine::Began(Step::now(what, moves)), StepLine::Done])?;
    Ok(to)
}

impl Editor {
    /// Waits until no program reads a library, locks it, and finishes an edit that was cut short.
    ///
    /// # Errors
    /// If there is no such library, other programs read it all the time, or an edit that was cut
    /// short can be neither finished nor taken back.
    pub fn open(library: &Path, scene: &Scene) -> Result<Self, LibraryError> {
        let lock = LibraryLock::for_editing(library)?;
        let (root, steps) = (library.to_path_buf(), Steps::open(library)?);
        let mut editor = Self { root, scene: scene.clone(), steps, _lock: lock };
        editor.finish_left()?;
        Ok(editor)
    }

    fn finish_left(&mut self) -> Result<(), LibraryError> {
        let Some(last) = self.steps.known.last() else { return Ok(()) };
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
    pub fn rename(&mut self, surface: &str, label: &str) -> Result<Step, LibraryError> {
        let surface = &*normal(surface);
        let all = self.entries()?;
        let of_surface: Vec<&Entry> =
            all[0].iter().filter(|entry| entry.key.surface == surface).collect();
        if of_surface.is_empty() {
            return Err(self.nothing_called(surface, &all[0]));
        }
        self.relabel(&all, &of_surface, label, format!("rename {surface} to {label}"))
    }

    /// Gives trials another label.
    pub fn move_to(&mut self, names: &[String], label: &str) -> Result<Step, LibraryError> {
        let all = self.entries()?;
        let chosen = self.choose(&self.root, &all[0], names)?;
        self.relabel(&all, &chosen, label, format!("move {} to {label}", names.join(", ")))
    }

    fn relabel(
        &mut self,
        all: &[Vec<Entry>; 2],
        chosen: &[&Entry],
        label: &str,
        what: String,
    ) -> Result<Step, LibraryError> {
        let label = &*normal(label);
        let mut plan = Plan::new(&self.root, all, &HashSet::new());
        for entry in chosen.iter().filter(|entry| entry.key.surface != label) {
            let wanted = TrialKey { surface: label.into(), ..entry.key.clone() };
            for place in self.places_of(entry)? {
                plan.rename(place, &entry.key, &wanted)?;
            }
        }
        self.take(what, plan.moves)
    }

    /// Gives trials another session, or none. Fails, too, if one has no folder and so no `trial.toml`.
    pub fn set_session(
        &mut self,
        names: &[String],
        session: Option<&str>,
    ) -> Result<Step, LibraryError> {
        let all = self.entries()?;
        let mut chosen = self.choose(&self.root, &all[0], names)?;
        chosen.retain(|entry| entry.key.session.as_deref() != session);
        let leaving = chosen.iter().flat_map(|entry| entry.places()).map(Path::to_path_buf);
        let mut plan = Plan::new(&self.root, &all, &leaving.collect());
        for entry in chosen {
            let wanted = entry.key.clone().with_session(session.map(String::from));
            for place in entry.places() {
                plan.stay(place, &entry.key, &wanted)?;
            }
        }
        let to = session.map_or("none".to_string(), |session| format!("`{session}`"));
        self.take(format!("set the session of {} to {to}", names.join(", ")), plan.moves)
    }

    pub fn remove(&mut self, names: &[String]) -> Result<Step, LibraryError> {
        let entries = trials(&self.root, &self.scene)?;
        let mut plan = Plan::new(&self.root, &[], &HashSet::new());
        for name in names {
            let places = self.all_places(&self.root, &entries, name)?;
            places.iter().for_each(|(place, key)| plan.remove(place, *key));
        }
        self.take(format!("remove {}", names.join(", ")), plan.moves)
    }

    pub fn restore(&mut self, names: &[String]) -> Result<Step, LibraryError> {
        let bin = self.root.join(REMOVED);
        let all = self.entries()?;
        let mut chosen = BTreeMap::new();
        for name in names {
            chosen.extend(self.all_places(&bin, &all[1], name)?);
        }
        let leaving = chosen.keys().cloned().collect();
        let mut plan = Plan::new(&self.root, &all, &leaving);
        for (place, key) in chosen {
            match key {
                Some(key) => plan.rename(&place, key, key)?,
                None => plan.add(&place, self.root.join(trial_name(&bin, &place)), [None, None]),
            }
        }
        self.take(format!("restore {}", names.join(", ")), plan.moves)
    }

    /// Restores the removed trial `gone` as `key`, as a step; `None` if there is no such trial.
    /// Also finds a trial that is not listed, since another removed trial has its number.
    fn bring_back(
        &mut self,
        gone: &str,
        key: &TrialKey,
        what: String,
    ) -> Result<Option<String>, LibraryError> {
        let folder = self.root.join(REMOVED).join(gone);
        let all = self.entries()?;
        let entry = all[1].iter().find(|entry| entry.places() == [&*folder]);
        let surface = gone.split('/').next().unwrap_or_default();
        let was = match entry {
            Some(entry) => entry.key.clone(),
            None if folder.is_dir() => TrialKey { surface: surface.into(), ..key.clone() },
            None => return Ok(None),
        };
        let leaving = HashSet::from([folder.clone()]);
        let mut plan = Plan::new(&self.root, &all, &leaving);
        plan.rename(&folder, &was, &TrialKey { number: was.number, ..key.clone() })?;
        let step = self.take(what, plan.moves)?;
        Ok(step.moves.first().map(|one| one.to.clone()))
    }

    /// Undoes the last step, and returns it with the moves that undid it. If the former place of a
    /// trial is taken, the trial goes to a free place beside it. Fails, too, if there is no step to undo.
    pub fn undo(&mut self) -> Result<Step, LibraryError> {
        let Some(last) = self.steps.known.last() else {
            return Err(LibraryError::file(&self.root, "there is no step to undo"));
        };
        let mut step = last.step.clone();
        let all = self.entries()?;
        let is_there = |one: &&Move| identity(&self.root.join(&one.to)).is_some();
        let (there, missing): (Vec<_>, Vec<_>) = step.moves.iter().rev().partition(is_there);
        let leaving = there.iter().map(|one| self.root.join(&one.to)).collect();
        let mut plan = Plan::new(&self.root, &all, &leaving);
        there.iter().for_each(|one| plan.reverse(one));
        step.gone = Some(missing.iter().map(|one| one.to.clone()).collect());
        step.moves = plan.moves;
        self.begin(StepLine::Undoing(step.moves.clone()), &step.moves)?;
        Ok(step)
    }

    /// The present trials that can be read, and the removed ones.
    fn entries(&self) -> Result<[Vec<Entry>; 2], LibraryError> {
        Ok([trials(&self.root, &self.scene)?, removed(&self.root, &self.scene)?])
    }

    /// The trials that `names` (`SURFACE/TRIAL`, a file of a trial, or `SURFACE`) select.
    fn choose<'e>(
        &self,
        folder: &Path,
        entries: &'e [Entry],
        names: &[String],
    ) -> Result<Vec<&'e Entry>, LibraryError> {
        let wanted: BTreeSet<String> = names.iter().map(|name| normal(name)).collect();
        let (mut chosen, mut missing) = (Vec::new(), wanted.clone());
        for entry in entries {
            let places = entry.places().into_iter().map(|place| normal(&trial_name(folder, place)));
            let mut all: Vec<String> = places.chain([entry.key.surface.clone()]).collect();
            all.retain(|name| wanted.contains(name));
            if !all.is_empty() {
                missing.retain(|name| !all.contains(name));
                chosen.push(entry);
            }
        }
        missing.pop_first().map_or(Ok(chosen), |name| Err(self.nothing_called(&name, entries)))
    }

    /// The folders or files of all trials that `name` selects, each with the trial's key (label,
    /// user and number), which is `None` for a trial that cannot be read.
    fn all_places<'e>(
        &self,
        folder: &Path,
        entries: &'e [Entry],
        name: &str,
    ) -> Result<Vec<(PathBuf, Option<&'e TrialKey>)>, LibraryError> {
        let chosen = match self.choose(folder, entries, &[name.to_string()]) {
            Ok(chosen) => chosen,
            Err(error) => {
                // The folder or file of a trial that cannot be read.
                let all = places(folder).into_iter();
                let mut all = all.map(|(surface, trial)| format!("{surface}/{trial}"));
                let there = all.find(|there| normal(there) == normal(name)).ok_or(error)?;
                return Ok(vec![(folder.join(there), None)]);
            }
        };
        let mut all = Vec::new();
        for entry in chosen {
            let places = self.places_of(entry)?.into_iter();
            all.extend(places.map(|place| (place.to_path_buf(), Some(&entry.key))));
        }
        Ok(all)
    }

    /// The trial's folder or files, to be moved by an edit. Refuses a file in no surface's folder.
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

    /// Adds an edit, if it moves anything, to the list of steps, and carries it out.
    fn take(&mut self, what: String, moves: Vec<Move>) -> Result<Step, LibraryError> {
        let step = Step::now(what, moves);
        if !step.moves.is_empty() {
            self.begin(StepLine::Began(step.clone()), &step.moves)?;
        }
        Ok(step)
    }

    /// Adds the line with which `moves` begin, and carries them out. If one fails, all are taken back.
    fn begin(&mut self, line: StepLine, moves: &[Move]) -> Result<(), LibraryError> {
        let undoing = matches!(line, StepLine::Undoing(_));
        let checked = moves.iter().try_for_each(|one| check(&self.root, one));
        if let Err(error) = checked.and_then(|()| self.steps.add([line])) {
            tidy(&self.root, moves);
            return Err(error);
        }
        self.settle(moves, undoing)?.map_or(Ok(()), Err)
    }

    /// Carries out `moves`: those of the last step or, with `undoing`, those that undo the step. If
    /// a move fails, takes all moves back, and returns the reason as `Some`. Returns an error if
    /// the moves can be neither carried out nor taken back; then the next opening tries again.
    fn settle(
        &mut self,
        moves: &[Move],
        undoing: bool,
    ) -> Result<Option<LibraryError>, LibraryError> {
        let (carried_out, taken_back) = match undoing {
            true => (StepLine::Undone, StepLine::Done),
            false => (StepLine::Done, StepLine::Undone),
        };
        let error = carry_out(&self.root, moves).and_then(|()| self.steps.add([carried_out])).err();
        if let Some(error) = &error {
            let back: Vec<Move> = moves.iter().rev().map(Move::reversed).collect();
            let done = carry_out(&self.root, &back).and_then(|()| self.steps.add([taken_back]));
            done.map_err(|again| {
                let problem = format!(
                    "{error}; it could not be taken back either: {again}. The next `surfaced library \
                     list` finishes it or takes it back"
                );
                LibraryError::file(&self.root, problem)
            })?;
        }
        tidy(&self.root, moves);
        Ok(error)
    }
}

/// How long an edit waits for programs that read the library. A browser waits longer for a reply.
const PATIENCE: Duration = Duration::from_secs(8);
/// How long a program waits for a lock before it logs which program holds it.
const SILENT: Duration = Duration::from_secs(1);
/// Time between two attempts to get a lock.
const PAUSE: Duration = Duration::from_millis(50);

/// A lock on a library, held until it is dropped. Many readers or one editor may hold it at a time.
/// The operating system releases the lock when the process ends.
#[derive(Debug)]
pub struct LibraryLock(#[expect(dead_code, reason = "held for its lock alone")] Option<Locked>);

impl LibraryLock {
    /// Finishes an edit that was cut short, and prevents edits until the lock is dropped. Takes no
    /// lock where nobody can edit: in a read-only library, or without locks on the file system.
    pub fn for_reading(library: &Path) -> Self {
        // An unreadable list counts as finished here; the commands that need the list report it.
        let is_left = || {
            steps::read(library)
                .is_ok_and(|(all, _)| all.last().is_some_and(|last| last.left().is_some()))
        };
        if is_left()
            // Opening an editor finishes the edit.
            && let Err(error) = Editor::open(library, &Scene::lmt108()).map(drop)
        {
            tracing::warn!(
                "{}: an edit of it was cut short, and cannot be finished now: {error}. Until then \
                 some trials may stand under a wrong label; `surfaced library list` tries again",
                library.display()
            );
        }
        Self(open_lock(library).ok().filter(|file| wait(file, library, None).is_ok()).map(Locked))
    }

    /// Waits until no program reads the library, and keeps readers out until the lock is dropped.
    ///
    /// # Errors
    /// If other programs read the library all the time, or its file system has no locks.
    pub fn for_editing(library: &Path) -> Result<Self, LibraryError> {
        let file = open_lock(library).map_err(|error| LibraryError::io(library, error))?;
        let problem = match wait(&file, library, Some(PATIENCE)) {
            Ok(()) => return Ok(Self(Some(Locked(file)))),
            Err(TryLockError::WouldBlock) => {
                let who = holder_of(&file);
                format!(
                    "{who} is reading it, and has not stopped in time; try again when it has ended"
                )
            }
            Err(TryLockError::Error(error)) => format!(
                "it cannot be locked, so programs that read it might see half an edit ({error}); \
                 edit it on a file system that has locks"
            ),
        };
        Err(LibraryError::file(library, problem))
    }
}

fn holder_of(file: &File) -> String {
    lock_holder(file).unwrap_or_else(|| "another program".into())
}

/// Waits for the lock: an editor at most for `patience`; a reader, with `None`, for any time. Fails
/// if the patience ends, or if the file system has no locks.
fn wait(file: &File, library: &Path, patience: Option<Duration>) -> Result<(), TryLockError> {
    let (begin, mut is_said) = (Instant::now(), false);
    loop {
        let lock = if patience.is_some() { file.try_lock() } else { file.try_lock_shared() };
        let waited = begin.elapsed();
        match lock {
            Err(TryLockError::WouldBlock) if patience.is_none_or(|longest| waited <= longest) => {}
            done => return done,
        }
        if waited > SILENT && !is_said {
            is_said = true;
            let does = if patience.is_some() { "reads" } else { "edits" };
            let who = holder_of(file);
            tracing::info!("{}: waiting for {who}, which {does} it", library.display());
        }
        std::thread::sleep(PAUSE);
    }
}

#[cfg(test)]
#[path = "../../../../tests/common/edited.rs"]
mod edited;
#[cfg(test)]
mod tests;
