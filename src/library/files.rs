//! Folders, and errors of the file system that say what to do.

use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::LibraryError;
use crate::scene::SourceId;
use crate::seed;

impl LibraryError {
    /// A file that does not hold what it should.
    pub(crate) fn file(path: &Path, problem: impl Into<String>) -> Self {
        Self::File { path: path.to_path_buf(), problem: problem.into() }
    }

    /// What the file system said, with advice where there is any.
    pub(crate) fn io(path: &Path, error: io::Error) -> Self {
        match error.kind() {
            io::ErrorKind::NotFound => {
                Self::file(path, "there is no such file or folder; check the path")
            }
            io::ErrorKind::PermissionDenied => Self::file(
                path,
                "permission denied; let yourself read it (chmod u+r, for a folder u+rx), \
                 or run as its owner",
            ),
            _ => Self::Io { path: path.to_path_buf(), error },
        }
    }
}

/// One thing in a folder.
#[derive(Debug)]
pub(crate) struct Listed {
    pub name: String,
    pub path: PathBuf,
    pub is_dir: bool,
}

impl Listed {
    /// A folder by its path; `None` if its name is not UTF-8.
    pub fn folder(path: &Path) -> Option<Self> {
        let name = path.file_name()?.to_str()?.to_string();
        Some(Self { name, path: path.to_path_buf(), is_dir: true })
    }

    /// The name without its extension, and the extension in lower case.
    pub fn stem_and_extension(&self) -> (&str, String) {
        match self.name.rsplit_once('.') {
            Some((stem, extension)) => (stem, extension.to_ascii_lowercase()),
            None => (&self.name, String::new()),
        }
    }

    /// Hidden things belong to somebody else: an editor, the desktop, an unfinished write.
    pub fn is_hidden(&self) -> bool {
        self.name.starts_with('.')
    }
}

/// What is in a folder, sorted by name; links are followed.
///
/// # Errors
/// If the folder cannot be read, is a file, or holds a name that is not UTF-8.
pub(crate) fn list(dir: &Path) -> Result<Vec<Listed>, LibraryError> {
    let fail = |error| LibraryError::io(dir, error);
    if !std::fs::metadata(dir).map_err(fail)?.is_dir() {
        return Err(LibraryError::file(dir, "this is a file; expected a folder of recordings"));
    }
    let mut listed = Vec::new();
    for item in std::fs::read_dir(dir).map_err(fail)? {
        let path = item.map_err(fail)?.path();
        let Some(name) = path.file_name().and_then(|name| name.to_str()).map(String::from) else {
            return Err(LibraryError::file(&path, "its name is not UTF-8; rename it"));
        };
        let is_dir = match std::fs::metadata(&path) {
            Ok(about) => about.is_dir(),
            Err(_) if name.starts_with('.') => false,
            Err(error) => return Err(LibraryError::io(&path, error)),
        };
        listed.push(Listed { name, path, is_dir });
    }
    listed.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(listed)
}

/// The bytes of a file that must not be empty.
///
/// # Errors
/// If it cannot be read or is empty.
pub(crate) fn read_bytes(path: &Path) -> Result<Vec<u8>, LibraryError> {
    let bytes = std::fs::read(path).map_err(|error| LibraryError::io(path, error))?;
    if bytes.is_empty() {
        return Err(LibraryError::file(path, EMPTY_FILE));
    }
    Ok(bytes)
}

/// Said of a file of zero bytes.
pub(super) const EMPTY_FILE: &str = "the file is empty (0 bytes); record again, or remove it";

/// The text of a file, or nothing if there is no such file.
///
/// # Errors
/// If it cannot be read or is not UTF-8.
pub(crate) fn read_text_if_there(path: &Path) -> Result<Option<String>, LibraryError> {
    match std::fs::read(path) {
        Ok(bytes) => match String::from_utf8(bytes) {
            Ok(text) => Ok(Some(text)),
            Err(error) => {
                let good = &error.as_bytes()[..error.utf8_error().valid_up_to()];
                let line = 1 + good.iter().filter(|&&byte| byte == b'\n').count();
                Err(LibraryError::file(
                    path,
                    format!("line {line}: not UTF-8; save the file as UTF-8"),
                ))
            }
        },
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(LibraryError::io(path, error)),
    }
}

/// A number for what files hold, by their device, inode, size and times of change, source by
/// source; `None` if one of them is not there.
pub(crate) fn stamp<'a>(
    sources: impl Iterator<Item = (&'a SourceId, &'a [PathBuf])>,
) -> Option<u64> {
    let mut parts: Vec<Vec<u8>> = Vec::new();
    for (id, paths) in sources {
        parts.push(id.as_str().as_bytes().to_vec());
        for path in paths {
            let about = std::fs::metadata(path).ok()?;
            parts.push([about.dev(), about.ino(), about.size()].map(u64::to_le_bytes).concat());
            let times = [about.mtime(), about.mtime_nsec(), about.ctime(), about.ctime_nsec()];
            parts.push(times.map(i64::to_le_bytes).concat());
        }
    }
    Some(seed::stable_hash(&parts.iter().map(Vec::as_slice).collect::<Vec<_>>()))
}
