//! Trials stored in files. Opening a library reads only the headers of the files, and checks rates
//! and channels. Samples are read when a trial is loaded.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use image::{DynamicImage, ImageDecoder, ImageReader};

use super::series_file::guarded;
use super::{LibraryError, LoadTrial, Outline, Outlines, files, series_file};
use crate::jpeg;
use crate::printable::counted;
use crate::scene::{Domain, SourceBlock, SourceId, SourceSpec};
use crate::trial::{Image, Series, Signal, SignalError, Trial, TrialKey};

/// The files of a source; `mixed` says how the two channels of a series become one, if they do.
#[derive(Debug)]
pub(crate) enum SourceFiles {
    Series { path: PathBuf, header: Outline, mixed: Option<Mix> },
    Picture(PathBuf),
    Columns { paths: Vec<PathBuf>, rate_hz: f64 },
}

/// How two channels become one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Mix {
    Mean,
    /// The louder channel of two in opposite phase, whose mean would lose the sound.
    Opposite(usize),
    /// The channel that is not silent beside the other.
    Alone(usize),
}

impl Mix {
    /// The way that loses least of a series of two channels.
    fn of(series: &Series) -> Self {
        let frames = series.frames() as f64;
        let mean = [0, 1].map(|channel| series.channel(channel).sum::<f64>() / frames);
        let mut products = [0.0; 3];
        for (a, b) in series.channel(0).zip(series.channel(1)) {
            let (a, b) = (a - mean[0], b - mean[1]);
            products = [products[0] + a * a, products[1] + b * b, products[2] + a * b];
        }
        let [left, right, both] = products;
        let louder = usize::from(right > left);
        // A hundredth of the power is 20 dB.
        if left.min(right) < 0.01 * left.max(right) {
            return Self::Alone(louder);
        }
        if both < -0.5 * (left * right).sqrt() { Self::Opposite(louder) } else { Self::Mean }
    }

    fn apply(self, series: &Series) -> Result<Series, SignalError> {
        let one = |frame: &[f32]| match self {
            Self::Mean => frame.iter().sum::<f32>() / frame.len() as f32,
            Self::Opposite(channel) | Self::Alone(channel) => frame[channel],
        };
        let samples = series.samples().chunks_exact(series.channels()).map(one).collect();
        Series::new(series.rate_hz(), 1, samples)
    }

    fn remark(self, id: &SourceId) -> String {
        match self {
            Self::Mean => format!("stereo, mixed down to the one channel of source `{id}`"),
            Self::Opposite(_) => format!(
                "stereo with sides of opposite phase, of which only the louder side is used for source \
                 `{id}`; check how the microphone is wired"
            ),
            Self::Alone(_) => format!(
                "stereo with a dead side (20 dB below the other), so only the other side is used for \
                 source `{id}`"
            ),
        }
    }
}

#[derive(Debug)]
pub(crate) struct FileTrial {
    pub key: TrialKey,
    pub sources: BTreeMap<SourceId, SourceFiles>,
    /// The folder that holds only this trial; `None` if there is no such folder.
    pub folder: Option<PathBuf>,
}

impl LoadTrial for FileTrial {
    fn load(&self, wanted: &[SourceId]) -> Result<Trial, LibraryError> {
        let known = self.sources.iter().filter(|(id, _)| wanted.contains(id));
        let signals = known.map(|(id, files)| Ok((id.clone(), files.read()?)));
        Ok(Trial { key: self.key.clone(), signals: signals.collect::<Result<_, LibraryError>>()? })
    }

    fn outlines(&self, wanted: &[SourceId]) -> Result<Outlines, LibraryError> {
        let mut outlines = Outlines::new();
        for (id, files) in self.sources.iter().filter(|(id, _)| wanted.contains(id)) {
            outlines.extend(files.outline()?.map(|outline| (id.clone(), outline)));
        }
        Ok(outlines)
    }

    fn places(&self) -> Vec<&Path> {
        if let Some(folder) = &self.folder {
            return vec![folder];
        }
        let files = self.sources.values().flat_map(SourceFiles::paths);
        let mut files: Vec<&Path> = files.map(PathBuf::as_path).collect();
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
            Self::Series { header, mixed: Some(_), .. } => Some(Outline { channels: 1, ..*header }),
            Self::Series { header, .. } => Some(*header),
            Self::Picture(_) => None,
            Self::Columns { paths, rate_hz } => {
                let frames = frames_of_columns(paths)?;
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
                let Some(mix) = mixed else { return Ok(Signal::Series(series)) };
                mix.apply(&series).map(Signal::Series).map_err(LibraryError::at(path))
            }
            Self::Picture(path) => read_picture(path).map(Signal::Image),
            Self::Columns { paths, rate_hz } => {
                let series = read_columns(paths, *rate_hz)?;
                plausible(&paths[0], &series)?;
                Ok(Signal::Series(series))
            }
        }
    }
}

/// Reads one text file for each channel, and cuts all channels to the length of the shortest.
fn read_columns(paths: &[PathBuf], rate_hz: f64) -> Result<Series, LibraryError> {
    let column = |path: &PathBuf| {
        let bytes = files::read_bytes(path, files::MOST_TEXT)?;
        parse_column(&bytes).map_err(LibraryError::at(path))
    };
    let columns = paths.iter().map(column).collect::<Result<Vec<_>, _>>()?;
    let frames = columns.iter().map(Vec::len).min().unwrap_or(0);
    let mut samples = Vec::with_capacity(frames * columns.len());
    for frame in 0..frames {
        samples.extend(columns.iter().map(|column| column[frame]));
    }
    Series::new(rate_hz, columns.len(), samples).map_err(LibraryError::at(&paths[0]))
}

/// The number of frames that [`read_columns`] would give: the non-blank lines of the shortest file.
fn frames_of_columns(paths: &[PathBuf]) -> Result<usize, LibraryError> {
    let lines = |path: &PathBuf| -> Result<usize, LibraryError> {
        let bytes = files::read_bytes(path, files::MOST_TEXT)?;
        let lines = bytes.split(|&byte| byte == b'\n');
        Ok(lines.filter(|line| !line.trim_ascii().is_empty()).count())
    };
    let lengths = paths.iter().map(lines).collect::<Result<Vec<_>, _>>()?;
    Ok(lengths.into_iter().min().unwrap_or(0))
}

/// Parses a text with one number in each line; blank lines are allowed only at the end.
fn parse_column(bytes: &[u8]) -> Result<Vec<f32>, String> {
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    let mut numbers = Vec::with_capacity(bytes.len() / 8);
    let mut blank = None;
    for (line, text) in (1..).zip(bytes.split(|&byte| byte == b'\n')) {
        let text = text.trim_ascii();
        if text.is_empty() {
            blank = blank.or(Some(line));
            continue;
        }
        if let Some(line) = blank {
            return Err(format!(
                "line {line}: blank, but numbers follow; expected one number a line"
            ));
        }
        let number = std::str::from_utf8(text).ok().and_then(|text| text.parse::<f64>().ok());
        match number.map(|number| number as f32) {
            Some(number) if number.is_finite() => numbers.push(number),
            Some(_) => {
                return Err(format!(
                    "line {line}: {}; expected a finite number (a broken cable gives such values: \
                     check the connector, then record again or remove the file)",
                    String::from_utf8_lossy(text)
                ));
            }
            None => return Err(format!("line {line}: {}", not_a_number(text))),
        }
    }
    if numbers.is_empty() {
        return Err("it holds no numbers; record again, or remove the file".into());
    }
    Ok(numbers)
}

fn not_a_number(text: &[u8]) -> String {
    let shown: String = String::from_utf8_lossy(text).chars().take(40).collect();
    let hint = if text.contains(&b',') { "; write decimals with a point, not a comma" } else { "" };
    format!("`{}` is not a number; expected one number a line{hint}", shown.escape_debug())
}

/// Refuses samples beyond ±1e18: their squares may overflow f32 and spoil means over the library.
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

const MOST_PICTURE: u64 = 1 << 26;

/// Reads a picture of 320 × 480 pixels, or of 480 × 320.
fn read_picture(path: &Path) -> Result<Image, LibraryError> {
    let bytes = files::read_bytes(path, MOST_PICTURE)?;
    let damaged = |why: &str| {
        LibraryError::file(
            path,
            format!(
                "the picture cannot be decoded ({why}); expected a whole PNG or JPEG file: copy it \
                 again from where it came, take it again, or remove it"
            ),
        )
    };
    if jpeg::is_cut_short(&bytes) {
        return Err(damaged("it is truncated"));
    }
    guarded(
        || {
            let reader = jpeg::reader(&bytes).and_then(ImageReader::into_decoder);
            let decoder = reader.map_err(|error| damaged(&error.to_string()))?;
            let (width, height) = decoder.dimensions();
            let (width, height) = (width as usize, height as usize);
            // Checks the size first: a picture of a wrong size need not be decoded.
            if ![(Image::COLS, Image::ROWS), (Image::ROWS, Image::COLS)].contains(&(width, height))
            {
                return Err(LibraryError::file(path, SignalError::ImageSize { width, height }));
            }
            let picture = DynamicImage::from_decoder(decoder);
            let picture = picture.map_err(|error| damaged(&error.to_string()))?;
            Image::new(width, height, picture.into_rgb8().into_raw())
                .map_err(LibraryError::at(path))
        },
        damaged,
    )
}

/// The remark on sounds in a lossy form, made once for all of them.
const LOSSY_REMARK: &str = "lossy coding changes a sound, most of all in the bands above its cut; \
                            compare only what was coded alike, or record as WAV or FLAC";

/// Checks the headers of a library's series against the described channels and rates.
#[derive(Debug, Default)]
pub(crate) struct Headers {
    pub root: PathBuf,
    first: BTreeMap<SourceId, (f64, PathBuf)>,
    /// For each source: the lowest rate of a file, in Hz, that is too low for the default band.
    pub lowest_hz: BTreeMap<SourceId, f64>,
    pub remarks: Remarks,
}

impl Headers {
    /// A check of a library in the folder `root`, on which there are some `remarks` already.
    pub(crate) fn new(root: &Path, remarks: Remarks) -> Self {
        Self { root: root.to_path_buf(), remarks, ..Self::default() }
    }

    pub(crate) fn note(&mut self, path: &Path, what: impl Into<String>) {
        let place = path.strip_prefix(&self.root).unwrap_or(path).display();
        self.remarks.add(what, place.to_string());
    }

    /// Checks that a file can be a source's data. `declared` is what `library.toml` says of it.
    pub(crate) fn series(
        &mut self,
        spec: &SourceSpec,
        declared: &SourceBlock,
        path: &Path,
    ) -> Result<SourceFiles, LibraryError> {
        let id = &spec.id;
        let fail = |problem| Err(LibraryError::file(path, problem));
        if spec.domain == Domain::Image {
            let kind = files::extension(path).to_uppercase();
            return fail(format!(
                "a {kind} file, but source `{id}` is an image; expected {id}.png or {id}.jpg"
            ));
        }
        let header = series_file::probe(path)?;
        if let Err(problem) = spec.check_rate(header.rate_hz) {
            if declared.band_hz.is_some() {
                return fail(problem);
            }
            let lowest = self.lowest_hz.entry(id.clone()).or_insert(header.rate_hz);
            *lowest = lowest.min(header.rate_hz);
        }
        let mixed = (header.channels, spec.channels) == (2, 1);
        if header.channels != spec.channels && !mixed {
            return fail(format!(
                "{}, but source `{id}` has {}; expected one channel for each column: record again, or \
                 say in library.toml: [sources.{id}] channels = {}",
                counted(header.channels, "channel"),
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
        // The samples alone say which side to take, so a stereo file is read here, too.
        let mixed = mixed.then(|| series_file::read(path).map(|series| Mix::of(&series)));
        let mixed = mixed.transpose()?;
        if let Some(mix) = mixed {
            self.note(path, mix.remark(id));
        }
        if series_file::is_lossy(path) {
            self.note(path, LOSSY_REMARK);
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
            self.note(path, what);
        }
        Ok(SourceFiles::Series { path: path.to_path_buf(), header, mixed })
    }
}

/// Remarks, each with the files that it applies to.
#[derive(Debug, Default)]
pub(crate) struct Remarks(pub BTreeMap<String, Vec<String>>);

impl Remarks {
    pub(crate) fn add(&mut self, what: impl Into<String>, place: String) {
        self.0.entry(what.into()).or_default().push(place);
    }

    /// Each remark as one line: its first file, the number of its further files, and its text.
    pub(crate) fn lines(&self) -> impl Iterator<Item = String> {
        self.0.iter().map(|(what, places)| match places.len() {
            1 => format!("{}: {what}", places[0]),
            count => format!("{} and {} more: {what}", places[0], count - 1),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spaces_line_ends_and_a_blank_last_line_do_not_matter() {
        let text = b"\xef\xbb\xbf  1.5\r\n-2e-1\t\r\n3\n\n";
        assert_eq!(parse_column(text).unwrap(), [1.5, -0.2, 3.0]);
        assert_eq!(parse_column(b"1\n2").unwrap(), [1.0, 2.0]);
    }

    #[test]
    fn what_is_no_number_is_named_with_its_line() {
        for (text, begin, part) in [
            ("1\n0,5\n", "line 2: `0,5` is not a number", "point"),
            ("1\n2\nNaN\n", "line 3: NaN", "finite"),
            ("1\n2\ninf\n", "line 3: inf", "finite"),
            ("1\n2\n-Infinity\n", "line 3: -Infinity", "finite"),
            ("1\n2\n1e99\n", "line 3: 1e99", "finite"),
            ("1\n\n2\n", "line 2: blank, but numbers follow", "one number a line"),
            ("1 2\n", "line 1: `1 2` is not", "one number a line"),
            ("\n\n", "it holds no numbers", "record again"),
        ] {
            let said = parse_column(text.as_bytes()).unwrap_err();
            assert!(said.starts_with(begin) && said.contains(part), "{said}");
        }
    }
}
