//! Which folder and which number each trial of a step gets: free ones, and none twice.

use std::collections::{BTreeSet, HashSet};
use std::path::{Path, PathBuf};

use super::moves::inode;
use super::{Move, REMOVED, trial_folder, trial_name};
use crate::library::Entry;
use crate::trial::TrialKey;

/// The moves of a step, one after the other.
pub(super) struct Plan<'a> {
    root: &'a Path,
    /// The names that trials have, also removed ones.
    taken: BTreeSet<TrialKey>,
    /// Folders on either side of a move.
    folders: HashSet<PathBuf>,
    pub moves: Vec<Move>,
}

impl<'a> Plan<'a> {
    /// A step of a library with these trials, there and removed; those in the folders `leaving` give
    /// their names back.
    pub fn new(root: &'a Path, entries: [&[Entry]; 2], leaving: &HashSet<PathBuf>) -> Self {
        let stays = |entry: &&Entry| entry.folder().is_none_or(|folder| !leaving.contains(folder));
        let staying = entries.into_iter().flatten().filter(stays);
        let taken = staying.map(|entry| entry.key.clone()).collect();
        Self { root, taken, folders: HashSet::new(), moves: Vec::new() }
    }

    /// Gives a trial another name, with the same number if that is free.
    pub fn rename(&mut self, from: &Path, was: &TrialKey, wanted: &TrialKey) {
        let is = self.free_key(wanted);
        let to = trial_folder(self.root, &is);
        self.add(from, to, Some(was.clone()), Some(is));
    }

    /// Moves a trial among those that were removed, unless it is on its way already.
    pub fn remove(&mut self, from: &Path, key: Option<&TrialKey>) {
        if !self.folders.contains(from) {
            let to = self.root.join(REMOVED).join(trial_name(self.root, from));
            self.add(from, to, key.cloned(), key.cloned());
        }
    }

    /// Moves a trial back to where a move took it from, or beside that.
    pub fn reverse(&mut self, one: &Move) {
        let (from, mut to) = (self.root.join(&one.to), self.root.join(&one.from));
        let is_removed = one.from.starts_with(REMOVED);
        let was = one.was.as_ref().map(|was| match is_removed {
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

    /// Moves a trial to a folder, or to one beside it where that is taken.
    pub fn add(&mut self, from: &Path, to: PathBuf, was: Option<TrialKey>, is: Option<TrialKey>) {
        let name = to.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let mut free = to;
        for n in 2.. {
            if inode(&free).is_none() && !self.folders.contains(&free) {
                break;
            }
            free.set_file_name(format!("{name}-{n}"));
        }
        let (to, inode) = (trial_name(self.root, &free), inode(from));
        self.moves.push(Move { from: trial_name(self.root, from), to, was, is, inode });
        self.folders.extend([from.to_path_buf(), free]);
    }
}
