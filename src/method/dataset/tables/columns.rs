//! Tells what the columns of a table are (times, labels, counters, or the channels of sources) by their
//! names, and by the values in the first rows.

use std::collections::{BTreeMap, BTreeSet};

use super::cell::is_missing;
use super::heading::Column;
use super::stamp::{Stamps, unit_ns};
use super::text::shown;
use super::{Clock, Head};
use crate::scene::SourceId;

/// Names of columns of times: letters and digits alone, in small letters.
const TIMES: &str = "time t timestamp timestamps ts zeit zeitstempel uhrzeit temps tiempo xvalue elapsed \
    elapsedtime secondselapsed timeelapsed relativetime epoch unixtime utc datetime date \
    datum millis micros nanos uptime sec seconds ms us ns sampletime loggingtime systemtime \
    stamp nanosec nsec nsecs";

/// Names of columns that count rows.
const COUNTERS: &str = "index idx sample samples samplenumber sampleno count counter nr no seq sequence row \
    packet";

/// Names of columns that say what a row belongs to.
const LABELS: &str = "label labels class classid target surface surfaceid material materialid texture user \
    userid subject subjectid person participant participantid trial trialid run runid rep \
    repetition session sessionid id";

fn is_among(words: &str, word: &str) -> bool {
    words.split(' ').any(|known| known == word)
}

fn plain(name: &str) -> String {
    // Before a colon stands what was measured when, such as `Run 1: Time`.
    let name = name.rsplit(": ").next().unwrap_or(name);
    name.chars().filter(char::is_ascii_alphanumeric).collect::<String>().to_ascii_lowercase()
}

pub(crate) fn is_time(column: &Column) -> bool {
    let base = plain(&column.base);
    is_among(TIMES, &base)
        || is_among(TIMES, base.trim_end_matches(|c: char| c.is_ascii_digit()))
            && base.starts_with("time")
}

/// The unit of time that a column's header tells, in ns.
pub(crate) fn told_unit_ns(column: &Column) -> Option<f64> {
    let unit = column.unit.as_deref().and_then(unit_ns);
    // A column may be called `millis`, but `t` or `s` alone says no unit.
    unit.or_else(|| unit_ns(&plain(&column.base)).filter(|_| column.base.len() > 1))
        .or_else(|| (plain(&column.base) == "secondselapsed").then_some(1e9))
}

/// The column of times of a table, if one has the name and the values of times. An error if two are
/// times of different lengths, or have several readings.
pub fn clock(head: &Head, unit_s: Option<f64>, from_1904: bool) -> Result<Option<String>, String> {
    let columns = &head.layout.columns;
    let unit_of =
        |column: usize| unit_s.map(|unit| unit * 1e9).or_else(|| told_unit_ns(&columns[column]));
    let rises = |column: usize| -> Option<Result<(f64, usize), String>> {
        let cells = head.cells(column);
        let stamps = match Stamps::of(&cells, unit_of(column), from_1904) {
            Ok((stamps, _)) => stamps,
            // A column that rises may be the times, though in which unit is not clear.
            Err(why) if why.contains("--time-unit") => return Some(Err(why)),
            Err(_) => return None,
        };
        let times: Vec<i64> = cells.iter().filter_map(|cell| stamps.read(cell)).collect();
        let back = times.windows(2).filter(|two| two[1] < two[0]).count();
        // A counter that begins anew falls once.
        let steps = times.windows(2).map(|two| two[1].saturating_sub(two[0]).max(0) as f64);
        let long: f64 = steps.sum();
        // Each trial of a long table may begin anew.
        (times.len() > 1 && back * 5 <= times.len() && long > 0.0)
            .then_some(Ok((long / 1e9, times.len())))
    };
    let named = (0..columns.len()).filter(|column| is_time(&columns[*column]));
    let (mut found, mut unclear) = (None::<(usize, f64)>, None);
    for column in named {
        match rises(column) {
            None => {}
            Some(Err(why)) => {
                unclear = unclear.or(Some(format!("column `{}` {why}", columns[column].name)));
            }
            Some(Ok((long, rows))) => match found {
                None => found = Some((column, long)),
                Some((first, other)) if (long / other - 1.0).abs() > 0.05 + 2.0 / rows as f64 => {
                    return Err(format!(
                        "columns `{}` and `{}` are both times, of {other} s and of {long} s; say which by \
                         --time, and its columns by --source",
                        columns[first].name, columns[column].name
                    ));
                }
                Some(_) => {}
            },
        }
    }
    if let (None, Some(unclear)) = (found, unclear) {
        return Err(unclear);
    }
    let by_value = || {
        (0..columns.len()).find(|column| {
            let cells = head.cells(*column);
            let stamps = Stamps::of(&cells, unit_of(*column), from_1904);
            let is_when = stamps.is_ok_and(|(stamps, _)| match stamps {
                Stamps::Numbers { since_1970, .. } => since_1970,
                Stamps::Dates | Stamps::Clock { .. } => true,
                Stamps::Days { .. } => false,
            });
            is_when && matches!(rises(*column), Some(Ok(_)))
        })
    };
    let column = found.map(|(column, _)| column).or_else(by_value);
    Ok(column.map(|column| columns[column].name.clone()))
}

/// A source, and the names of the columns that are its channels.
#[doc(hidden)]
pub type Wanted = (SourceId, Vec<String>);

/// Groups columns into sources by name: columns whose names differ only in a last axis (x, y, z), after
/// the last `_`, `.`, `-` or space, or in a last digit, are channels of one source. Returns what people
/// should know about columns that are left out; an error if none is left.
pub fn sources(
    head: &Head,
    clock: &Clock,
    labels: &[Option<String>; 4],
) -> Result<(Vec<Wanted>, Vec<String>), String> {
    let layout = &head.layout;
    let mut taken: BTreeSet<usize> = BTreeSet::new();
    for label in labels.iter().flatten() {
        taken.insert(layout.column(label)?);
    }
    if let Clock::Times { column, .. } = clock {
        taken.insert(layout.column(column)?);
    }
    let (mut kept, mut notes) = (Vec::new(), Vec::new());
    for (at, column) in layout.columns.iter().enumerate() {
        if taken.contains(&at) || !column.is_numeric || is_time(column) {
            continue;
        }
        let (base, name) = (plain(&column.base), &column.name);
        let cells = head.cells(at);
        let is_pandas =
            ["unnamed", "level", "indexlevel"].iter().any(|name| base.starts_with(name));
        if (base.is_empty() || is_among(COUNTERS, &base) || is_pandas) && counts(cells.iter()) {
            notes.push(format!("column `{name}` only counts the rows, and is left out"));
        } else if is_among(LABELS, &base) || is_label(&cells) {
            notes.push(format!(
                "column `{name}` looks like a label, and is left out; name it by --surface, --user or \
                 --trial, or use it by --source"
            ));
        } else {
            kept.push(column);
        }
    }
    let runs: BTreeSet<&str> =
        kept.iter().filter_map(|column| Some(column.base.rsplit_once(": ")?.0)).collect();
    if runs.len() > 1 {
        let runs = runs.into_iter().collect::<Vec<_>>().join(", ");
        return Err(format!(
            "it holds several runs side by side ({runs}); import each by --time and --source"
        ));
    }
    let mut sources: BTreeMap<String, Vec<String>> = BTreeMap::new();
    let bases: Vec<String> = kept.iter().map(|column| column.base.to_lowercase()).collect();
    for (column, base) in kept.iter().zip(&bases) {
        let id: String = stem(base, &bases).chars().filter(char::is_ascii_alphanumeric).collect();
        let id = if id.is_empty() { "sensor".to_string() } else { id };
        sources.entry(id).or_default().push(column.name.clone());
    }
    if sources.is_empty() {
        let names: Vec<&str> = layout.columns.iter().map(|column| &*column.name).collect();
        return Err(format!("no column of samples is left; the columns: {}", names.join(", ")));
    }
    let named = |(id, columns): (String, Vec<String>)| {
        Ok((SourceId::new(&id).map_err(|error| error.to_string())?, columns))
    };
    Ok((sources.into_iter().map(named).collect::<Result<_, String>>()?, notes))
}

/// The part of a name that the channels of one source share.
fn stem<'a>(name: &'a str, all: &[String]) -> &'a str {
    if let Some(rest) = name.strip_suffix(['x', 'y', 'z']) {
        let others = ['x', 'y', 'z'].iter().filter(|axis| all.contains(&format!("{rest}{axis}")));
        if others.count() > 1 {
            return rest;
        }
    }
    let name = name.rsplit(": ").next().unwrap_or(name);
    // Two columns of one name, `x` and `x (2)`, are channels of one source, too.
    let name = name.rsplit_once(" (").map_or(name, |(name, _)| name);
    let stem = name.trim_end_matches(|c: char| c.is_ascii_digit());
    stem.rsplit_once(['_', '.', '-', ' ']).map_or(stem, |(stem, _)| stem)
}

fn whole(cell: &[u8]) -> Option<i64> {
    let value = shown(cell).parse::<f64>().ok()?;
    (value.fract() == 0.0 && value.abs() < 1e15).then_some(value as i64)
}

/// Whether cells rise by 1 from each to the next.
pub(super) fn counts<'a>(cells: impl Iterator<Item = &'a Vec<u8>>) -> bool {
    let numbers: Option<Vec<i64>> = cells.map(|cell| whole(cell)).collect();
    numbers.is_some_and(|numbers| {
        numbers.len() > 1 && numbers.windows(2).all(|two| two[1] - two[0] == 1)
    })
}

/// Whether cells are a few whole numbers that seldom change, like the number of a class.
fn is_label(cells: &[Vec<u8>]) -> bool {
    let numbers: Option<Vec<i64>> =
        cells.iter().filter(|cell| !is_missing(cell)).map(|cell| whole(cell)).collect();
    let Some(numbers) = numbers.filter(|numbers| numbers.len() >= 100) else { return false };
    let changes = numbers.windows(2).filter(|two| two[0] != two[1]).count();
    let different: BTreeSet<i64> = numbers.iter().copied().collect();
    (2..=20).contains(&different.len()) && changes * 50 < numbers.len()
}
