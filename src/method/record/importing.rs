//! The folder in which an import writes a library.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use super::failed;
use crate::library::LibraryError;
use crate::library::recording::IMPORTING;
use crate::system::Locked;

/// A folder `.NAME.importing` beside the library NAME. It gets the library's name when the library is
/// whole, so that an import which ends early leaves no part that looks whole.
pub struct Importing {
    pub folder: PathBuf,
    /// Locked while the import runs.
    _lock: Locked,
}

impl Importing {
    /// Makes the folder for the library `out`, and `out`'s parents. Removes what an interrupted import
    /// has left, and warns of it.
    ///
    /// # Errors
    /// If another import writes the same library, or the folder cannot be made.
    pub fn begin(out: &Path) -> Result<Self, LibraryError> {
        let Some(name) = out.file_name().map(|name| name.to_string_lossy()) else {
            return Err(LibraryError::file(out, "not the name of a folder to make"));
        };
        let folder = out.with_file_name(format!(".{name}{IMPORTING}"));
        let fail = |error| failed(&folder, error);
        if let Some(parent) = out.parent().filter(|parent| !parent.as_os_str().is_empty()) {
            fs::create_dir_all(parent).map_err(fail)?;
        }
        let lock = File::create(lock_of(&folder)).map_err(fail)?;
        let Some(lock) = Locked::now(lock) else {
            let problem = "another import is writing this library; wait for it";
            return Err(LibraryError::file(out, problem));
        };
        if folder.exists() {
            tracing::warn!(
                "an import into {} was interrupted before; it starts over",
                out.display()
            );
            fs::remove_dir_all(&folder).map_err(fail)?;
        }
        fs::create_dir(&folder).map_err(fail)?;
        Ok(Self { folder, _lock: lock })
    }

    /// Gives the finished library its name. Fails if something other than an empty folder has it.
    pub fn finish(self, out: &Path) -> Result<(), LibraryError> {
        if out.exists() {
            fs::remove_dir(out).map_err(|error| failed(out, error))?;
        }
        fs::rename(&self.folder, out).map_err(|error| failed(out, error))
    }
}

impl Drop for Importing {
    fn drop(&mut self) {
        // After `finish`, the folder has another name. A crash leaves both, and the next import says so.
        let _ = fs::remove_dir_all(&self.folder);
        let _ = fs::remove_file(lock_of(&self.folder));
    }
}

/// The lock beside a folder `.NAME.importing`.
fn lock_of(folder: &Path) -> PathBuf {
    folder.with_extension("importing.lock")
}
