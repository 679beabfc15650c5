//! Plans the moves of a step: each trial gets a free path and a free number, none of them twice.

use std::collections::{BTreeSet, HashSet};
use std::path::{Path, PathBuf};

use super::{Move, REMOVED, trial_folder, trial_name};
use crate::library::files::{self, Listed};
use crate::library::{Entry, LibraryError};
use crate::record::folder_name;
use crate::system::identity;
use crate::trial::{TrialKey, normal};

/// The moves of a step, in order.
pub(super) struct Plan<'a> {
    root: &'a Path,
    /// The names of all trials, including removed ones.
    taken: BTreeSet<TrialKey>,
    /// Paths on either side of a move.
    folders: HashSet<PathBuf>,
    pub moves: Vec<Move>,
}

impl<'a> Plan<'a> {
    /// A plan for a library with these trials, present and removed; the names of those that lie at
    /// `leaving` become free.
    pub fn new(root: &'a Path, entries: [&[Entry]; 2], leaving: &HashSet<PathBuf>) -> Self {
        let stays = |entry: &&Entry| !entry.places().iter().any(|place| leaving.contains(*place));
        let staying = entries.into_iter().flatten().filter(stays);
        let taken = staying.map(|entry| entry.key.clone()).collect();
        Self { root, taken, folders: HashSet::new(), moves: Vec::new() }
    }

    /// Gives a trial another name, with the same number if that is free. A trial that is a file
    /// goes to the folder of the surface, and keeps its file name.
    ///
    /// # Errors
    /// If a file would need a folder named after a label that no folder can have.
    pub fn rename(
        &mut self,
        from: &Path,
        was: &TrialKey,
        wanted: &TrialKey,
    ) -> Result<(), LibraryError> {
        if from.is_file() {
            let folder = self.folder_of_label(from, &wanted.surface)?;
            let to = folder.join(from.file_name().unwrap_or_default());
            self.add(from, to, Some(was.clone()), Some(wanted.clone()));
            return Ok(());
        }
        let is = self.free_key(wanted);
        let to = trial_folder(self.root, &is);
        self.add(from, to, Some(was.clone()), Some(is));
        Ok(())
    }

    /// The folder named after a label: the existing one as spelt on disk, or else a new one.
    fn folder_of_label(&self, file: &Path, label: &str) -> Result<PathBuf, LibraryError> {
        let there = files::list(self.root)?.into_iter();
        let same = |item: &Listed| item.is_dir && !item.is_hidden() && normal(&item.name) == label;
        match there.filter(same).map(|item| item.path).next() {
            Some(folder) => Ok(folder),
            None if folder_name::is_usable(label) => Ok(self.root.join(label)),
            None => {
                let problem = format!(
                    "this file takes its label from its folder, and no folder can be called \
                     {label:?}; choose another label"
                );
                Err(LibraryError::file(file, problem))
            }
        }
    }

    /// Moves a trial to the removed ones, unless the step moves it already.
    pub fn remove(&mut self, from: &Path, key: Option<&TrialKey>) {
        if !self.folders.contains(from) {
            let to = self.root.join(REMOVED).join(trial_name(self.root, from));
            self.add(from, to, key.cloned(), key.cloned());
        }
    }

    /// Moves a trial back to where a move took it from, or beside that if the place is taken.
    pub fn reverse(&mut self, one: &Move) {
        let (from, mut to) = (self.root.join(&one.to), self.root.join(&one.from));
        let keeps = one.from.starts_with(REMOVED) || from.is_file();
        let was = one.was.as_ref().map(|was| match keeps {
            true => was.clone(),
            false => self.free_key(was),
        });
        if let Some(key) = was.as_ref().filter(|key| Some(*key) != one.was.as_ref()) {
            to = trial_folder(self.root, key);
        }
        self.add(&from, to, one.is.clone(), was);
    }

    fn free_key(&mut self, wanted: &TrialKey) -> TrialKey {
        let mut key = wanted.clone();
        if self.taken.contains(&key) {
            let all = TrialKey { number: 0, ..key.clone() }..=TrialKey { number: u32::MAX, ..key };
            let highest = self.taken.range(all).next_back().map_or(0, |key| key.number);
            key = TrialKey { number: highest.saturating_add(1), ..wanted.clone() };
        }
        self.taken.insert(key.clone());
        key
    }

    /// Moves a trial to a path, or, if that is taken, to one beside it.
    pub fn add(&mut self, from: &Path, to: PathBuf, was: Option<TrialKey>, is: Option<TrialKey>) {
        let is_file = from.is_file();
        let part = |part: Option<&std::ffi::OsStr>| {
            part.unwrap_or_default().to_string_lossy().into_owned()
        };
        let (stem, end) = match to.extension().filter(|_| is_file) {
            Some(extension) => (part(to.file_stem()), format!(".{}", part(Some(extension)))),
            None => (part(to.file_name()), String::new()),
        };
        let mut free = to;
        for n in 2.. {
            if identity(&free).is_none() && !self.folders.contains(&free) {
                break;
            }
            free.set_file_name(format!("{stem}-{n}{end}"));
        }
        let (to, inode) = (trial_name(self.root, &free), identity(from));
        self.moves.push(Move { from: trial_name(self.root, from), to, was, is, inode });
        self.folders.extend([from.to_path_buf(), free]);
    }
}
