//! Trials in files: their headers are read and checked against each other when the library is opened
//! (rates, channels), their samples when they are needed.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::series_file;
use super::series_header::Header;
use super::{LibraryError, LoadTrial, Outline, Outlines, files, picture, text};
use crate::scene::{Declared, Domain, SourceId, SourceSpec};
use crate::trial::{Series, Signal, SignalError, Trial, TrialKey};

/// The files of one source of one trial.
#[derive(Debug)]
pub(crate) enum SourceFiles {
    /// One WAV or FLAC file, what its header said, and whether its two channels become one.
    Series {
        path: PathBuf,
        header: Header,
        mixed: bool,
    },
    Picture(PathBuf),
    /// One text file a channel.
    Columns {
        paths: Vec<PathBuf>,
        rate_hz: f64,
    },
}

/// Reads one trial from its files.
#[derive(Debug)]
pub(crate) struct FileTrial {
    pub key: TrialKey,
    pub sources: BTreeMap<SourceId, SourceFiles>,
    /// The trial's own folder; `None` for files without one.
    pub folder: Option<PathBuf>,
}

impl LoadTrial for FileTrial {
    fn load(&self, wanted: &[SourceId]) -> Result<Trial, LibraryError> {
        let signals = self
            .sources
            .iter()
            .filter(|(id, _)| wanted.contains(id))
            .map(|(id, files)| Ok((id.clone(), files.read()?)))
            .collect::<Result<_, LibraryError>>()?;
        Ok(Trial { key: self.key.clone(), signals })
    }

    fn outlines(&self, wanted: &[SourceId]) -> Result<Option<Outlines>, LibraryError> {
        let mut outlines = Outlines::new();
        for (id, files) in self.sources.iter().filter(|(id, _)| wanted.contains(id)) {
            outlines.extend(files.outline()?.map(|outline| (id.clone(), outline)));
        }
        Ok(Some(outlines))
    }

    fn places(&self) -> Vec<&Path> {
        if let Some(folder) = &self.folder {
            return vec![folder];
        }
        let mut files: Vec<&Path> =
            self.sources.values().flat_map(SourceFiles::paths).map(PathBuf::as_path).collect();
        files.sort();
        files
    }

    fn stamp(&self, wanted: &[SourceId]) -> Option<u64> {
        let known = self.sources.iter().filter(|(id, _)| wanted.contains(id));
        files::stamp(known.map(|(id, files)| (id, files.paths())))
    }
}

impl SourceFiles {
    fn paths(&self) -> &[PathBuf] {
        match self {
            Self::Series { path, .. } | Self::Picture(path) => std::slice::from_ref(path),
            Self::Columns { paths, .. } => paths,
        }
    }

    fn outline(&self) -> Result<Option<Outline>, LibraryError> {
        Ok(match self {
            Self::Series { header: Header { rate_hz, channels, frames }, mixed, .. } => {
                let channels = if *mixed { 1 } else { *channels };
                Some(Outline { rate_hz: *rate_hz, channels, frames: *frames })
            }
            Self::Picture(_) => None,
            Self::Columns { paths, rate_hz } => {
                let frames = text::frames(paths)?;
                Some(Outline { rate_hz: *rate_hz, channels: paths.len(), frames })
            }
        })
    }

    fn read(&self) -> Result<Signal, LibraryError> {
        match self {
            Self::Series { path, header, mixed } => {
                let series = series_file::read(path)?;
                plausible(path, &series)?;
                if (series.rate_hz(), series.channels()) != (header.rate_hz, header.channels) {
                    let problem = "it changed since the library was opened; open it again";
                    return Err(LibraryError::file(path, problem));
                }
                if !mixed {
                    return Ok(Signal::Series(series));
                }
                mixed_down(&series)
                    .map_err(|error| LibraryError::Signal { path: path.clone(), error })
                    .map(Signal::Series)
            }
            Self::Picture(path) => picture::read(path).map(Signal::Image),
            Self::Columns { paths, rate_hz } => {
                let series = text::read(paths, *rate_hz)?;
                plausible(&paths[0], &series)?;
                Ok(Signal::Series(series))
            }
        }
    }
}

/// Refuses samples whose squares may overflow f32, which would spoil every mean over a library.
fn plausible(path: &Path, series: &Series) -> Result<(), LibraryError> {
    const MOST: f32 = 1e18;
    let Some(at) = series.samples().iter().position(|x| x.abs() > MOST) else { return Ok(()) };
    let (frame, channel) = (at / series.channels() + 1, at % series.channels() + 1);
    let problem = format!(
        "channel {channel} is {:e} at sample {frame}, which no sensor gives; expected at most \
         ±{MOST:e}: record again, or remove the file",
        series.samples()[at]
    );
    Err(LibraryError::file(path, problem))
}

/// The mean of all channels.
fn mixed_down(series: &Series) -> Result<Series, SignalError> {
    let channels = series.channels();
    let mean = |frame: &[f32]| frame.iter().sum::<f32>() / channels as f32;
    Series::new(series.rate_hz(), 1, series.samples().chunks_exact(channels).map(mean).collect())
}

/// Checks, while a library is opened, that headers have the channels and rates described.
#[derive(Debug, Default)]
pub(crate) struct Headers {
    first: BTreeMap<SourceId, (f64, PathBuf)>,
    /// The lowest rate in Hz of each source with files whose rate is too low for its default band.
    pub lowest_hz: BTreeMap<SourceId, f64>,
    remarks: Vec<(PathBuf, String)>,
}

impl Headers {
    /// A WAV or FLAC file as the data of a source. `declared` is what the library's own description
    /// asks for.
    ///
    /// # Errors
    /// If the source is an image, if the file cannot be read, if its channels are not those
    /// expected, or if its rate is not the one declared or too low for the band declared.
    pub fn series(
        &mut self,
        spec: &SourceSpec,
        declared: Declared,
        path: &Path,
    ) -> Result<SourceFiles, LibraryError> {
        let id = &spec.id;
        let fail = |problem| Err(LibraryError::file(path, problem));
        if spec.domain == Domain::Image {
            let kind = if path.extension().is_some_and(|ext| ext.eq_ignore_ascii_case("flac")) {
                "FLAC"
            } else {
                "WAV"
            };
            return fail(format!(
                "a {kind} file, but source `{id}` is an image; expected {id}.png or {id}.jpg"
            ));
        }
        let header = series_file::probe(path)?;
        if let Err(problem) = spec.check_rate(header.rate_hz) {
            if declared.band {
                return fail(problem);
            }
            let lowest = self.lowest_hz.entry(id.clone()).or_insert(header.rate_hz);
            *lowest = lowest.min(header.rate_hz);
        }
        let mixed = (header.channels, spec.channels) == (2, 1);
        if header.channels != spec.channels && !mixed {
            return fail(format!(
                "{}, but source `{id}` has {}; expected one channel a column: record again, or \
                 say in library.toml: [sources.{id}] channels = {}",
                channels(header.channels),
                spec.channels,
                header.channels,
            ));
        }
        if let Some(declared) = declared.rate_hz
            && declared != header.rate_hz
        {
            return fail(format!(
                "its header says {} Hz, but library.toml says rate_hz = {declared} for source \
                 `{id}`; correct library.toml, or record again",
                header.rate_hz
            ));
        }
        self.remark(spec, header, mixed, path);
        Ok(SourceFiles::Series { path: path.to_path_buf(), header, mixed })
    }

    /// Notes what is unusual about a file that is used all the same.
    fn remark(&mut self, spec: &SourceSpec, header: Header, mixed: bool, path: &Path) {
        let id = &spec.id;
        if mixed {
            let what = format!("stereo, mixed down to the one channel of source `{id}`");
            self.remarks.push((path.to_path_buf(), what));
        }
        let (rate_hz, first) =
            self.first.entry(id.clone()).or_insert_with(|| (header.rate_hz, path.to_path_buf()));
        if *rate_hz != header.rate_hz {
            let what = format!(
                "source `{id}` has {} Hz here, but {rate_hz} Hz in {}; method `embedding` compares \
                 them by frequency in Hz, the others need one rate",
                header.rate_hz,
                first.display(),
            );
            self.remarks.push((path.to_path_buf(), what));
        }
    }

    /// Remarks on unusual files that are used all the same, in the order of the files.
    pub fn remarks(&mut self) -> Vec<(PathBuf, String)> {
        std::mem::take(&mut self.remarks)
    }
}

/// "1 channel", "2 channels".
pub(crate) fn channels(count: usize) -> String {
    if count == 1 { "1 channel".into() } else { format!("{count} channels") }
}
