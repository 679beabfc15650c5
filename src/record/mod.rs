//! Writing the recording format, version 1; `library::recording` reads it.
//!
//! A trial is written into a folder that readers pass over and renamed when it is whole: after a
//! crash there are whole trials and perhaps an unfinished folder, never half a trial.

mod date;
mod folder_name;
pub mod mcap;
mod wav;

pub use date::utc;

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use image::ImageEncoder;

use crate::library::recording::{DESCRIPTION, UNFINISHED};
use crate::library::{About, LibraryError};
use crate::scene::{Domain, Scene, SourceSpec};
use crate::trial::{Image, Series, Signal, Trial, TrialKey};

/// What is written beside a trial's data, and how.
#[derive(Clone, Debug, PartialEq)]
pub struct TrialOptions {
    /// Start, notes, devices and marks; surface, user and number are those of the trial.
    pub about: About,
    /// Wait until the disk holds each file, so that a loss of power costs no finished trial. For
    /// data that can be made again, `false` is much faster.
    pub durable: bool,
}

impl Default for TrialOptions {
    fn default() -> Self {
        Self { about: About::default(), durable: true }
    }
}

/// Writes `library.toml` of a library: its name, its sources, and whether it is synthetic. The
/// folder is made if need be; a `library.toml` that is there is replaced.
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
    let text = named.to_library_toml(synthetic);
    let (path, unfinished) =
        (dir.join(DESCRIPTION), dir.join(format!(".{DESCRIPTION}{UNFINISHED}")));
    write_file(&unfinished, text.as_bytes(), true)?;
    fs::rename(&unfinished, &path).map_err(|error| failed(&path, error))
}

/// Writes one trial into the library `dir` and gives its folder, `SURFACE/USER-NUMBER`.
///
/// What is read back equals what was written: series are stored as 16-bit WAV where that loses
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
    let key = &trial.key;
    if key.surface.is_empty() || key.user.is_empty() {
        let problem = "a trial needs the name of its surface and of its user; one of them is empty";
        return Err(LibraryError::file(dir, problem));
    }
    let folder = trial_folder(dir, key);
    let surface = dir.join(folder_name::encode(&key.surface));
    let name = trial_name(key);
    let taken = || {
        LibraryError::file(
            &folder,
            format!("there is a recording of {key} already; choose another number, or remove it"),
        )
    };
    if folder.exists() {
        return Err(taken());
    }
    if trial.signals.is_empty() {
        return Err(LibraryError::file(
            &folder,
            format!("{key} holds no signals; nothing to write"),
        ));
    }
    fs::create_dir_all(&surface).map_err(|error| failed(&surface, error))?;
    let unfinished = surface.join(format!(".{name}.{}{UNFINISHED}", std::process::id()));
    if unfinished.exists() {
        fs::remove_dir_all(&unfinished).map_err(|error| failed(&unfinished, error))?;
    }
    fs::create_dir(&unfinished).map_err(|error| failed(&unfinished, error))?;
    let written = write_files(&unfinished, trial, scene, options).and_then(|()| {
        fs::rename(&unfinished, &folder).map_err(|error| match error.kind() {
            std::io::ErrorKind::DirectoryNotEmpty | std::io::ErrorKind::AlreadyExists => taken(),
            _ => failed(&folder, error),
        })
    });
    if let Err(error) = written {
        // The error at hand matters more than one from tidying up.
        let _ = fs::remove_dir_all(&unfinished);
        return Err(error);
    }
    if options.durable {
        sync_folder(&surface)?;
        sync_folder(dir)?;
    }
    Ok(folder)
}

/// The folder that a trial of this name is written into.
pub fn trial_folder(dir: &Path, key: &TrialKey) -> PathBuf {
    dir.join(folder_name::encode(&key.surface)).join(trial_name(key))
}

fn trial_name(key: &TrialKey) -> String {
    format!("{}-{:02}", folder_name::encode(&key.user), key.number)
}

fn write_files(
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
    let about = About {
        surface: Some(trial.key.surface.clone()),
        user: Some(trial.key.user.clone()),
        trial: Some(trial.key.number),
        ..options.about.clone()
    };
    write_file(&dir.join(crate::library::ABOUT_FILE), about.to_toml().as_bytes(), options.durable)?;
    if options.durable { sync_folder(dir) } else { Ok(()) }
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

/// Makes new names in a folder last; only Unix can and needs to.
fn sync_folder(dir: &Path) -> Result<(), LibraryError> {
    if cfg!(unix) {
        File::open(dir).and_then(|folder| folder.sync_all()).map_err(|error| failed(dir, error))?;
    }
    Ok(())
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
