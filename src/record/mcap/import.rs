//! Restores a recording's own files from an MCAP file.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};

use mcap::Summary;

use super::attached::within;
use crate::library::recording::UNFINISHED;
use crate::library::{LibraryError, files};
use crate::record::{failed, write_file};

/// Largest MCAP file in bytes: it is read as a whole.
const MOST_FILE: u64 = 1 << 32;

/// Writes back the files of a recording that was exported, below `dir`, which must not exist yet.
/// Returns the number of trials (folders SURFACE/TRIAL; none in LMT108). The folder appears once it
/// is complete: an import that fails leaves nothing.
///
/// # Errors
/// If `mcap` is no MCAP file, holds none of a recording's files, or names one that would lie
/// outside `dir`; if `dir` exists, or cannot be written.
pub fn import(mcap: &Path, dir: &Path) -> Result<usize, LibraryError> {
    let bytes = files::read_bytes(mcap, MOST_FILE)?;
    let attached = attachments(&bytes).map_err(|problem| LibraryError::file(mcap, problem))?;
    if dir.symlink_metadata().is_ok() {
        return Err(failed(dir, std::io::ErrorKind::AlreadyExists.into()));
    }
    let unfinished = beside(dir);
    fs::create_dir(&unfinished).map_err(|error| failed(&unfinished, error))?;
    let written = attached
        .iter()
        .try_for_each(|(path, data)| write(&unfinished.join(path), data))
        .and_then(|()| fs::rename(&unfinished, dir).map_err(|error| failed(dir, error)));
    if let Err(error) = written {
        // The first error matters more than one of the clean-up.
        let _ = fs::remove_dir_all(&unfinished);
        return Err(error);
    }
    let folders = attached.iter().filter_map(|(path, _)| path.parent());
    let trials: BTreeSet<_> = folders.filter(|folder| folder.iter().count() == 2).collect();
    Ok(trials.len())
}

/// A hidden name in the parent folder of `dir`.
fn beside(dir: &Path) -> PathBuf {
    let mut name = OsString::from(".");
    name.push(dir.file_name().unwrap_or(dir.as_os_str()));
    name.push(format!(".{}{UNFINISHED}", std::process::id()));
    dir.with_file_name(name)
}

fn write(path: &Path, data: &[u8]) -> Result<(), LibraryError> {
    if let Some(parent) = path.parent() {
        fs::create_dir_all(parent).map_err(|error| failed(parent, error))?;
    }
    write_file(path, data, true)
}

/// The attachments of a file: where they go, and their bytes.
///
/// # Errors
/// If there are none, if one would lie outside the recording, if two have one name, or if they
/// overlap: files nested in files could take many times the size of the whole.
fn attachments(bytes: &[u8]) -> Result<Vec<(PathBuf, Vec<u8>)>, String> {
    let damaged = |error: mcap::McapError| format!("no whole MCAP file: {error}");
    let mut indexes = Summary::read(bytes).map_err(damaged)?.unwrap_or_default().attachment_indexes;
    indexes.sort_by_key(|index| index.offset);
    let (mut end, mut names) = (0, BTreeSet::new());
    let mut attached = Vec::new();
    for index in &indexes {
        let name = &index.name;
        let start = index.offset;
        let within_file = |end: &u64| *end <= bytes.len() as u64;
        if start < end {
            return Err(format!("the file {name:?} lies within another one"));
        }
        end = start
            .checked_add(index.length)
            .filter(within_file)
            .ok_or_else(|| format!("the index of {name:?} points outside the file"))?;
        let file = mcap::read::attachment(bytes, index).map_err(damaged)?;
        let path = within(&file.name)
            .ok_or_else(|| format!("holds a file {:?}; expected SURFACE/TRIAL/FILE", file.name))?;
        if !names.insert(path.clone()) {
            return Err(format!("holds two files {:?}", file.name));
        }
        attached.push((path, file.data.into_owned()));
    }
    match attached.is_empty() {
        true => Err("holds no recording of surfaced's".into()),
        false => Ok(attached),
    }
}

#[cfg(test)]
mod tests {
    use std::borrow::Cow;
    use std::io::Cursor;

    use mcap::{Attachment, Writer};

    use super::*;

    fn with(names: &[&str]) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        let mut writer = Writer::new(&mut bytes).unwrap();
        for name in names {
            let (name, data) = ((*name).to_string(), Cow::Owned(vec![7; 1000]));
            let media_type = String::new();
            let file = Attachment { log_time: 0, create_time: 0, name, media_type, data };
            writer.attach(&file).unwrap();
        }
        writer.finish().unwrap();
        drop(writer);
        bytes.into_inner()
    }

    #[test]
    fn files_within_files_and_two_of_one_name_are_refused() {
        assert_eq!(attachments(&with(&["a/b/c", "a/b/d"])).unwrap().len(), 2);
        assert!(attachments(&with(&["a/b/c", "a/b/c"])).unwrap_err().contains("two files"));
        // The index of the second file points into the first one.
        let mut bytes = with(&["a/b/c", "a/b/d"]);
        let indexes = Summary::read(&bytes).unwrap().unwrap().attachment_indexes;
        let second = indexes[1].offset.to_le_bytes();
        let at = bytes.windows(8).rposition(|eight| eight == second).unwrap();
        bytes[at..at + 8].copy_from_slice(&(indexes[0].offset + 8).to_le_bytes());
        let error = attachments(&bytes).unwrap_err();
        assert!(error.contains("within another") || error.contains("no whole"), "{error}");
    }
}
