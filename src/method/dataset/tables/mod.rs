//! Reads recordings from tables: text or Parquet with a row for each sample, or arrays of NumPy and MATLAB.
//! A table holds one trial, or many trials named by columns. Other columns become sources. The rows have a
//! fixed rate, or a column of times.
//!
//! A table is read once, row by row, so that its size does not matter: `layout` finds out how it is
//! written, `columns` what its columns are, `gather` collects rows by trial, and `mend` makes trials
//! with a fixed rate of them.

#[doc(hidden)]
pub mod array;
mod cell;
#[doc(hidden)]
pub mod columns;
mod gather;
mod grid;
mod heading;
mod layout;
mod mat;
mod mend;
mod npy;
#[cfg(feature = "parquet")]
mod parquet;
mod stamp;
mod table;
mod text;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path, PathBuf};

use gather::Rows;
use layout::Layout;
#[doc(hidden)]
pub use mend::Gaps;
use mend::{Piece, mend};
use stamp::Stamps;
use table::Table;
use text::Lines;

use crate::library::files::number_in;
use crate::library::{About, LibraryError};
use crate::scene::SourceId;
use crate::trial::{EXPERT, Series, Signal, Trial, TrialKey, checked_session, normal, utc};

/// Lines and bytes that decide how a table is understood.
const HEAD_LINES: usize = 2000;
const HEAD_BYTES: usize = 1 << 20;
/// A trial with more channels than this has at least as many samples.
const MOST_TURNED: usize = 16;

/// A pattern for file paths: text, the fields `{surface}`, `{user}`, `{trial}` and `{session}`, and
/// `*` for any text. Fields and `*` match at least one character, but no `/`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NamePattern(pub String);

impl NamePattern {
    /// Reads surface, user, trial (text that ends with the number) and session from as many last parts
    /// of the path `name` as the pattern has. A trial of digits alone comes before other texts, and takes
    /// all of its digits.
    ///
    /// # Errors
    /// If the pattern does not fit, or fits in several ways.
    pub(crate) fn parts(&self, name: &str) -> Result<Parts, String> {
        let depth = self.0.matches('/').count();
        let from = name.rmatch_indices('/').nth(depth).map_or(0, |(at, _)| at + 1);
        let mut found = Fits { left: 100_000, all: Vec::new() };
        found.add(&self.0, &name[from..], &mut Parts::default());
        let digits = |parts: &Parts| {
            let number = parts[2].as_ref().filter(|text| text.bytes().all(|b| b.is_ascii_digit()));
            number.map_or(0, String::len)
        };
        let most = found.all.iter().map(digits).max().unwrap_or_default();
        let mut all = found.all.iter().filter(|parts| digits(parts) == most);
        let pattern = &self.0;
        match (all.next(), all.next()) {
            (None, _) => Err(format!("its name does not fit the pattern `{pattern}`; see --names")),
            (Some(only), None) if found.left > 0 => Ok(only.clone()),
            (Some(one), other) => {
                let said = |parts: &Parts| {
                    parts
                        .iter()
                        .flatten()
                        .map(|part| format!("`{part}`"))
                        .collect::<Vec<_>>()
                        .join(", ")
                };
                Err(format!(
                    "its name fits the pattern `{pattern}` in several ways ({} or {}); give --names a \
                     pattern with as many separators as the name has",
                    said(one),
                    said(other.unwrap_or(one))
                ))
            }
        }
    }
}

/// Surface, user, trial and session of a name.
type Parts = [Option<String>; 4];

/// The different ways in which a pattern fits a name.
struct Fits {
    /// How many more comparisons are made, since there may be very many ways.
    left: usize,
    all: Vec<Parts>,
}

impl Fits {
    fn add(&mut self, pattern: &str, name: &str, parts: &mut Parts) {
        let fields = ["{surface}", "{user}", "{trial}", "{session}", "*"];
        self.left = self.left.saturating_sub(1);
        if self.left == 0 {
            return;
        }
        let Some(field) = fields.iter().position(|field| pattern.starts_with(field)) else {
            match (pattern.chars().next(), name.chars().next()) {
                (None, None) if !self.all.contains(parts) => self.all.push(parts.clone()),
                (Some(a), Some(b)) if a == b => {
                    self.add(&pattern[a.len_utf8()..], &name[b.len_utf8()..], parts);
                }
                _ => {}
            }
            return;
        };
        let ends = name.char_indices().map(|(at, c)| (at + c.len_utf8(), c));
        for (end, _) in ends.take_while(|(_, c)| *c != '/') {
            if let Some(part) = parts.get_mut(field) {
                *part = Some(name[..end].to_string());
            }
            self.add(&pattern[fields[field].len()..], &name[end..], parts);
        }
    }
}

/// How to find the time of each row of a table.
#[derive(Clone, Debug, PartialEq)]
pub enum Clock {
    /// Rows a second.
    Rate(f64),
    /// A column, and its unit of time in seconds; `None`: told by its header or its values.
    Times { column: String, unit_s: Option<f64> },
}

/// Where the name of the session of a table's trials comes from, if no column holds it.
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
        let mut lines = Lines::open(path, most_unpacked)?;
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
                Ok(true) => rows.push(cells.into_iter().map(<[u8]>::to_vec).collect()),
                Ok(false) => {}
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
    if array::is_array(path) {
        return array::read(path, form, on);
    }
    let head = Head::read(path, form.most_unpacked)?;
    let mut lines = Lines::open(path, form.most_unpacked)?;
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
    rows: Rows,
    form: &Form,
    stamps: Option<&Stamps>,
    said: &mut Said,
    on: OnRead<'_>,
) -> Result<(), LibraryError> {
    let (columns, widest) = (form.columns(), form.widest());
    let samples = rows.values.len() / columns.len().max(1);
    let mended = match widest > MOST_TURNED && samples < widest {
        false => mend(rows, &columns, form.rate_hz(), form.gaps),
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
    said.cut += usize::from(mended.pieces.len() + mended.too_short > 1);
    said.too_short += mended.too_short;
    let filled = mended.pieces.iter().flat_map(|piece| &piece.filled);
    said.filled += filled.filter(|filled| **filled).count();
    for (part, piece) in mended.pieces.iter().enumerate() {
        let read = trial(key.clone(), piece, form, stamps);
        let read = read.map_err(LibraryError::at(path))?;
        on(&[], Some(Read { is_further: part > 0, ..read }))?;
    }
    Ok(())
}

fn session_name(text: &str) -> Result<String, String> {
    checked_session(text).map_err(|problem| format!("the session `{text}` {problem}"))
}

/// The path of a file without its extensions, with `/` on every system: what a [`NamePattern`] fits.
fn name_of(path: &Path) -> String {
    // `./3.csv` lies in a folder with a name, too.
    let is_relative =
        |part: Component<'_>| matches!(part, Component::CurDir | Component::ParentDir);
    let found = path.components().any(is_relative).then(|| path.canonicalize().ok()).flatten();
    let name = found.as_deref().unwrap_or(path).to_string_lossy().replace('\\', "/");
    let name = name.strip_suffix(".gz").unwrap_or(&name);
    Path::new(name).with_extension("").to_string_lossy().into_owned()
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
                let parts = pattern.parts(&name_of(path));
                let [.., session] = parts.map_err(|why| why.replace("--names", "--session"))?;
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

    /// What the pattern reads in a file's path; nothing without a pattern.
    fn of_name(&self, path: &Path) -> Result<Parts, String> {
        let parts = self.names.as_ref().map(|pattern| pattern.parts(&name_of(path)));
        Ok(parts.transpose()?.unwrap_or_default())
    }

    /// The number of channels of the source with the most.
    fn widest(&self) -> usize {
        self.sources.iter().map(|(_, columns)| columns.len()).max().unwrap_or(1)
    }

    fn columns(&self) -> Vec<String> {
        self.sources.iter().flat_map(|(_, columns)| columns.clone()).collect()
    }
}

fn trial(
    key: TrialKey,
    piece: &Piece,
    form: &Form,
    stamps: Option<&Stamps>,
) -> Result<Read, String> {
    let width = form.sources.iter().map(|(_, columns)| columns.len()).sum();
    let mut about = About::default();
    if let Some(stamps) = stamps
        && stamps.say_when()
        && let Ok(ns) = u64::try_from(piece.start)
    {
        let when = std::time::UNIX_EPOCH + std::time::Duration::from_nanos(ns);
        // Dates without a zone are in local time.
        let is_utc =
            matches!(stamps, Stamps::Numbers { .. } | Stamps::Dates { have_zone: true, .. });
        let text = utc(when);
        about.started_at = Some(if is_utc { text } else { text.trim_end_matches('Z').to_string() });
    }
    let (mut signals, mut from) = (BTreeMap::new(), 0);
    for (source, columns) in &form.sources {
        let range = from..from + columns.len();
        from = range.end;
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

/// The number of a trial: `3`, `3.0`, or the digits at the end of a name; `None` for `1.5`.
fn trial_number(text: &str) -> Option<u32> {
    match text.replace(',', ".").parse::<f64>() {
        Ok(number) => (number.fract() == 0.0 && (0.0..=f64::from(u32::MAX)).contains(&number))
            .then_some(number as u32),
        Err(_) => number_in(text),
    }
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

/// The surface, user and number that the names of files give, before any is read.
pub fn named(paths: &[PathBuf], names: &NamePattern) -> BTreeSet<TrialKey> {
    let key = |path: &PathBuf| {
        let [surface, user, number, _] = names.parts(&name_of(path)).ok()?;
        let number = number.and_then(|text| trial_number(&text)).unwrap_or(1);
        let user = user.unwrap_or_else(|| EXPERT.into());
        Some(TrialKey::new(normal(&surface?), normal(&user), number))
    };
    paths.iter().filter_map(key).collect()
}

/// Reads all trials of a table at 100 rows a second, or by its times, for tests of damaged files. Returns
/// their number.
pub fn try_table(path: &Path) -> Result<usize, LibraryError> {
    let fail = LibraryError::at(path);
    let mut form = Form {
        sources: Vec::new(),
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
    if array::is_array(path) {
        let channels = array::Trials::open(path, &form)?.0.channels;
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_by_their_pattern() {
        for (pattern, name, found) in [
            ("{surface}/{trial}", "a/Eiche/3", ["Eiche", "", "3", ""]),
            ("{surface}_{user}_{trial}", "oak_anna_07", ["oak", "anna", "07", ""]),
            ("{user}/*-{surface}_{trial}", "x/ben/run-oak 2_4", ["oak 2", "ben", "4", ""]),
            ("{session}/{surface}_{trial}", "x/monday/oak_4", ["oak", "", "4", "monday"]),
            ("{surface}_{trial}", "brushed_steel_12", ["brushed_steel", "", "12", ""]),
            ("{surface}{trial}", "oak01", ["oak", "", "01", ""]),
            ("*_{surface}", "1_oak", ["oak", "", "", ""]),
        ] {
            let parts = NamePattern(pattern.into()).parts(name).unwrap();
            assert_eq!(parts.map(Option::unwrap_or_default), found);
        }
        for (pattern, name, why) in [
            ("{surface}_{trial}", "oak".to_string(), "does not fit"),
            ("{surface}_{user}_{trial}", "cast_steel_ben_3".into(), "`cast`, `steel_ben`, `3` or"),
            ("{surface}x{user}x{trial}x*x*x*", "x".repeat(250), "in several ways"),
        ] {
            let found = NamePattern(pattern.into()).parts(&name).unwrap_err();
            assert!(found.contains(why), "{found}");
        }
    }
}
