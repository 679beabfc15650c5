//! The files of a recording: what they are called in an MCAP file, and where they lie.

use std::path::{Component, Path, PathBuf};

use crate::library::LibraryError;
use crate::library::files::{self, Listed};
use crate::library::recording::DESCRIPTION;

/// Most parts of a file's path below its library: those of LMT108.
const DEEPEST: usize = 6;

/// Whether a folder is a single trial, which holds files alone. A library holds folders, with or
/// without files beside them.
pub fn is_trial(recording: &Path) -> Result<bool, LibraryError> {
    Ok(!visible(recording)?.iter().any(|item| item.is_dir))
}

/// The files of a recording: names relative to its library, and paths.
///
/// # Errors
/// If a folder cannot be read, or a link leads out of the recording.
pub fn files(recording: &Path) -> Result<Vec<(String, PathBuf)>, LibraryError> {
    let root = recording.canonicalize().map_err(|error| LibraryError::io(recording, error))?;
    let mut all = Vec::new();
    if !is_trial(&root)? {
        below(&root, &root, &mut all)?;
        return Ok(all);
    }
    // The names of a single trial's files begin with `SURFACE/TRIAL`, too.
    let library = root.ancestors().nth(2).unwrap_or(&root);
    let description = library.join(DESCRIPTION);
    if description.is_file() {
        all.push((DESCRIPTION.into(), inside(&description, library)?));
    }
    below(&root, library, &mut all)?;
    Ok(all)
}

fn below(folder: &Path, root: &Path, all: &mut Vec<(String, PathBuf)>) -> Result<(), LibraryError> {
    for item in visible(folder)? {
        let name = item.path.strip_prefix(root).unwrap_or(&item.path);
        if item.is_dir && name.iter().count() < DEEPEST {
            inside(&item.path, root)?;
            below(&item.path, root, all)?;
        } else if !item.is_dir && item.unusable.is_none() {
            let name: Vec<_> = name.iter().map(|part| part.to_string_lossy()).collect();
            all.extend(within(&name.join("/")).map(|_| (name.join("/"), item.path.clone())));
            inside(&item.path, root)?;
        }
    }
    Ok(())
}

/// Passes on a path unless a link in it leads out of `root`, to files that nobody meant to share.
fn inside(path: &Path, root: &Path) -> Result<PathBuf, LibraryError> {
    let real = path.canonicalize().map_err(|error| LibraryError::io(path, error))?;
    match real.starts_with(root) {
        true => Ok(path.to_path_buf()),
        false => Err(LibraryError::file(
            path,
            format!("a link that leads out of the recording, to {}; copy it in", real.display()),
        )),
    }
}

fn visible(dir: &Path) -> Result<Vec<Listed>, LibraryError> {
    Ok(files::list(dir)?.into_iter().filter(|item| !item.is_hidden()).collect())
}

/// The path for the name of an attached file, if it lies within a recording: `library.toml` or a
/// `.mat` list beside the folders, or a file within them.
pub fn within(name: &str) -> Option<PathBuf> {
    let path = Path::new(name);
    let plain = |part: Component<'_>| match part {
        Component::Normal(part) => part.to_str().is_some_and(|part| !part.starts_with('.')),
        _ => false,
    };
    let fits = match path.components().count() {
        1 => name == DESCRIPTION || name.ends_with(".mat"),
        parts => (2..=DEEPEST).contains(&parts),
    };
    let odd = name.contains(['\\', '\0']) || name.split('/').any(|part| matches!(part, "" | "."));
    (fits && !odd && path.components().all(plain)).then(|| path.to_path_buf())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_recordings_own_files_come_back() {
        for name in [
            "library.toml",
            "oak/trial1/mi2.wav",
            "a b/é-01/trial.toml",
            "SoundScans/Movement/Training/a.wav",
            "surfaceList_LMT108train.mat",
        ] {
            assert_eq!(within(name), Some(name.into()));
        }
        for name in [
            "",
            "mi2.wav",
            "/etc/cron.d/x",
            "../a/b",
            "a/../b",
            "a/b/../../../c",
            "a/./b",
            "a//b",
            ".ssh/a/b",
            "a/.b/c",
            "a/b/.bashrc",
            "a\\b/c/d",
            "a/b/c\0",
            "a/b/c/",
            "a/b/c/d/e/f/g",
        ] {
            assert_eq!(within(name), None, "{name:?}");
        }
    }
}
