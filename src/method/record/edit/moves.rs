//! Plans how an edit moves trials, and moves them, forwards or back. Each trial gets a free path
//! and a free number. A call that was cut short may be repeated.

use std::collections::{BTreeSet, HashSet};
use std::fs;
use std::path::{Path, PathBuf};

use super::{Move, REMOVED, disk, trial_folder, trial_name};
use crate::library::files::{self, Listed, number_in};
use crate::library::{ABOUT_FILE, About, Entry, LibraryError};
use crate::record::{failed, folder_name};
use crate::system::identity;
use crate::trial::{EXPERT, TrialKey, normal};

/// The moves of trials that make up one edit, in order.
pub(super) struct Plan<'a> {
    root: &'a Path,
    /// The surface, user and number of all trials, including removed ones.
    taken: BTreeSet<TrialKey>,
    /// All paths from which or to which trials are moved.
    folders: HashSet<PathBuf>,
    pub moves: Vec<Move>,
}

impl<'a> Plan<'a> {
    /// An empty plan for a library, whose present and removed trials are `entries`. The trials at
    /// the paths in `leaving` are about to move, so their names and numbers are free.
    pub(super) fn new(root: &'a Path, entries: &[Vec<Entry>], leaving: &HashSet<PathBuf>) -> Self {
        let stays = |entry: &&Entry| !entry.places().iter().any(|place| leaving.contains(*place));
        let taken = entries.iter().flatten().filter(stays).map(|entry| entry.key.clone()).collect();
        Self { root, taken, folders: HashSet::new(), moves: Vec::new() }
    }

    /// Plans to give a folder's trial the name `wanted`, with another number if that one is taken.
    /// A trial that is a single file goes to the folder of the wanted surface, and keeps its file
    /// name; this fails if no folder can have the surface's name.
    pub(super) fn rename(
        &mut self,
        from: &Path,
        was: &TrialKey,
        wanted: &TrialKey,
    ) -> Result<(), LibraryError> {
        if from.is_file() {
            let folder = self.folder_of_label(from, &wanted.surface)?;
            let to = folder.join(from.file_name().unwrap_or_default());
            self.add(from, to, [Some(was.clone()), Some(wanted.clone())]);
            return Ok(());
        }
        let is = self.free_key(wanted);
        let to = trial_folder(self.root, &is);
        self.add(from, to, [Some(was.clone()), Some(is)]);
        Ok(())
    }

    /// Like [`Self::rename`], but leaves the folder where it is. Fails for a file, which has no `trial.toml`.
    pub(super) fn stay(
        &mut self,
        folder: &Path,
        was: &TrialKey,
        wanted: &TrialKey,
    ) -> Result<(), LibraryError> {
        if folder.is_file() {
            let problem = "this trial has no folder, and so no trial.toml that could say more of it; \
                           put it into a folder SURFACE/TRIAL of its own";
            return Err(LibraryError::file(folder, problem));
        }
        let is = self.free_key(wanted);
        self.add(folder, folder.to_path_buf(), [Some(was.clone()), Some(is)]);
        Ok(())
    }

    /// The folder for a label: an existing folder, as it is spelt on disk, or else a new one.
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

    /// Adds a move of a trial to the removed trials, unless the plan already moves the trial.
    pub(super) fn remove(&mut self, from: &Path, key: Option<&TrialKey>) {
        if !self.folders.contains(from) {
            let to = self.root.join(REMOVED).join(trial_name(self.root, from));
            self.add(from, to, [key.cloned(), key.cloned()]);
        }
    }

    /// Adds the reverse of a move. If the former place is taken, the trial goes beside it.
    pub(super) fn reverse(&mut self, one: &Move) {
        let (from, mut to) = (self.root.join(&one.to), self.root.join(&one.from));
        let keeps = one.from.starts_with(REMOVED) || from.is_file();
        let was = one.was.as_ref().map(|was| if keeps { was.clone() } else { self.free_key(was) });
        let moves = one.from != one.to;
        if let Some(key) = was.as_ref().filter(|key| moves && Some(*key) != one.was.as_ref()) {
            to = trial_folder(self.root, key);
        }
        self.add(&from, to, [one.is.clone(), was]);
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

    /// Adds a move to a path or, if it is taken, beside it, as `NAME-2`; a trial may stay where it is.
    pub(super) fn add(&mut self, from: &Path, to: PathBuf, [was, is]: [Option<TrialKey>; 2]) {
        let name = to.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let dot = name.rfind('.').filter(|_| from.is_file());
        let (stem, end) = name.split_at(dot.unwrap_or(name.len()));
        let mut free = to;
        for n in 2.. {
            if free == from || identity(&free).is_none() && !self.folders.contains(&free) {
                break;
            }
            free.set_file_name(format!("{stem}-{n}{end}"));
        }
        let (to, inode) = (trial_name(self.root, &free), identity(from));
        self.moves.push(Move { from: trial_name(self.root, from), to, was, is, inode });
        self.folders.extend([from.to_path_buf(), free]);
    }
}

/// Whether the trial of a move lies at its new path; `None` if it lies neither there nor at its old
/// path, where another trial may lie.
fn is_moved(from: &Path, to: &Path, one: &Move) -> Option<bool> {
    match (identity(from), identity(to)) {
        (there, _) if from == to => there.map(|_| true),
        (before, _) if before.is_some() && before == one.inode => Some(false),
        (_, after) if after.is_some() && after == one.inode => Some(true),
        // The inode differs, for example in a copy of the library. Then the existing path decides.
        (Some(_), None) => Some(false),
        (None, Some(_)) => Some(true),
        _ => None,
    }
}

fn unfinished(folder: &Path) -> PathBuf {
    folder.join(format!(".{ABOUT_FILE}.unfinished"))
}

/// The text for `trial.toml` that makes the trial in `now` read as `key` once it lies at `to`. `None`
/// if the text need not change, or if `now` is a file: a file's label is the name of its folder.
fn label(now: &Path, to: &Path, key: &TrialKey) -> Result<Option<String>, LibraryError> {
    if now.is_file() {
        return Ok(None);
    }
    let about = About::read(now)?;
    let name = |path: Option<&Path>| {
        path.and_then(Path::file_name).unwrap_or_default().to_string_lossy().into_owned()
    };
    let read = TrialKey {
        surface: about.surface.clone().unwrap_or_else(|| name(to.parent())),
        user: about.user.clone().unwrap_or_else(|| EXPERT.into()),
        number: about.trial.or_else(|| number_in(&name(Some(to)))).unwrap_or_default(),
        session: about.session.clone(),
    };
    if read == *key {
        return Ok(None);
    }
    let TrialKey { surface, user, number, session } = key.clone();
    let (surface, user, trial) = (Some(surface), Some(user), Some(number));
    let about = About { surface, user, trial, session, ..about };
    Ok(Some(about.to_toml()))
}

/// Creates the folder that a move leads to. Refuses to change the label in a folder behind a link.
pub(super) fn check(root: &Path, one: &Move) -> Result<(), LibraryError> {
    let (from, to) = (root.join(&one.from), root.join(&one.to));
    let parent = to.parent().unwrap_or(root);
    disk::create_folder(parent).map_err(|error| match error.kind() {
        std::io::ErrorKind::AlreadyExists | std::io::ErrorKind::NotADirectory => {
            let problem = "a file stands where the folder of the surface is to be; move it away, \
                           or choose another label";
            LibraryError::file(parent, problem)
        }
        _ => failed(parent, error),
    })?;
    if from.is_symlink()
        && let Some(key) = &one.is
        && label(&from, &to, key)?.is_some()
    {
        let problem = "it is a link, and its label stands in a folder elsewhere; give that trial \
                       its label there, or put the trial itself here";
        return Err(LibraryError::file(&from, problem));
    }
    Ok(())
}

/// Moves trials, and then writes their new keys into `trial.toml`. Skips finished moves and missing
/// trials, so that a call that was cut short may be repeated.
pub(super) fn carry_out(root: &Path, moves: &[Move]) -> Result<(), LibraryError> {
    let ends = |one: &Move| (root.join(&one.from), root.join(&one.to));
    for one in moves {
        let (from, to) = ends(one);
        if is_moved(&from, &to, one) == Some(false) {
            let parent = to.parent().unwrap_or(root);
            disk::create_folder(parent)
                .and_then(|()| disk::move_to(&from, &to))
                .map_err(|error| refused(&from, &to, error))?;
        }
        if to.is_symlink() && !to.exists() {
            relink(one, &to).map_err(|error| failed(&to, error))?;
        }
    }
    let mut labels = Vec::new();
    for one in moves {
        let (from, to) = ends(one);
        let is_there = is_moved(&from, &to, one) == Some(true);
        let Some(key) = one.is.as_ref().filter(|_| is_there) else { continue };
        let unfinished = unfinished(&to);
        match label(&to, &to, key)? {
            Some(text) => labels.push((unfinished, to, text)),
            // Removes a file that a call that was cut short may have left.
            None => disk::remove_file(&unfinished),
        }
    }
    for (unfinished, _, text) in &labels {
        disk::write(unfinished, text.as_bytes()).map_err(|error| failed(unfinished, error))?;
    }
    if !labels.is_empty() {
        // Waits until the disk holds the new files, so that a power failure leaves no empty ones.
        disk::sync_all(root).map_err(|error| failed(root, error))?;
    }
    for (unfinished, to, _) in &labels {
        disk::rename(unfinished, &to.join(ABOUT_FILE)).map_err(|error| failed(to, error))?;
    }
    disk::sync_all(root).map_err(|error| failed(root, error))
}

fn refused(from: &Path, to: &Path, error: std::io::Error) -> LibraryError {
    match error.kind() {
        std::io::ErrorKind::CrossesDevices => LibraryError::file(
            from,
            "its surface lies on another disk than the library, and trials are not moved between \
             disks; move the surface's folder into the library first",
        ),
        _ => failed(to, error),
    }
}

/// Rewrites a relative link that was moved to another depth, so that it still leads to its target.
fn relink(one: &Move, link: &Path) -> std::io::Result<()> {
    let text = fs::read_link(link)?;
    let is_removed = |name: &str| name.starts_with(REMOVED);
    let target = match (is_removed(&one.from), is_removed(&one.to)) {
        (false, true) => Path::new("..").join(&text),
        (true, false) => text.strip_prefix("..").map_or(text.clone(), Path::to_path_buf),
        _ => return Ok(()),
    };
    let unfinished = link.with_file_name(".link.unfinished");
    disk::remove_file(&unfinished);
    disk::link(&target, &unfinished)?;
    disk::rename(&unfinished, link)
}

/// Removes leftovers of moves: unfinished files for `trial.toml`, and empty folders of surfaces.
pub(super) fn tidy(root: &Path, moves: &[Move]) {
    for name in moves.iter().flat_map(|one| [&one.from, &one.to]) {
        let folder = root.join(name);
        disk::remove_file(&unfinished(&folder));
        disk::remove_empty_folder(folder.parent().unwrap_or(root));
    }
}
