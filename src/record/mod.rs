//! Writes the recording format, version 1; `library::recording` reads it.
//!
//! A trial is written into a folder that readers skip, and renamed when it is complete: after a
//! crash there are complete trials and perhaps an unfinished folder, never half a trial.

mod date;
pub mod edit;
mod folder_name;
#[cfg(feature = "mcap")]
pub mod mcap;
mod wav;

#[doc(hidden)]
pub use date::unix_ms;
pub(crate) use date::utc;

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use image::ImageEncoder;

use crate::dataset;
use crate::library::recording::{DESCRIPTION, UNFINISHED, number_in};
use crate::library::{About, LibraryError};
use crate::scene::{Domain, Scene, SourceSpec};
use crate::system;
use crate::trial::{Image, Series, Signal, Trial, TrialKey, normal};

/// The content of a trial's `trial.toml`, and how its files are written.
#[derive(Clone, Debug, PartialEq)]
pub struct TrialOptions {
    /// Start, notes and devices; surface, user and number are taken from the trial instead.
    pub about: About,
    /// Whether to wait until the disk holds each file, so that a power failure loses no finished
    /// trial. `false` is much faster, for data that can be made again.
    pub durable: bool,
}

impl Default for TrialOptions {
    fn default() -> Self {
        Self { about: About::default(), durable: true }
    }
}

/// Writes `library.toml` of a library: its name, its sources, and whether it is synthetic. Creates
/// the folder if it is missing, and replaces an existing `library.toml`.
///
/// # Errors
/// If the folder or the file cannot be written.
pub fn write_library_toml(
    dir: &Path,
    scene: &Scene,
    name: &str,
    synthetic: bool,
) -> Result<(), LibraryError> {
    fs::create_dir_all(dir).map_err(|error| failed(dir, error))?;
    let mut named = scene.clone();
    named.name = name.to_string();
    let (path, text) = (dir.join(DESCRIPTION), named.to_library_toml(synthetic));
    let mut file = unfinished(&format!(".{DESCRIPTION}."))
        .make_in(dir, |path| File::create_new(path))
        .map_err(|error| failed(dir, error))?;
    file.write_all(text.as_bytes())
        .and_then(|()| file.as_file().sync_all())
        .map_err(|error| failed(file.path(), error))?;
    system::persist(file, &path).map_err(|error| failed(&path, error))
}

/// Checks that trials can be written into a library, and creates its folder if it is missing.
///
/// # Errors
/// With advice, if the folder cannot be created, nothing can be written there, or trials written
/// there would never be read.
pub(crate) fn check_writable(dir: &Path) -> Result<(), LibraryError> {
    if dataset::is_foreign(dir) {
        let problem = "this holds the LMT108 database in a layout of its own, in which trials that are \
                       added are never read; choose another folder for them";
        return Err(LibraryError::file(dir, problem));
    }
    fs::create_dir_all(dir).map_err(|error| failed(dir, error))?;
    // A byte, since a full disk still takes empty files.
    let mut probe = unfinished(".probe.").tempfile_in(dir).map_err(|error| failed(dir, error))?;
    let written = probe.write_all(b"0").and_then(|()| probe.as_file().sync_all());
    written.map_err(|error| failed(dir, error))
}

/// Writes one trial into the library `dir` and returns its folder, `SURFACE/USER-NUMBER`.
///
/// A trial is read back as it was written: series are stored as 16-bit WAV where that loses
/// nothing and as f32 where it would, images as PNG. Characters that do not belong into folder
/// names are encoded there; `trial.toml` holds the true names.
///
/// # Errors
/// If a name is empty, if there is such a trial already, if a signal is not what `scene` says of
/// its source, if WAV cannot hold it, or if the file system refuses.
pub fn write_trial(
    dir: &Path,
    trial: &Trial,
    scene: &Scene,
    options: &TrialOptions,
) -> Result<PathBuf, LibraryError> {
    let folder = trial_folder(dir, &trial.key);
    let taken = || {
        let problem = format!(
            "there is a recording of {} already; choose another number, or remove it",
            trial.key
        );
        LibraryError::file(&folder, problem)
    };
    // Checked first, so that nothing is written in vain.
    if folder.exists() {
        return Err(taken());
    }
    let unfinished = UnfinishedTrial::write(dir, trial, scene, options)?;
    if !unfinished.finish(&folder)? {
        return Err(taken());
    }
    Ok(folder)
}

/// Writes one trial into the library `dir`, like [`write_trial`], but if its number is taken, even
/// by another process at the same moment, under the next free one. Returns the number and the
/// folder.
///
/// # Errors
/// As [`write_trial`], except that a number may be taken.
pub fn append_trial(
    dir: &Path,
    trial: &Trial,
    scene: &Scene,
    options: &TrialOptions,
) -> Result<(u32, PathBuf), LibraryError> {
    let mut key = trial.key.clone();
    let unfinished = UnfinishedTrial::write(dir, trial, scene, options)?;
    loop {
        let folder = trial_folder(dir, &key);
        if !folder.exists() && unfinished.finish(&folder)? {
            return Ok((key.number, folder));
        }
        key.number = key.number.checked_add(1).ok_or_else(|| {
            LibraryError::file(&folder, format!("no number is left for trials of {}", key.surface))
        })?;
        unfinished.describe(&key)?;
    }
}

/// A trial that is complete except for its name.
struct UnfinishedTrial<'a> {
    library: &'a Path,
    /// The folder of the surface.
    surface: PathBuf,
    options: &'a TrialOptions,
    /// A folder of a random name, created for this trial alone, and removed when this is dropped.
    folder: tempfile::TempDir,
}

impl<'a> UnfinishedTrial<'a> {
    fn write(
        library: &'a Path,
        trial: &Trial,
        scene: &Scene,
        options: &'a TrialOptions,
    ) -> Result<Self, LibraryError> {
        let key = &trial.key;
        if key.surface.is_empty() || key.user.is_empty() {
            let problem =
                "a trial needs the name of its surface and of its user; one of them is empty";
            return Err(LibraryError::file(library, problem));
        }
        if trial.signals.is_empty() {
            let problem = format!("{key} holds no signals; nothing to write");
            return Err(LibraryError::file(&trial_folder(library, key), problem));
        }
        let surface = library.join(folder_name::encode(&key.surface));
        let name = format!(".{}.", trial_name(key));
        let create = || {
            fs::create_dir_all(&surface)?;
            let mut builder = unfinished(&name);
            system::usual_permissions(&mut builder);
            builder.tempdir_in(&surface)
        };
        // Tried twice: an edit may remove the empty folder of a surface at this very moment.
        let folder = create().or_else(|_| create()).map_err(|error| failed(&surface, error))?;
        let unfinished = Self { library, surface, options, folder };
        write_signals(unfinished.folder.path(), trial, scene, options)?;
        unfinished.describe(key)?;
        Ok(unfinished)
    }

    /// Writes the `trial.toml` of the trial, with the names and number of `key`.
    fn describe(&self, key: &TrialKey) -> Result<(), LibraryError> {
        let about = About {
            surface: Some(normal(&key.surface)),
            user: Some(normal(&key.user)),
            trial: Some(key.number),
            ..self.options.about.clone()
        };
        let (dir, durable) = (self.folder.path(), self.options.durable);
        write_file(&dir.join(crate::library::ABOUT_FILE), about.to_toml().as_bytes(), durable)?;
        if durable { sync_folder(dir) } else { Ok(()) }
    }

    /// Gives the folder its final name. False if another trial has that name.
    fn finish(&self, folder: &Path) -> Result<bool, LibraryError> {
        use std::io::ErrorKind::{AlreadyExists, DirectoryNotEmpty, NotADirectory};
        match system::rename_new(self.folder.path(), folder) {
            Ok(()) => {}
            Err(error)
                if matches!(error.kind(), DirectoryNotEmpty | AlreadyExists | NotADirectory) =>
            {
                return Ok(false);
            }
            Err(error) => return Err(failed(folder, error)),
        }
        if self.options.durable {
            sync_folder(&self.surface)?;
            sync_folder(self.library)?;
        }
        Ok(true)
    }
}

/// Creates files and folders of random names, which readers skip and no other writer has.
fn unfinished(prefix: &str) -> tempfile::Builder<'_, 'static> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(prefix).rand_bytes(16).suffix(UNFINISHED);
    builder
}

/// The folder that a trial of this name is written into.
pub(crate) fn trial_folder(dir: &Path, key: &TrialKey) -> PathBuf {
    dir.join(folder_name::encode(&key.surface)).join(trial_name(key))
}

/// One more than the highest number in folder names of a surface's trials, removed ones included; 1
/// if there are none. To save time, no `trial.toml` is read, which may give a trial another number.
pub(crate) fn number_by_names(dir: &Path, surface: &str) -> u32 {
    let folder = folder_name::encode(surface);
    let folders = [dir.join(&folder), dir.join(edit::REMOVED).join(&folder)];
    let items = folders.iter().filter_map(|folder| fs::read_dir(folder).ok()).flatten().flatten();
    let names = items.map(|item| item.file_name());
    let highest = names.filter_map(|name| number_in(name.to_str()?)).max();
    highest.map_or(1, |number| number.saturating_add(1))
}

fn trial_name(key: &TrialKey) -> String {
    format!("{}-{:02}", folder_name::encode(&key.user), key.number)
}

fn write_signals(
    dir: &Path,
    trial: &Trial,
    scene: &Scene,
    options: &TrialOptions,
) -> Result<(), LibraryError> {
    for (id, signal) in &trial.signals {
        let fail = |problem| LibraryError::file(dir, format!("source `{id}`: {problem}"));
        let spec = scene.get(id.as_str()).ok_or_else(|| {
            fail("the scene does not describe it; add it to the configuration".to_string())
        })?;
        check(spec, signal).map_err(fail)?;
        let (path, bytes) = match signal {
            Signal::Series(series) => {
                (dir.join(format!("{id}.wav")), wav::encode(series).map_err(fail)?)
            }
            Signal::Image(image) => (dir.join(format!("{id}.png")), png(image).map_err(fail)?),
        };
        write_file(&path, &bytes, options.durable)?;
    }
    Ok(())
}

/// Refuses what a reader with the same scene would refuse.
fn check(spec: &SourceSpec, signal: &Signal) -> Result<(), String> {
    let series: &Series = match (signal, &spec.domain) {
        (Signal::Image(_), Domain::Image) => return Ok(()),
        (Signal::Image(_), _) => return Err("an image, but the scene says a series".into()),
        (Signal::Series(_), Domain::Image) => {
            return Err("a series, but the scene says an image".into());
        }
        (Signal::Series(series), _) => series,
    };
    if series.channels() != spec.channels {
        return Err(format!(
            "{} channels, but the scene says {}",
            series.channels(),
            spec.channels
        ));
    }
    match spec.rate_hz {
        Some(rate_hz) if rate_hz != series.rate_hz() => {
            Err(format!("{} Hz, but the scene says {rate_hz} Hz", series.rate_hz()))
        }
        _ => Ok(()),
    }
}

fn png(image: &Image) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::new();
    image::codecs::png::PngEncoder::new(&mut bytes)
        .write_image(
            image.rgb(),
            Image::COLS as u32,
            Image::ROWS as u32,
            image::ExtendedColorType::Rgb8,
        )
        .map_err(|error| error.to_string())?;
    Ok(bytes)
}

fn write_file(path: &Path, bytes: &[u8], durable: bool) -> Result<(), LibraryError> {
    let write = || {
        let mut file = File::create(path)?;
        file.write_all(bytes)?;
        if durable { file.sync_all() } else { Ok(()) }
    };
    write().map_err(|error| failed(path, error))
}

/// Makes new names in a folder last.
fn sync_folder(dir: &Path) -> Result<(), LibraryError> {
    system::names_written(dir).map_err(|error| failed(dir, error))
}

fn failed(path: &Path, error: std::io::Error) -> LibraryError {
    match error.kind() {
        std::io::ErrorKind::PermissionDenied => LibraryError::file(
            path,
            "cannot write here: permission denied; choose another folder, or change its permissions",
        ),
        std::io::ErrorKind::StorageFull => {
            LibraryError::file(path, "cannot write here: the disk is full; make room and try again")
        }
        _ => LibraryError::Io { path: path.to_path_buf(), error },
    }
}
