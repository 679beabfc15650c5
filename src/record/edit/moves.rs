//! Carries out the moves of a step, forwards or back; a call that was cut short may be repeated.

use std::fs;
use std::path::{Path, PathBuf};

use super::{Move, REMOVED, disk};
use crate::library::recording::number_in;
use crate::library::{ABOUT_FILE, About, LibraryError};
use crate::record::failed;
use crate::system::identity;
use crate::trial::{EXPERT, TrialKey};

/// The place of a move's trial.
#[derive(PartialEq)]
enum Place {
    Before,
    After,
    /// In neither place; another trial may have taken them.
    Gone,
}

fn place(from: &Path, to: &Path, one: &Move) -> Place {
    match (identity(from), identity(to)) {
        (before, _) if before.is_some() && before == one.inode => Place::Before,
        (_, after) if after.is_some() && after == one.inode => Place::After,
        // The inode is another one, for example in a copy of the library.
        (Some(_), None) => Place::Before,
        (None, Some(_)) => Place::After,
        _ => Place::Gone,
    }
}

fn unfinished(folder: &Path) -> PathBuf {
    folder.join(format!(".{ABOUT_FILE}.unfinished"))
}

/// The new text of `trial.toml` of a trial that lies at `now` and is to be `key` at `to`; `None` if
/// it stays the same, or if the trial is a file, which has its label from its folder.
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
    };
    if read == *key {
        return Ok(None);
    }
    let TrialKey { surface, user, number } = key.clone();
    let about = About { surface: Some(surface), user: Some(user), trial: Some(number), ..about };
    Ok(Some(about.to_toml()))
}

/// Creates the folder that a move goes to; refuses a move that would change a file behind a link.
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

/// Moves trials, and then writes their names. Skips what is done already and trials that are gone,
/// so that a call that was cut short may be repeated.
pub(super) fn carry_out(root: &Path, moves: &[Move]) -> Result<(), LibraryError> {
    let ends = |one: &Move| (root.join(&one.from), root.join(&one.to));
    for one in moves {
        let (from, to) = ends(one);
        if place(&from, &to, one) == Place::Before {
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
        let is_there = place(&from, &to, one) == Place::After;
        let Some(key) = one.is.as_ref().filter(|_| is_there) else { continue };
        let unfinished = unfinished(&to);
        match label(&to, &to, key)? {
            Some(text) => labels.push((unfinished, to, text)),
            // Left by a call that was cut short.
            None => drop(fs::remove_file(&unfinished)),
        }
    }
    for (unfinished, _, text) in &labels {
        disk::write(unfinished, text.as_bytes()).map_err(|error| failed(unfinished, error))?;
    }
    if !labels.is_empty() {
        // Otherwise a power failure might leave empty files.
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

/// Makes a relative link point to the same folder from another depth.
fn relink(one: &Move, link: &Path) -> std::io::Result<()> {
    let text = fs::read_link(link)?;
    let is_removed = |name: &str| name.starts_with(REMOVED);
    let target = match (is_removed(&one.from), is_removed(&one.to)) {
        (false, true) => Path::new("..").join(&text),
        (true, false) => text.strip_prefix("..").map_or(text.clone(), Path::to_path_buf),
        _ => return Ok(()),
    };
    let unfinished = link.with_file_name(".link.unfinished");
    let _ = fs::remove_file(&unfinished);
    disk::link(&target, &unfinished)?;
    disk::rename(&unfinished, link)
}

/// Removes what moves may have left: labels that were not used, and the folders of surfaces without
/// trials.
pub(super) fn tidy(root: &Path, moves: &[Move]) {
    for name in moves.iter().flat_map(|one| [&one.from, &one.to]) {
        let folder = root.join(name);
        let _ = fs::remove_file(unfinished(&folder));
        // A folder that holds anything stays.
        let _ = fs::remove_dir(folder.parent().unwrap_or(root));
    }
}
