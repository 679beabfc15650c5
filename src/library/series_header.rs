//! The header of a file that holds one series.

use crate::trial::Series;

/// The extensions of files that hold one series, in lower case.
pub(crate) const EXTENSIONS: [&str; 2] = ["wav", "flac"];

/// Rate and size of a series, by its header.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Header {
    pub rate_hz: f64,
    pub channels: usize,
    pub frames: usize,
}

/// The error of a file that is too long for a trial.
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
