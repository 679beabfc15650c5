//! Reads recordings in formats of other projects, and generates synthetic recordings.

#[doc(hidden)]
pub mod csv;
#[doc(hidden)]
pub mod feature_tables;
mod lmt108;
pub mod synth;
#[doc(hidden)]
pub mod tables;

#[doc(hidden)]
pub use tables::try_table;

use std::path::{Path, PathBuf};

use crate::library::files::{self, Listed};
use crate::library::recording::{self, DESCRIPTION, IMPORTING};
use crate::library::{Library, LibraryError, Opened};
use crate::scene::Scene;

/// Whether the LMT108 database has a folder of this name, in either of its two layouts.
pub(crate) fn is_layout_name(name: &str) -> bool {
    let mut folders = lmt108::FOLDERS.split(' ').chain(PROCESSED);
    folders.any(|folder| folder.eq_ignore_ascii_case(name))
}

/// Whether a folder, or a folder in it, is a copy of the LMT108 database. A trial written there in
/// the project's recording format would never be read.
pub fn is_foreign(path: &Path) -> bool {
    !copies(path, files::list(path).unwrap_or_default()).is_empty()
}

/// The copies of the LMT108 database, with their items: `path` itself, or else folders in it.
fn copies(path: &Path, listed: Vec<Listed>) -> Vec<(PathBuf, Vec<Listed>)> {
    let is_copy = |listed: &[Listed]| lmt108::is_root(listed) || is_processed(listed);
    if is_copy(&listed) {
        return vec![(path.to_path_buf(), listed)];
    }
    // A folder with a `library.toml` is a library in the project's recording format.
    if listed.iter().any(|item| item.name == DESCRIPTION) {
        return Vec::new();
    }
    let folders = listed.into_iter().filter(|item| item.is_dir && !item.is_hidden());
    // A folder that cannot be listed counts as empty here; reading it later reports the error.
    let inner = folders.map(|item| (files::list(&item.path).unwrap_or_default(), item.path));
    inner.filter(|(inner, _)| is_copy(inner)).map(|(inner, path)| (path, inner)).collect()
}

/// Opens the recordings at `path`, in any of these formats:
///
/// - the LMT108 database (`path`, or a folder in it, holds `SoundScans/`, `AccelScansComponents/` or
///   another folder of the database),
/// - a single file of a series, such as WAV or FLAC: one trial of an unknown surface,
/// - otherwise the recording format, version 1 (see [`recording`]).
///
/// The sources are those of `defaults`, and those that the library itself describes. Samples are
/// read when an entry is loaded; [`Library::remarks`] says what was found and what is missing.
///
/// # Errors
/// If the folder cannot be read, holds no recordings, or holds recordings that contradict their
/// description; also if it holds LMT108 in its authors' processed form, which a script converts.
pub fn open(path: &Path, defaults: &Scene) -> Result<Library, LibraryError> {
    open_usable(path, defaults)?.whole()
}

/// Like [`open`], but [`Opened::bad`] lists the files and trials that cannot be used.
///
/// # Errors
/// If the folder cannot be read, or nothing in it can be used.
pub fn open_usable(path: &Path, defaults: &Scene) -> Result<Opened, LibraryError> {
    if let Some(item) = Listed::file(path).filter(|_| path.is_file()) {
        if item.is_series() {
            return recording::open_file(path, defaults);
        }
        if let Some(why) = item.unreadable() {
            return Err(LibraryError::file(path, why));
        }
    }
    if path.file_name().is_some_and(|name| name.to_string_lossy().ends_with(IMPORTING)) {
        let problem = "an import is still writing this library, or was interrupted; let it end, or \
                       run it again";
        return Err(LibraryError::file(path, problem));
    }
    match copies(path, files::list(path)?).as_slice() {
        [] => recording::open_usable(path, defaults),
        [(path, listed)] if lmt108::is_root(listed) => lmt108::open(path, listed, defaults),
        [(path, _)] => {
            let problem = "LMT108 in its authors' processed form (MATLAB files); convert it with \
                           `tools/python/from_mat FOLDER LIBRARY`, and name that library";
            Err(LibraryError::file(path, problem))
        }
        [(a, _), (b, _), ..] => {
            let [a, b] = [a, b].map(|copy| copy.file_name().unwrap_or_default().display());
            let problem = format!(
                "more than one copy of the LMT108 database (`{a}`, `{b}`); name one of them"
            );
            Err(LibraryError::file(path, problem))
        }
    }
}

/// Folders of the processed form in which the authors of LMT108 published it.
const PROCESSED: [&str; 3] = ["DataLMT108", "Library", "TestingSet"];

/// Whether `listed` is the content of the root of the authors' processed form of LMT108, or of its
/// `DataLMT108`. A surface may be called `Library`, too, but its folder holds trial folders.
fn is_processed(listed: &[Listed]) -> bool {
    let called = |item: &Listed, name: &str| item.name.eq_ignore_ascii_case(name);
    let holds_only = |name: &str, folders: &[&str]| {
        listed.iter().filter(|item| item.is_dir && called(item, name)).any(|item| {
            let inner = files::list(&item.path).unwrap_or_default();
            let visible = inner.iter().filter(|item| item.is_dir && !item.is_hidden());
            visible.into_iter().all(|item| folders.iter().any(|name| called(item, name)))
        })
    };
    let lists = ["surfaceList_LMT108train.mat", "surfaceList_LMT108test.mat"];
    let [data, splits @ ..] = PROCESSED;
    holds_only(data, &splits)
        || lists.iter().any(|list| listed.iter().any(|item| !item.is_dir && called(item, list)))
        || splits.iter().all(|split| holds_only(split, &[]))
}
