//! Trials that lie in files: what was promised when the library was opened, read when needed.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::wav::{self, Header};
use super::{LibraryError, LoadTrial, Outline, Outlines, files, picture, text};
use crate::scene::{Domain, SourceId, SourceSpec};
use crate::trial::{Signal, Trial, TrialKey};

/// Where the data of one source of one trial are.
#[derive(Debug)]
pub(crate) enum SourceFiles {
    /// One WAV file, and what its header said.
    Wav { path: PathBuf, header: Header },
    /// One picture.
    Picture(PathBuf),
    /// One text file a channel.
    Columns { paths: Vec<PathBuf>, rate_hz: f64 },
}

/// Reads one trial from its files.
#[derive(Debug)]
pub(crate) struct FileTrial {
    pub key: TrialKey,
    pub sources: BTreeMap<SourceId, SourceFiles>,
    /// The folder of the trial, in the recording format.
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

    fn folder(&self) -> Option<&Path> {
        self.folder.as_deref()
    }

    fn stamp(&self, wanted: &[SourceId]) -> Option<u64> {
        let known = self.sources.iter().filter(|(id, _)| wanted.contains(id));
        files::stamp(known.map(|(id, files)| (id, files.paths())))
    }
}

impl SourceFiles {
    fn paths(&self) -> &[PathBuf] {
        match self {
            Self::Wav { path, .. } | Self::Picture(path) => std::slice::from_ref(path),
            Self::Columns { paths, .. } => paths,
        }
    }

    fn outline(&self) -> Result<Option<Outline>, LibraryError> {
        Ok(match self {
            Self::Wav { header: Header { rate_hz, channels, frames }, .. } => {
                Some(Outline { rate_hz: *rate_hz, channels: *channels, frames: *frames })
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
            Self::Wav { path, header } => {
                let series = wav::read(path)?;
                if (series.rate_hz(), series.channels()) != (header.rate_hz, header.channels) {
                    let problem = "it changed since the library was opened; open it again";
                    return Err(LibraryError::file(path, problem));
                }
                Ok(Signal::Series(series))
            }
            Self::Picture(path) => picture::read(path).map(Signal::Image),
            Self::Columns { paths, rate_hz } => text::read(paths, *rate_hz).map(Signal::Series),
        }
    }
}

/// Checks headers while a library is opened: channels as described, one rate a source.
#[derive(Debug, Default)]
pub(crate) struct Headers {
    first: BTreeMap<SourceId, (f64, PathBuf)>,
}

impl Headers {
    /// A WAV file as the data of a source. `declared_hz` is the rate that the library's own
    /// description asks for.
    ///
    /// # Errors
    /// If the source is an image, if the file cannot be read, or if its channels or its rate are
    /// not those expected.
    pub fn wav(
        &mut self,
        spec: &SourceSpec,
        declared_hz: Option<f64>,
        path: &Path,
    ) -> Result<SourceFiles, LibraryError> {
        let id = &spec.id;
        let fail = |problem| Err(LibraryError::file(path, problem));
        if spec.domain == Domain::Image {
            return fail(format!(
                "a WAV file, but source `{id}` is an image; expected {id}.png or {id}.jpg"
            ));
        }
        let header = wav::probe(path)?;
        spec.check_rate(header.rate_hz).map_err(|problem| LibraryError::file(path, problem))?;
        if header.channels != spec.channels {
            return fail(format!(
                "{}, but source `{id}` has {}; expected one channel a column: record again, or \
                 correct `channels` of [sources.{id}] in library.toml",
                channels(header.channels),
                spec.channels,
            ));
        }
        if let Some(declared) = declared_hz
            && declared != header.rate_hz
        {
            return fail(format!(
                "its header says {} Hz, but library.toml says rate_hz = {declared} for source \
                 `{id}`; correct library.toml, or record again",
                header.rate_hz
            ));
        }
        let (rate_hz, first) =
            self.first.entry(id.clone()).or_insert_with(|| (header.rate_hz, path.to_path_buf()));
        if *rate_hz != header.rate_hz {
            return fail(format!(
                "two rates in one source: `{id}` has {} Hz here, but {rate_hz} Hz in {}; resample \
                 one of them (for example with `sox IN.wav -r {rate_hz} OUT.wav`), or remove it",
                header.rate_hz,
                first.display(),
            ));
        }
        Ok(SourceFiles::Wav { path: path.to_path_buf(), header })
    }
}

/// "1 channel", "2 channels".
pub(crate) fn channels(count: usize) -> String {
    if count == 1 { "1 channel".into() } else { format!("{count} channels") }
}
