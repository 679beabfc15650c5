//! Files that hold one series, a channel a column: WAV or FLAC, by their extension.

use std::path::Path;

use super::{LibraryError, flac, wav};
use crate::trial::Series;

/// The extensions of such files, in lower case.
pub(crate) const EXTENSIONS: [&str; 2] = ["wav", "flac"];

/// What the header of such a file says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Header {
    pub rate_hz: f64,
    pub channels: usize,
    pub frames: usize,
}

/// Reads a header and checks that the file can hold what it promises.
///
/// # Errors
/// If the file cannot be read, is empty, is of another format, holds no samples or more than
/// [`Series::MOST_SAMPLES`], or, as far as that can be seen from outside, is cut short.
pub(crate) fn probe(path: &Path) -> Result<Header, LibraryError> {
    if is_flac(path) { flac::probe(path) } else { wav::probe(path) }
}

/// Reads a whole file; integers are scaled to ±1, that is value / 2^(bits − 1).
///
/// # Errors
/// As [`probe`], if the file is damaged, or if a sample is not finite.
pub(crate) fn read(path: &Path) -> Result<Series, LibraryError> {
    if is_flac(path) { flac::read(path) } else { wav::read(path) }
}

fn is_flac(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("flac"))
}

/// What to say of a file that is too long for a trial.
pub(super) fn too_long(header: Header) -> Option<String> {
    let Header { rate_hz, channels, frames } = header;
    let samples = frames.saturating_mul(channels);
    (samples > Series::MOST_SAMPLES).then(|| {
        format!(
            "{:.0} minutes are too long for a trial: {samples} samples, but at most {} are read; \
             cut the recording into trials",
            frames as f64 / rate_hz.max(1.0) / 60.0,
            Series::MOST_SAMPLES,
        )
    })
}
