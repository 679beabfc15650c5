//! Files that hold one series: WAV or FLAC, by their extension.

use std::path::Path;

use super::series_header::Header;
use super::{LibraryError, flac, wav};
use crate::trial::Series;

/// Reads a header and checks, for WAV, that the file is long enough for the samples it promises.
///
/// # Errors
/// If the file cannot be read, is empty, is of another format, holds no samples or more than
/// [`Series::MOST_SAMPLES`], or, for WAV, is cut short.
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
