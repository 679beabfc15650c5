//! Moving one trial, and replacing one file.

use std::fs;
use std::path::Path;

use crate::library::{ABOUT_FILE, About, LibraryError};
use crate::record::{failed, sync_folder, write_file};
use crate::trial::TrialKey;

/// Moves a trial to another folder, under another name. The name is written first: it is what
/// readers go by, wherever the folder is.
pub(super) fn relocate(from: &Path, to: &Path, key: Option<&TrialKey>) -> Result<(), LibraryError> {
    if let Some(TrialKey { surface, user, number }) = key {
        let about = About {
            surface: Some(surface.clone()),
            user: Some(user.clone()),
            trial: Some(*number),
            ..About::read(from)?
        };
        replace(&from.join(ABOUT_FILE), &about.to_toml())?;
    }
    let (old, new) = (from.parent().unwrap_or(from), to.parent().unwrap_or(to));
    fs::create_dir_all(new).map_err(|error| failed(new, error))?;
    fs::rename(from, to).map_err(|error| failed(to, error))?;
    for folder in [old, new] {
        sync_folder(folder)?;
    }
    // A surface without trials needs no folder; one that holds anything stays.
    let _ = fs::remove_dir(old);
    Ok(())
}

/// Replaces a file as a whole.
pub(super) fn replace(path: &Path, text: &str) -> Result<(), LibraryError> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let unfinished = path.with_file_name(format!(".{name}.unfinished"));
    write_file(&unfinished, text.as_bytes(), true)?;
    fs::rename(&unfinished, path).map_err(|error| failed(path, error))
}
