//! Lists folders and reads files, with errors that say what to do.

use std::fmt::Display;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use super::{LibraryError, Outline};
use crate::scene::SourceId;
use crate::seed;
use crate::system::{file_stamp, open_at_once};
use crate::trial::Series;

/// The extensions of files that hold one time series, in lower case.
const SERIES: [&str; 2] = ["wav", "flac"];
/// Those of series in a lossy form, which the feature `lossy` reads.
pub(super) const LOSSY: [&str; 4] = ["mp3", "m4a", "ogg", "oga"];

impl LibraryError {
    pub fn file(path: &Path, problem: impl Display) -> Self {
        Self::File { path: path.to_path_buf(), problem: problem.to_string() }
    }

    /// Makes a problem an error of the file at `path`, for `map_err`.
    pub(crate) fn at<P: Display>(path: &Path) -> impl Fn(P) -> Self + Copy {
        move |problem| Self::file(path, problem)
    }

    /// The error for a file that cannot be decoded as a `kind`.
    pub(super) fn damaged(path: &Path, kind: &str, why: &str) -> Self {
        let problem = format!(
            "not a {kind} that can be read ({why}); copy it again from where it came, record again, or \
             remove it"
        );
        Self::file(path, problem)
    }

    /// Describes an error of the file system, with advice for the common causes.
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
            _ => Self::file(path, error),
        }
    }
}

/// The path of an item relative to a library, such as `SURFACE/TRIAL`, with `/` on every system.
pub fn name_within(library: &Path, path: &Path) -> String {
    let within = path.strip_prefix(library).unwrap_or(path);
    let parts = within.components().map(|part| part.as_os_str().to_string_lossy().into_owned());
    parts.collect::<Vec<_>>().join("/")
}

/// Largest text file of samples or tables that is read, in bytes.
pub(crate) const MOST_TEXT: u64 = 1 << 26;
/// Largest `trial.toml` or `library.toml` that is read, in bytes.
const MOST_DESCRIPTION: u64 = 1 << 20;

#[derive(Debug)]
pub struct Listed {
    pub name: String,
    pub path: PathBuf,
    pub is_dir: bool,
    /// The reason why the item cannot be used (such as a broken link); `None` if it can. An item
    /// whose name is not UTF-8 is one of them, with a name that only serves messages.
    pub unusable: Option<&'static str>,
}

impl Listed {
    pub(crate) fn folder(path: &Path) -> Option<Self> {
        let name = path.file_name()?.to_str()?.to_string();
        Some(Self { name, path: path.to_path_buf(), is_dir: true, unusable: None })
    }

    /// Describes a file by its path; `None` if its name is not UTF-8.
    pub(crate) fn file(path: &Path) -> Option<Self> {
        Some(Self { is_dir: false, ..Self::folder(path)? })
    }

    pub(crate) fn is_series(&self) -> bool {
        !self.is_dir && self.unusable.is_none() && self.has_series_name()
    }

    pub(crate) fn has_series_name(&self) -> bool {
        let (_, extension) = self.stem_and_extension();
        let lossy = cfg!(feature = "lossy") && LOSSY.contains(&&*extension);
        lossy || SERIES.contains(&&*extension)
    }

    /// Why a recording in a form that is not read is not used; `None` for all other files.
    pub fn unreadable(&self) -> Option<String> {
        const SOUNDS: [&str; 14] = [
            "mp4", "aac", "opus", "webm", "wma", "amr", "3gp", "aif", "aiff", "aifc", "caf", "au",
            "w64", "raw",
        ];
        const TABLES: [&str; 11] =
            ["csv", "tsv", "lvm", "npy", "npz", "mat", "parquet", "xlsx", "xls", "h5", "tdms"];
        const PICTURES: [&str; 6] = ["tif", "tiff", "bmp", "gif", "heic", "webp"];
        let (_, extension) = self.stem_and_extension();
        let advice = match &*extension {
            _ if self.is_dir || self.has_series_name() => return None,
            lossy if LOSSY.contains(&lossy) => {
                "build with `--features lossy`, or convert it to WAV or FLAC"
            }
            sound if SOUNDS.contains(&sound) => "convert it to WAV or FLAC",
            table if TABLES.contains(&table) => "make a library of tables by `surfaced import csv`",
            picture if PICTURES.contains(&picture) => "save it as PNG or JPEG",
            _ => return None,
        };
        Some(format!("not used, .{extension} is not read as a recording; {advice}"))
    }

    pub fn stem_and_extension(&self) -> (&str, String) {
        let (stem, extension) = self.name.rsplit_once('.').unwrap_or((&self.name, ""));
        (stem, extension.to_ascii_lowercase())
    }

    /// Whether the name begins with a dot, like the files of editors or unfinished writes.
    pub fn is_hidden(&self) -> bool {
        self.name.starts_with('.')
    }
}

/// The number at the end of a name, such as 3 for `trial3`; `None` if the name does not end with one.
pub(crate) fn number_in(name: &str) -> Option<u32> {
    let stem = name.trim_end_matches(|c: char| c.is_ascii_digit());
    name[stem.len()..].parse().ok()
}

/// The extension of a file, in lower case.
pub(super) fn extension(path: &Path) -> String {
    path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase()
}

/// The items in a folder, sorted by name; links are followed. [`Listed::unusable`] is set for
/// broken links, for names that are not UTF-8, and for items that are neither files nor folders.
pub fn list(dir: &Path) -> Result<Vec<Listed>, LibraryError> {
    let fail = |error| LibraryError::io(dir, error);
    if !std::fs::metadata(dir).map_err(fail)?.is_dir() {
        return Err(LibraryError::file(dir, "this is a file; expected a folder of recordings"));
    }
    let mut listed = Vec::new();
    for item in std::fs::read_dir(dir).map_err(fail)? {
        let path = item.map_err(fail)?.path();
        let called = path.file_name().unwrap_or_default();
        let name = called.to_string_lossy().into_owned();
        let (is_dir, unusable) = match std::fs::metadata(&path) {
            // Neither a label nor a source can be called so, whether it is a file or a folder.
            Ok(_) if called.to_str().is_none() => {
                (false, Some("not used, its name is not UTF-8; rename it"))
            }
            Ok(about) if about.is_dir() => (true, None),
            Ok(about) if about.is_file() => (false, None),
            // A pipe, a socket or a device is never read, since its data may not end.
            Ok(_) => (false, Some("not used, it is neither a file nor a folder")),
            Err(_) if name.starts_with('.') => (false, None),
            Err(_) if path.is_symlink() => (false, Some("not used, it is a link to nothing")),
            Err(error) => return Err(LibraryError::io(&path, error)),
        };
        listed.push(Listed { name, path, is_dir, unusable });
    }
    listed.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(listed)
}

/// Opens a regular file, and returns its length in bytes. Refuses folders, pipes and devices.
pub fn open(path: &Path) -> io::Result<(File, u64)> {
    let file = open_at_once(path)?;
    let about = file.metadata()?;
    if !about.is_file() {
        let problem = "not a regular file; expected a file, not a folder, a pipe or a device";
        return Err(io::Error::new(io::ErrorKind::InvalidInput, problem));
    }
    Ok((file, about.len()))
}

/// Like [`open`], but also refuses an empty file.
pub(crate) fn open_filled(path: &Path) -> Result<(File, u64), LibraryError> {
    match open(path).map_err(|error| LibraryError::io(path, error))? {
        (_, 0) => Err(LibraryError::file(path, EMPTY_FILE)),
        filled => Ok(filled),
    }
}

/// Reads a regular file. Refuses an empty file, and a file of more than `most` bytes.
pub(crate) fn read_bytes(path: &Path, most: u64) -> Result<Vec<u8>, LibraryError> {
    let fail = |error| LibraryError::io(path, error);
    let (file, length) = open(path).map_err(fail)?;
    let mut bytes = Vec::with_capacity(length.min(most) as usize);
    // The limit holds even if the file grows while it is read.
    file.take(most + 1).read_to_end(&mut bytes).map_err(fail)?;
    match bytes.len() as u64 {
        0 => Err(LibraryError::file(path, EMPTY_FILE)),
        length if length > most => Err(LibraryError::file(
            path,
            format!(
                "larger than {} MiB, more than a file of its kind holds; remove it",
                most >> 20
            ),
        )),
        _ => Ok(bytes),
    }
}

const EMPTY_FILE: &str = "the file is empty (0 bytes); record again, or remove it";

/// Refuses a recording that is too long for a trial.
pub(super) fn check_length(outline: Outline) -> Result<(), String> {
    let Outline { rate_hz, channels, frames } = outline;
    let (samples, most) = (frames.saturating_mul(channels), Series::MOST_SAMPLES);
    if samples <= most {
        return Ok(());
    }
    Err(format!(
        "{:.0} minutes are too long for a trial: {samples} samples, but at most {most} are read; \
         cut the recording into trials",
        frames as f64 / rate_hz.max(1.0) / 60.0,
    ))
}

/// The text of a `trial.toml` or `library.toml`; `None` if there is no such file.
pub(crate) fn read_text_if_there(path: &Path) -> Result<Option<String>, LibraryError> {
    match std::fs::metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Ok(about) if about.is_file() && about.len() == 0 => return Ok(Some(String::new())),
        _ => {}
    }
    String::from_utf8(read_bytes(path, MOST_DESCRIPTION)?).map(Some).map_err(|error| {
        let good = &error.as_bytes()[..error.utf8_error().valid_up_to()];
        let line = 1 + good.iter().filter(|&&byte| byte == b'\n').count();
        LibraryError::file(path, format!("line {line}: not UTF-8; save the file as UTF-8"))
    })
}

/// A hash that changes if one of the files changes ([`file_stamp`]); `None` if one is missing.
pub(crate) fn stamp<'a>(
    sources: impl Iterator<Item = (&'a SourceId, &'a [PathBuf])>,
) -> Option<u64> {
    let mut parts: Vec<Vec<u8>> = Vec::new();
    for (id, paths) in sources {
        parts.push(id.as_str().as_bytes().to_vec());
        for path in paths {
            parts.push(file_stamp(path)?);
        }
    }
    Some(seed::stable_hash(&parts.iter().map(Vec::as_slice).collect::<Vec<_>>()))
}

/// A hash that identifies the running program; it changes when the program is built anew.
pub(crate) fn program_stamp() -> Option<u64> {
    Some(seed::stable_hash(&[&file_stamp(&std::env::current_exe().ok()?)?]))
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn pipes_devices_and_endless_files_are_refused_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe.wav");
        rustix::fs::mkfifoat(rustix::fs::CWD, &pipe, rustix::fs::Mode::RWXU).unwrap();
        let zero = folder.path().join("trial.toml");
        std::os::unix::fs::symlink("/dev/zero", &zero).unwrap();
        std::os::unix::fs::symlink("nowhere", folder.path().join("gone")).unwrap();
        for path in [&pipe, &zero, folder.path()] {
            let error = read_bytes(path, 10).unwrap_err().to_string();
            assert!(error.contains("not a regular file"), "{error}");
        }
        assert!(read_text_if_there(&zero).is_err());
        let listed = list(folder.path()).unwrap();
        assert!(listed.iter().all(|item| item.unusable.is_some() && !item.is_dir), "{listed:?}");
    }

    #[test]
    fn a_file_that_is_too_large_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x");
        std::fs::write(&path, [7; 11]).unwrap();
        assert!(read_bytes(&path, 10).unwrap_err().to_string().contains("larger than"));
        assert_eq!(read_bytes(&path, 11).unwrap(), [7; 11]);
    }

    #[test]
    fn a_file_of_the_same_name_size_and_time_has_another_stamp() {
        let folder = tempfile::tempdir().unwrap();
        let paths = [folder.path().join("ac.wav")];
        let id = SourceId::new("ac").unwrap();
        let stamp = || super::stamp(std::iter::once((&id, &paths[..]))).unwrap();
        std::fs::write(&paths[0], [1; 10]).unwrap();
        let (before, at) = (stamp(), std::fs::metadata(&paths[0]).unwrap().modified().unwrap());
        assert_eq!(stamp(), before);
        // Waits longer than one tick of a file system's clock.
        std::thread::sleep(std::time::Duration::from_millis(50));
        std::fs::write(&paths[0], [2; 10]).unwrap();
        std::fs::File::options().write(true).open(&paths[0]).unwrap().set_modified(at).unwrap();
        let edited = stamp();
        assert_ne!(edited, before);
        // Replaces the file by another one with the same size and time of change.
        let other = folder.path().join("other.wav");
        std::fs::write(&other, [3; 10]).unwrap();
        std::fs::File::options().write(true).open(&other).unwrap().set_modified(at).unwrap();
        std::fs::rename(&other, &paths[0]).unwrap();
        assert_ne!(stamp(), edited);
    }
}
