//! Reading WAV files: what the header promises, checked against what is there.

use std::fs::File;
use std::io::{BufReader, Seek};
use std::path::Path;

use hound::{SampleFormat, WavReader};

use super::LibraryError;
use super::files::EMPTY_FILE;
use crate::trial::Series;

/// What a WAV header says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Header {
    pub rate_hz: f64,
    pub channels: usize,
    pub frames: usize,
}

/// Reads a header and checks that the file is long enough to hold what it promises.
///
/// # Errors
/// If the file cannot be read, is empty, is no WAV file, holds no samples, or is cut short.
pub(crate) fn probe(path: &Path) -> Result<Header, LibraryError> {
    let reader = open(path)?;
    let (spec, samples) = (reader.spec(), reader.len());
    let mut file = reader.into_inner();
    let fail = |error| LibraryError::io(path, error);
    let start = file.stream_position().map_err(fail)?;
    let rest = file.get_ref().metadata().map_err(fail)?.len().saturating_sub(start);
    if samples == 0 {
        return Err(LibraryError::file(
            path,
            match rest {
                0 | 1 => "it holds no samples; record again, or remove the file".to_string(),
                _ => format!(
                    "its header promises no samples, but {rest} bytes follow: the recording \
                     ended before its header was written; mend the header (for example with \
                     `sox --ignore-length`), or record again"
                ),
            },
        ));
    }
    // A lower bound: 24 bits may be stored in four bytes. Reading finds what this lets through.
    let promised = u64::from(samples) * u64::from(spec.bits_per_sample.div_ceil(8));
    if rest < promised {
        return Err(truncated(path, Some((rest, promised))));
    }
    let channels = usize::from(spec.channels);
    let frames = samples as usize / channels.max(1);
    Ok(Header { rate_hz: f64::from(spec.sample_rate), channels, frames })
}

/// Reads a whole file; integers are scaled to ±1, that is value / 2^(bits − 1).
///
/// # Errors
/// As [`probe`], and if a sample is not finite.
pub(crate) fn read(path: &Path) -> Result<Series, LibraryError> {
    let header = probe(path)?;
    let reader = open(path)?;
    let spec = reader.spec();
    let scale = 1.0 / 2f64.powi(i32::from(spec.bits_per_sample) - 1);
    let samples: Result<Vec<f32>, _> = match spec.sample_format {
        SampleFormat::Float => reader.into_samples::<f32>().collect(),
        SampleFormat::Int => reader
            .into_samples::<i32>()
            .map(|sample| sample.map(|value| (f64::from(value) * scale) as f32))
            .collect(),
    };
    let samples = samples.map_err(|error| explain(path, error))?;
    Series::new(header.rate_hz, header.channels, samples)
        .map_err(|error| LibraryError::Signal { path: path.to_path_buf(), error })
}

fn open(path: &Path) -> Result<WavReader<BufReader<File>>, LibraryError> {
    let fail = |error| LibraryError::io(path, error);
    let file = File::open(path).map_err(fail)?;
    if file.metadata().map_err(fail)?.len() == 0 {
        return Err(LibraryError::file(path, EMPTY_FILE));
    }
    WavReader::new(BufReader::new(file)).map_err(|error| explain(path, error))
}

fn explain(path: &Path, error: hound::Error) -> LibraryError {
    match error {
        // hound reports a short read as an error of kind `Other`, without a number of the system.
        hound::Error::IoError(error) if error.raw_os_error().is_none() => truncated(path, None),
        hound::Error::IoError(error) => LibraryError::io(path, error),
        error => LibraryError::file(
            path,
            format!(
                "not a WAV file that can be read ({error}); expected 16-bit, 24-bit or f32 PCM"
            ),
        ),
    }
}

fn truncated(path: &Path, sizes: Option<(u64, u64)>) -> LibraryError {
    let sizes = sizes.map_or(String::new(), |(found, promised)| {
        format!(" ({found} of {promised} bytes of samples)")
    });
    LibraryError::file(
        path,
        format!(
            "truncated: the file ends before what its header promises{sizes}; copy it again from \
             where it came, record again, or remove it"
        ),
    )
}
