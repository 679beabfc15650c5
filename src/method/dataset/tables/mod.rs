//! Reads recordings from tables: text or Parquet with a row for each sample, or arrays of NumPy and MATLAB.
//! A table holds one trial, or many trials named by columns. Other columns become sources. The rows have a
//! fixed rate, or a column of times.
//!
//! A table is read once, row by row, so that its size does not matter: `layout` finds out how it is
//! written, `columns` what its columns are, `gather` collects rows by trial, and `mend` makes trials
//! with a fixed rate of them.

mod array;
#[doc(hidden)]
pub mod array_file;
mod cell;
#[doc(hidden)]
pub mod columns;
mod gather;
mod grid;
mod heading;
mod layout;
mod mat;
mod mend;
mod names;
mod npy;
#[cfg(feature = "parquet")]
mod parquet;
mod rates;
mod stamp;
mod table;
mod text;

use std::collections::{BTreeMap, BTreeSet};
#[cfg(feature = "parquet")]
use std::io::{Read as _, Seek as _};
use std::path::{Path, PathBuf};

use gather::Rows;
use layout::{Layout, Line};
#[doc(hidden)]
pub use mend::Gaps;
use mend::Piece;
pub use names::{NamePattern, named};
use names::{Parts, name_of};
use rates::{in_order, mend_sources};
use stamp::Stamps;
use table::Table;
use text::Lines;

use crate::library::{About, LibraryError, files};
use crate::scene::SourceId;
use crate::trial::{Series, Signal, Trial, TrialKey, checked_session, utc};

/// Lines and bytes that decide how a table is understood.
const HEAD_LINES: usize = 2000;
const HEAD_BYTES: usize = 1 << 20;
/// A trial with more channels than this has at least as many samples.
pub const MOST_TURNED: usize = 16;

/// How to find the time of each row of a table.
#[derive(Clone, Debug, PartialEq)]
pub enum Clock {
    /// Rows a second.
    Rate(f64),
    /// A column, and its unit of time in seconds; `None`: its header or its values say it.
    Times { column: String, unit_s: Option<f64> },
}

/// Origin of the name of the session of a table's trials, if no column holds it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SessionOf {
    /// The pattern of the file's path that also names the surface, if it has the field.
    Names,
    Pattern(NamePattern),
    /// The file's path, without the one of these folders that it lies in.
    File(Vec<PathBuf>),
    Nothing,
}

/// How to read the tables of one import.
#[derive(Clone, Debug)]
pub struct Form {
    /// Each source, with the names of the columns that are its channels.
    pub sources: Vec<(SourceId, Vec<String>)>,
    /// The names of all columns of the first table; empty for arrays.
    pub known: BTreeSet<String>,
    /// The units of these columns in the first table; empty if they need not be the same.
    pub units: Vec<Option<String>>,
    pub clock: Clock,
    /// The columns with the names of surface, user, trial and session; `None` if there is no such column. For an
    /// array, its trials' labels: arrays of the same file, or other files.
    pub labels: [Option<String>; 4],
    pub session: SessionOf,
    /// Pattern of the file's path, which names what no column names; `None` if columns name all.
    pub names: Option<NamePattern>,
    /// The array of an `.npz` or `.mat` that holds the trials.
    pub variable: Option<String>,
    pub gaps: Gaps,
    /// Whether Excel's days count from 1904.
    pub from_1904: bool,
    /// The largest number of bytes that a packed file may unpack to.
    pub most_unpacked: u64,
}

/// The first rows of a table, and its layout.
pub struct Head {
    pub layout: Layout,
    rows: Vec<Vec<Vec<u8>>>,
    /// The line with the names of the columns, which programs repeat when they begin anew.
    names: Vec<u8>,
}

impl Head {
    /// Reads the first lines of a table, and finds out its layout.
    pub fn read(path: &Path, most_unpacked: u64) -> Result<Self, LibraryError> {
        let mut lines = lines(path, most_unpacked)?;
        Self::of(&mut lines).map_err(LibraryError::at(path))
    }

    fn of(lines: &mut Lines) -> Result<Self, String> {
        let (mut head, mut size) = (Vec::new(), 0);
        while let Some((number, line)) = lines.next()? {
            size += line.len();
            head.push((number, line.to_vec()));
            if head.len() >= HEAD_LINES || size > HEAD_BYTES {
                break;
            }
        }
        let layout = lines.layout.take().map_or_else(|| Layout::of(&head), Ok)?;
        let mut rows = Vec::new();
        let names = head.iter().find(|(number, _)| *number == layout.names_at);
        let names = names.map(|(_, line)| line.clone()).unwrap_or_default();
        let rows_in_it =
            head.iter().filter(|(number, line)| *number >= layout.first && *line != names);
        for (number, line) in rows_in_it {
            let mut cells = Vec::new();
            match layout.cells(line, &mut cells) {
                Ok(Line::Row) => rows.push(cells.into_iter().map(<[u8]>::to_vec).collect()),
                Ok(Line::Nothing | Line::Text) => {}
                Err(_) if lines.is_cut() && head.last().is_some_and(|(last, _)| last == number) => {
                }
                Err(problem) => return Err(format!("line {number} {problem}")),
            }
        }
        Ok(Self { layout, rows, names })
    }

    /// The units of the columns of these sources.
    ///
    /// # Errors
    /// If a column is not there.
    pub fn units(&self, sources: &[columns::Wanted]) -> Result<Vec<Option<String>>, String> {
        let names = sources.iter().flat_map(|(_, columns)| columns);
        names.map(|name| Ok(self.layout.columns[self.layout.column(name)?].unit.clone())).collect()
    }

    /// The first cells of a column.
    pub(crate) fn cells(&self, column: usize) -> Vec<Vec<u8>> {
        self.rows.iter().filter_map(|row| row.get(column).cloned()).collect()
    }
}

/// The lines of a table; `most_unpacked` is the largest number of bytes that a packed file may unpack to.
fn lines(path: &Path, most_unpacked: u64) -> Result<Lines, LibraryError> {
    let (file, _) = files::open_filled(path)?;
    #[cfg(feature = "parquet")]
    {
        let (mut start, mut from) = (Vec::new(), &file);
        let read = from.take(4).read_to_end(&mut start).and_then(|_| from.rewind());
        read.map_err(|error| LibraryError::io(path, error))?;
        if start == parquet::MAGIC {
            return parquet::lines(file, most_unpacked).map_err(LibraryError::at(path));
        }
    }
    Lines::new(Box::new(file), most_unpacked).map_err(LibraryError::at(path))
}

pub struct Read {
    pub trial: Trial,
    pub about: About,
    /// Whether this is a part after a gap, which needs another number than the trial.
    pub is_further: bool,
}

/// Takes the names of trials that come, or one that was read.
type OnRead<'a> = &'a mut dyn FnMut(&[TrialKey], Option<Read>) -> Result<(), LibraryError>;

/// Remarks on a table that was read.
#[derive(Debug, Default)]
pub struct Said {
    /// How the times were understood.
    pub times: Option<String>,
    /// Rows a second, if they were interpolated in time.
    pub resampled_hz: Option<f64>,
    /// Whether sources have rows and rates of their own.
    pub own_rates: bool,
    /// Rows that came after rows of later times.
    pub overtaken: usize,
    pub repeated: usize,
    pub filled: usize,
    /// Trials that were cut, and parts that were too short.
    pub cut: usize,
    pub too_short: usize,
    pub bad: Vec<String>,
    /// Lines that are no whole rows of numbers, and rows without a label.
    pub no_rows: usize,
    pub unlabelled: usize,
    /// Columns whose samples lose most of their steps when they are rounded to 24 bits.
    pub coarse: BTreeSet<String>,
    /// Channels of an array that rise like a clock or a counter.
    pub running: BTreeSet<String>,
    /// Columns of numbers that the first table does not have.
    pub further: BTreeSet<String>,
    /// The column by which trials begin anew.
    pub parted_by: Option<String>,
}

/// Reads all trials of a table. Calls `on` with the names of all trials first, and then with each trial;
/// an error of `on` ends it. `scratch` is a folder for rows that do not fit into memory.
pub fn read(
    path: &Path,
    form: &Form,
    scratch: &Path,
    on: OnRead<'_>,
) -> Result<Said, LibraryError> {
    let fail = LibraryError::at(path);
    if array_file::is_array(path) {
        return array_file::read(path, form, on);
    }
    let head = Head::read(path, form.most_unpacked)?;
    let mut lines = lines(path, form.most_unpacked)?;
    let table = Table::new(&head, form).map_err(fail)?;
    let mut gathered = table.gather(path, form, &mut lines, scratch).map_err(fail)?;
    let mut said = std::mem::take(&mut gathered.said);
    said.times = table.said.clone();
    let keys: Vec<TrialKey> = gathered.groups.iter().map(|group| group.key.clone()).collect();
    on(&keys, None)?;
    for at in 0..gathered.groups.len() {
        let key = gathered.groups[at].key.clone();
        let rows = gathered.take(at).map_err(|error| LibraryError::io(path, error))?;
        let stamps = table.stamps.as_ref().map(|(_, stamps)| stamps);
        give(path, key, rows, form, stamps, &mut said, on)?;
    }
    Ok(said)
}

/// Makes trials of the rows of one trial for `on`; one that cannot be used is added to those in `said`.
fn give(
    path: &Path,
    key: TrialKey,
    mut rows: Rows,
    form: &Form,
    stamps: Option<&Stamps>,
    said: &mut Said,
    on: OnRead<'_>,
) -> Result<(), LibraryError> {
    said.overtaken += in_order(&mut rows);
    let widest = form.widest();
    let samples = rows.values.len() / form.columns().len().max(1);
    let mended = match widest > MOST_TURNED && samples < widest {
        false => mend_sources(rows, &form.sources, form.rate_hz(), form.gaps),
        true => Err(format!(
            "has {samples} rows of {widest} channels; expected a row for each sample: if each row is a \
             channel or a trial, turn the table, or save it as .npy"
        )),
    };
    let mended = match mended {
        Ok(mended) => mended,
        Err(problem) => {
            said.bad.push(format!("{key} {problem}"));
            return Ok(());
        }
    };
    said.resampled_hz = said.resampled_hz.or(mended.resampled_hz);
    said.repeated += mended.repeated;
    said.cut += usize::from(mended.parts.len() + mended.too_short > 1);
    said.too_short += mended.too_short;
    said.own_rates |= mended.parts[0].len() > 1;
    let filled = mended.parts.iter().flatten().flat_map(|piece| &piece.filled);
    said.filled += filled.filter(|filled| **filled).count();
    for (number, part) in mended.parts.iter().enumerate() {
        let read = trial(key.clone(), part, form, stamps);
        let read = read.map_err(LibraryError::at(path))?;
        on(&[], Some(Read { is_further: number > 0, ..read }))?;
    }
    Ok(())
}

fn session_name(text: &str) -> Result<String, String> {
    checked_session(text).map_err(|problem| format!("the session `{text}` {problem}"))
}

impl Form {
    /// Rows a second; `None` if a column tells the times.
    fn rate_hz(&self) -> Option<f64> {
        let Clock::Rate(rate_hz) = self.clock else { return None };
        Some(rate_hz)
    }

    /// The session of the trials of a file, unless a column tells it.
    fn session_of(&self, path: &Path) -> Result<Option<String>, String> {
        let session = match &self.session {
            SessionOf::Nothing => None,
            SessionOf::Names => self.of_name(path).ok().and_then(|[.., session]| session),
            SessionOf::Pattern(pattern) => {
                let [.., session] = pattern.parts(&name_of(path), "--session")?;
                session
            }
            SessionOf::File(folders) => {
                let within = folders.iter().find_map(|folder| path.strip_prefix(folder).ok());
                let within = within.filter(|within| !within.as_os_str().is_empty());
                let name = path.file_name().unwrap_or_default();
                Some(name_of(within.unwrap_or(Path::new(name))).replace('/', " "))
            }
        };
        session.as_deref().map(session_name).transpose()
    }

    /// The values that the pattern reads in a file's path; none without a pattern.
    fn of_name(&self, path: &Path) -> Result<Parts, String> {
        let parts = self.names.as_ref().map(|pattern| pattern.parts(&name_of(path), "--names"));
        Ok(parts.transpose()?.unwrap_or_default())
    }

    /// The number of channels of the source with the most.
    pub fn widest(&self) -> usize {
        self.sources.iter().map(|(_, columns)| columns.len()).max().unwrap_or(1)
    }

    fn columns(&self) -> Vec<String> {
        self.sources.iter().flat_map(|(_, columns)| columns.clone()).collect()
    }
}

fn trial(
    key: TrialKey,
    part: &[Piece],
    form: &Form,
    stamps: Option<&Stamps>,
) -> Result<Read, String> {
    let mut about = About::default();
    if let Some(stamps) = stamps
        && stamps.say_when()
        && let Ok(ns) = u64::try_from(part[0].start)
    {
        let when = std::time::UNIX_EPOCH + std::time::Duration::from_nanos(ns);
        // Dates without a zone are in local time.
        let is_utc =
            matches!(stamps, Stamps::Numbers { .. } | Stamps::Dates { have_zone: true, .. });
        let text = utc(when);
        about.started_at = Some(if is_utc { text } else { text.trim_end_matches('Z').to_string() });
    }
    let mut signals = BTreeMap::new();
    let mut places = part.iter().flat_map(|piece| (0..piece.width).map(move |at| (piece, at)));
    for (source, columns) in &form.sources {
        let own: Vec<_> = places.by_ref().take(columns.len()).collect();
        let (piece, from) = own[0];
        let (range, width) = (from..from + columns.len(), piece.width);
        let frames = piece.values.chunks_exact(width);
        let samples: Vec<f32> =
            frames.flat_map(|frame| frame[range.clone()].iter().copied()).collect();
        let filled: Vec<usize> = (piece.filled.chunks_exact(width).enumerate())
            .filter(|(_, frame)| frame[range.clone()].contains(&true))
            .map(|(frame, _)| frame + 1)
            .collect();
        if !filled.is_empty() {
            let marks = marks(&filled, samples.len() / columns.len());
            about.interpolated.insert(source.to_string(), marks);
        }
        let series = Series::new(piece.rate_hz, columns.len(), samples);
        let series = series.map_err(|error| format!("{key}, source `{source}`: {error}"))?;
        signals.insert(source.clone(), Signal::Series(series));
    }
    Ok(Read { trial: Trial { key, signals }, about, is_further: false })
}

/// `3 of 100: 5-6, 9`: the count of filled frames, all frames, and the first filled ones, from 1 on.
fn marks(filled: &[usize], frames: usize) -> String {
    const MOST: usize = 50;
    let mut ranges: Vec<(usize, usize)> = Vec::new();
    for &frame in filled {
        match ranges.last_mut() {
            Some((_, end)) if *end + 1 == frame => *end = frame,
            _ => ranges.push((frame, frame)),
        }
    }
    let one = |(from, to): &(usize, usize)| match from == to {
        true => from.to_string(),
        false => format!("{from}-{to}"),
    };
    let shown: Vec<String> = ranges.iter().take(MOST).map(one).collect();
    let more = if ranges.len() > MOST { ", …" } else { "" };
    format!("{} of {frames}: {}{more}", filled.len(), shown.join(", "))
}

/// Reads all trials of a table at 100 rows a second, or by its times, for tests of damaged files. Returns
/// their number.
pub fn try_table(path: &Path) -> Result<usize, LibraryError> {
    let fail = LibraryError::at(path);
    let mut form = Form {
        sources: Vec::new(),
        known: BTreeSet::new(),
        units: Vec::new(),
        clock: Clock::Rate(100.0),
        labels: [None, None, None, None],
        session: SessionOf::Names,
        names: Some(NamePattern("{surface}-{trial}".into())),
        variable: None,
        gaps: Gaps::Cut,
        from_1904: false,
        most_unpacked: 1 << 24,
    };
    if array_file::is_array(path) {
        let channels = array_file::open(path, &form)?.0.channels;
        let names = (1..=channels).map(|channel| channel.to_string()).collect();
        form.sources.extend(SourceId::new("x").map(|id| (id, names)));
    } else {
        let head = Head::read(path, form.most_unpacked)?;
        if let Some(column) = columns::clock(&head, None, false).map_err(fail)? {
            form.clock = Clock::Times { column, unit_s: None };
        }
        form.sources = columns::sources(&head, &form.clock, &form.labels).map_err(fail)?.0;
    }
    let mut count = 0;
    let mut on = |_: &[TrialKey], read: Option<Read>| {
        count += usize::from(read.is_some());
        Ok(())
    };
    read(path, &form, &std::env::temp_dir(), &mut on)?;
    Ok(count)
}
