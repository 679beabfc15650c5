//! Writes the recording format, version 1; `library::recording` reads this format.
//!
//! A trial is written into a folder that readers skip, and the folder is renamed when it is
//! complete. So a crash may leave an unfinished folder, but never half a trial.

pub mod edit;
#[doc(hidden)]
pub mod folder_name;
#[doc(hidden)]
pub mod importing;
#[cfg(feature = "mcap")]
pub mod mcap;
#[doc(hidden)]
pub mod reference;

use std::fs::{self, File};
use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};

use hound::{SampleFormat, WavSpec, WavWriter};
use image::ImageEncoder;

use crate::library::files::number_in;
use crate::library::recording::{DESCRIPTION, UNFINISHED};
use crate::library::wav::EXACT_RATE;
use crate::library::{About, LibraryError};
use crate::scene::{Domain, MOST_CHANNELS, Scene, SourceSpec};
use crate::trial::{Image, Series, Signal, Trial, TrialKey, normal};
use crate::{dataset, system};

#[derive(Clone, Debug, PartialEq)]
pub struct TrialOptions {
    /// Start, notes and devices for `trial.toml`. The trial itself gives surface, user and number.
    pub about: About,
    /// Whether to wait until the disk holds each file, so that a power failure loses no finished
    /// trial. `false` is much faster; use it for data that can be made again.
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
    replace_file(&dir.join(DESCRIPTION), named.to_library_toml(synthetic).as_bytes())
}

/// Writes a file beside `path`, waits until the disk holds it, and gives it this name.
pub fn replace_file(path: &Path, bytes: &[u8]) -> Result<(), LibraryError> {
    let folder = path.parent().unwrap_or(path);
    let replace = || {
        let mut file = unfinished(".replacing.").make_in(folder, |path| File::create_new(path))?;
        file.write_all(bytes)?;
        file.as_file().sync_all()?;
        system::persist(file, path)
    };
    replace().map_err(|error| failed(path, error))
}

/// Checks that trials can be written into a library, and creates its folder if it is missing.
/// Refuses a folder of another dataset layout, from which written trials would never be read.
pub fn check_writable(dir: &Path) -> Result<(), LibraryError> {
    if dataset::is_foreign(dir) {
        let problem = "this holds the LMT108 database in a layout of its own, in which trials that are \
                       added are never read; choose another folder for them";
        return Err(LibraryError::file(dir, problem));
    }
    fs::create_dir_all(dir).map_err(|error| failed(dir, error))?;
    // The test file holds one byte, since even a full disk accepts empty files.
    let mut probe = unfinished(".probe.").tempfile_in(dir).map_err(|error| failed(dir, error))?;
    let written = probe.write_all(b"0").and_then(|()| probe.as_file().sync_all());
    written.map_err(|error| failed(dir, error))
}

/// Writes one trial into the library `dir` and returns the trial's folder, `SURFACE/USER-NUMBER`.
///
/// Storage loses nothing: a series becomes a 16-bit WAV file where that is exact, and an f32 one
/// where it is not; an image becomes PNG. A folder's name encodes the characters that folder names
/// cannot hold; `trial.toml` holds the true names.
///
/// # Errors
/// If a name is empty, the trial exists already, a signal differs from what `scene` says of its
/// source, WAV cannot hold a signal, or the file system refuses.
pub fn write_trial(
    dir: &Path,
    trial: &Trial,
    scene: &Scene,
    options: &TrialOptions,
) -> Result<PathBuf, LibraryError> {
    let folder = trial_folder(dir, &trial.key);
    // Checks first whether the folder exists, so that no trial is written in vain.
    let write = || UnfinishedTrial::write(dir, trial, scene, options)?.finish(&folder);
    if !folder.exists() && write()? {
        return Ok(folder);
    }
    let problem = format!(
        "there is a recording of {} already; choose another number, or remove it",
        trial.key
    );
    Err(LibraryError::file(&folder, problem))
}

/// Writes one trial into the library `dir`, like [`write_trial`]. Uses the next free number if the
/// trial's number is taken, even if another process takes it meanwhile. Returns number and folder.
///
/// # Errors
/// Like [`write_trial`], except that a taken number is no error.
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

/// A trial whose files are all written, but whose folder does not have its final name yet.
struct UnfinishedTrial<'a> {
    library: &'a Path,
    surface: PathBuf,
    options: &'a TrialOptions,
    /// A temporary folder with a random name for this trial alone. It is removed on drop.
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
        // Tries twice, since another program may just be removing the surface's empty folder.
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
            session: key.session.clone(),
            ..self.options.about.clone()
        };
        let (dir, durable) = (self.folder.path(), self.options.durable);
        write_file(&dir.join(crate::library::ABOUT_FILE), about.to_toml().as_bytes(), durable)?;
        if durable { sync_folder(dir) } else { Ok(()) }
    }

    /// Gives the folder its final name. Returns false if another trial has that name.
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

/// Prepares to create files and folders with random names, which readers of a library skip.
fn unfinished(prefix: &str) -> tempfile::Builder<'_, 'static> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(prefix).rand_bytes(16).suffix(UNFINISHED);
    builder
}

/// The folder `SURFACE/USER-NUMBER` of a trial, in the library `dir`.
pub(crate) fn trial_folder(dir: &Path, key: &TrialKey) -> PathBuf {
    dir.join(folder_name::encode(&key.surface)).join(trial_name(key))
}

/// The highest number among the folder names of a surface's trials (removed trials, too), plus 1.
/// To save time, this reads no `trial.toml`, which may give a trial another number.
pub fn number_by_names(dir: &Path, surface: &str) -> u32 {
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
            Signal::Series(series) => (dir.join(format!("{id}.wav")), wav(series).map_err(fail)?),
            Signal::Image(image) => (dir.join(format!("{id}.png")), png(image).map_err(fail)?),
        };
        write_file(&path, &bytes, options.durable)?;
    }
    Ok(())
}

/// Refuses a signal that a reader with the same scene would refuse.
fn check(spec: &SourceSpec, signal: &Signal) -> Result<(), String> {
    let series: &Series = match (signal, spec.domain == Domain::Image) {
        (Signal::Image(_), true) => return Ok(()),
        (Signal::Image(_), false) => return Err("an image, but the scene says a series".into()),
        (Signal::Series(_), true) => return Err("a series, but the scene says an image".into()),
        (Signal::Series(series), false) => series,
    };
    let (channels, expected) = (series.channels(), spec.channels);
    if channels != expected {
        return Err(format!("{channels} channels, but the scene says {expected}"));
    }
    match spec.rate_hz {
        Some(rate_hz) if rate_hz != series.rate_hz() => {
            Err(format!("{} Hz, but the scene says {rate_hz} Hz", series.rate_hz()))
        }
        _ => Ok(()),
    }
}

/// A series as WAV: 16-bit integers if they hold every sample exactly, else f32; or why it cannot.
fn wav(series: &Series) -> Result<Vec<u8>, String> {
    let rate_hz = series.rate_hz();
    let sample_rate = rate_hz.round() as u32;
    if sample_rate == 0 {
        return Err(format!("WAV files hold no rate as low as {rate_hz} Hz"));
    }
    let (samples, channels) = (series.samples(), series.channels());
    let (count, most) = (samples.len(), Series::MOST_SAMPLES);
    if count > most || channels > MOST_CHANNELS {
        return Err(format!(
            "{count} samples in {channels} channels are too many for a WAV file; expected at most \
             {most} and {MOST_CHANNELS}"
        ));
    }
    let short: Option<Vec<i16>> = samples.iter().map(|&x| as_i16(x)).collect();
    let (bits_per_sample, sample_format) =
        if short.is_some() { (16, SampleFormat::Int) } else { (32, SampleFormat::Float) };
    // There are at most MOST_CHANNELS channels, so the cast to u16 loses nothing.
    let spec = WavSpec { channels: channels as u16, sample_rate, bits_per_sample, sample_format };
    let mut bytes = Cursor::new(Vec::new());
    let write = || -> Result<(), hound::Error> {
        let mut writer = WavWriter::new(&mut bytes, spec)?;
        match short {
            Some(short) => short.into_iter().try_for_each(|x| writer.write_sample(x))?,
            None => samples.iter().try_for_each(|&x| writer.write_sample(x))?,
        }
        writer.finalize()
    };
    write().map_err(|error| error.to_string())?;
    let mut bytes = bytes.into_inner();
    if f64::from(sample_rate) != rate_hz {
        let chunk = [&EXACT_RATE[..], &8_u32.to_le_bytes(), &rate_hz.to_le_bytes()].concat();
        // The size of the file without its first 8 bytes, and the place of the first chunk.
        let size = (bytes.len() - 8 + chunk.len()) as u32;
        bytes[4..8].copy_from_slice(&size.to_le_bytes());
        bytes.splice(12..12, chunk);
    }
    Ok(bytes)
}

/// The 16-bit integer that is exactly 2^15 times the sample; `None` if there is none.
fn as_i16(sample: f32) -> Option<i16> {
    // Safe for any sample: the cast limits the value to the range of i16.
    let short = (sample * 32768.0) as i16;
    ((f32::from(short) / 32768.0).to_bits() == sample.to_bits()).then_some(short)
}

fn png(image: &Image) -> Result<Vec<u8>, String> {
    let (mut bytes, rgb8) = (Vec::new(), image::ExtendedColorType::Rgb8);
    image::codecs::png::PngEncoder::new(&mut bytes)
        .write_image(image.rgb(), Image::COLS as u32, Image::ROWS as u32, rgb8)
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

/// Waits until the disk holds the names of the files in a folder.
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
        _ => LibraryError::file(path, error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::library::series_file;

    #[test]
    fn only_what_is_exact_goes_into_16_bits() {
        assert_eq!([-1.0, 0.5].map(as_i16), [Some(-32768), Some(16384)]);
        assert_eq!([1.0, -0.0, 0.1, f32::MAX].map(as_i16), [None; 4]);
    }

    #[test]
    fn a_rate_that_is_no_whole_number_comes_back() {
        let dir = tempfile::tempdir().unwrap();
        for rate_hz in [12.5, 12.0, 119.05, 0.75] {
            let series = Series::new(rate_hz, 2, vec![0.25, 0.1, -0.5, 0.3]).unwrap();
            let path = dir.path().join("a.wav");
            fs::write(&path, wav(&series).unwrap()).unwrap();
            assert_eq!(series_file::read(&path).unwrap(), series);
            // Other programs read the nearest whole rate.
            let other = hound::WavReader::open(&path).unwrap();
            assert_eq!(f64::from(other.spec().sample_rate), rate_hz.round());
            assert_eq!(other.duration(), 2);
        }
        assert!(wav(&Series::new(0.25, 1, vec![0.0]).unwrap()).unwrap_err().contains("0.25 Hz"));
    }
}
