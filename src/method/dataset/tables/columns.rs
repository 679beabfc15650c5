//! Tells what the columns of a table are (times, labels, counters, or the channels of sources) by their
//! names, and by the values in the first rows.

use std::collections::{BTreeMap, BTreeSet};

use super::cell::{Numbers, counts, is_missing, shown, whole};
use super::heading::{Column, is_among, is_time_name, is_unit, plain};
use super::stamp::{Stamps, length, unit_ns};
use super::{Clock, Head};
use crate::scene::SourceId;

/// Names of columns that count rows.
const COUNTERS: &str = "n index idx sample samples samplenumber sampleno count counter nr no seq sequence row \
    packet";

/// Names of columns with the time since the row before.
const INTERVALS: &str = "dt deltat deltatime timedelta interval";

/// A column that rises by 1 for this many rows counts them, whatever it is called.
const SURELY_COUNTED: usize = 50;

/// Parts of the names of clocks and counters.
const RUNNING: [&str; 14] = [
    "time", "stamp", "elapsed", "clock", "milli", "micro", "nano", "msec", "usec", "nsec", "seq",
    "packet", "sample", "frame",
];

/// Names of columns that say of which surface a row is.
const SURFACES: &str =
    "label labels class classid target surface surfaceid material materialid texture";

/// Names of columns that say to what else a row belongs.
const LABELS: &str = "user userid subject subjectid person participant participantid trial trialid run runid \
    rep repetition session sessionid id";

/// Names of columns that say what was measured, in tables with one value a row.
const QUANTITIES: &str = "variable parameter series channel sensor sensorid kind type name key metric entityid \
    measurement field quantity axis signal tag id station node device address";

/// Whether a column of a table is one of times by its name. A `T` beside another first column is a
/// temperature or a torque, and an `x-axis` beside a `y-axis` a channel.
fn is_time(columns: &[Column], at: usize) -> bool {
    let name = plain(&columns[at].base);
    let is_axis = name.strip_prefix('x').is_some_and(|rest| {
        columns.iter().any(|other| plain(&other.base).strip_prefix('y') == Some(rest))
    });
    is_time_name(&columns[at].base) && !is_axis && (at == 0 || columns[at].base != "T")
}

/// The unit of time that a column's header tells, in ns.
fn told_unit_ns(column: &Column) -> Option<f64> {
    let base = plain(&column.base);
    let counted = |unit: &str| {
        let digits = unit.bytes().take_while(u8::is_ascii_digit).count();
        let count = if digits == 0 { 1.0 } else { unit[..digits].parse().ok()? };
        Some(count * unit_ns(unit[digits..].trim().trim_end_matches('.'))?)
    };
    // A column may be called `millis`, but `t` or `s` alone says no unit.
    (column.unit.as_deref().and_then(counted))
        .or_else(|| unit_ns(base.strip_prefix("time").unwrap_or(&base)).filter(|_| base.len() > 1))
        .or_else(|| (base == "secondselapsed").then_some(1e9))
}

/// The times in a column of a table, and how they were understood. `unit_s` is their unit in seconds, if
/// it was given.
///
/// # Errors
/// If the times are of no known form or may have several units, or the header says a unit that is not
/// known, or not that of the values. The error continues a sentence that begins with the column.
pub(super) fn stamps(
    head: &Head,
    at: usize,
    unit_s: Option<f64>,
    from_1904: bool,
) -> Result<(Stamps, String), String> {
    let (column, cells) = (&head.layout.columns[at], head.cells(at));
    let of = |unit_ns: Option<f64>| Stamps::of(&cells, unit_ns, from_1904);
    if let Some(unit_s) = unit_s {
        return of(Some(unit_s * 1e9));
    }
    let unit = column.unit.as_deref().unwrap_or_default();
    let advice = "say --time-unit SECONDS, such as 0.001";
    match (told_unit_ns(column), of(None)) {
        (Some(told), Ok((Stamps::Numbers { unit_ns, since_1970: true }, _))) if unit_ns != told => {
            let by_values = length(unit_ns);
            Err(format!("has the unit `{unit}`, but values in {by_values} since 1970; {advice}"))
        }
        // Some loggers write seconds below `time (ms)`.
        (Some(told), Ok((Stamps::Numbers { unit_ns, .. }, _))) if unit_ns >= 1e3 * told => {
            let (stamps, why) = of(Some(told))?;
            let (by_steps, unit_s) = (length(unit_ns), unit_ns / 1e9);
            let other = format!("by its steps it may be {by_steps}: then say --time-unit {unit_s}");
            Ok((stamps, format!("{why}, as its name says; {other}")))
        }
        (Some(told), _) => of(Some(told)),
        // Another text, such as a zone or the form of the times, may stand there with dates.
        (None, Ok((Stamps::Numbers { since_1970: false, .. }, _))) if !unit.is_empty() => {
            Err(format!("has the unit `{unit}`, which is not known; {advice}"))
        }
        (None, found) => found,
    }
}

/// The column of times of a table, if one has the name and the values of times. An error if two are
/// times of different lengths, or have several readings.
pub fn clock(head: &Head, unit_s: Option<f64>, from_1904: bool) -> Result<Option<String>, String> {
    let columns = &head.layout.columns;
    let rises = |column: usize| -> Option<Result<(Stamps, f64, usize), String>> {
        let cells = head.cells(column);
        let stamps = match stamps(head, column, unit_s, from_1904) {
            Ok((stamps, _)) => stamps,
            Err(why) => return Some(Err(why)),
        };
        let times: Vec<i64> = cells.iter().filter_map(|cell| stamps.read(cell)).collect();
        let back = times.windows(2).filter(|two| two[1] < two[0]).count();
        // A counter that begins anew falls once.
        let steps = times.windows(2).map(|two| two[1].saturating_sub(two[0]).max(0) as f64);
        let long: f64 = steps.sum();
        // Each trial of a long table may begin anew.
        (times.len() > 1 && back * 5 <= times.len() && long > 0.0).then_some(Ok((
            stamps,
            long / 1e9,
            times.len(),
        )))
    };
    let named = (0..columns.len()).filter(|column| is_time(columns, *column));
    let (mut found, mut unclear) = (None::<(usize, f64)>, None);
    for column in named {
        match rises(column) {
            None => {}
            Some(Err(why)) => {
                let other = if why.contains("--") { "" } else { "; mend it, or give --rate HZ" };
                unclear =
                    unclear.or(Some(format!("column `{}` {why}{other}", columns[column].name)));
            }
            Some(Ok((_, long, rows))) => match found {
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
    let by_value = || {
        (0..columns.len()).find(|column| match rises(*column) {
            Some(Ok((Stamps::Numbers { since_1970, .. }, ..))) => since_1970,
            Some(Ok((Stamps::Dates { .. } | Stamps::Clock { .. }, ..))) => true,
            _ => false,
        })
    };
    match (found.map(|(column, _)| column).or_else(by_value), unclear) {
        (Some(column), _) => Ok(Some(columns[column].name.clone())),
        // A column that may be the times, though in which unit is not clear, or with a damaged cell.
        (None, Some(unclear)) => Err(unclear),
        (None, None) => Ok(None),
    }
}

/// Refuses times that fall from row to row, as where a program writes the newest row first.
pub fn oldest_first(head: &Head) -> Result<(), String> {
    let columns = &head.layout.columns;
    let mut named = (0..columns.len()).filter(|at| is_time(columns, *at));
    let falls = named.find(|at| {
        let cells = head.cells(*at);
        let times: Vec<f64> = match stamps(head, *at, None, false) {
            Ok((stamps, _)) => {
                cells.iter().filter_map(|cell| stamps.read(cell)).map(|x| x as f64).collect()
            }
            Err(_) => cells.iter().filter_map(|cell| number(cell, head.layout.delimiter)).collect(),
        };
        let falls = times.windows(2).filter(|two| two[1] < two[0]).count();
        times.len() >= 10 && falls * 20 >= 19 * (times.len() - 1)
    });
    falls.map_or(Ok(()), |at| {
        Err(format!(
            "column `{}` falls from row to row: the newest row stands first; turn the rows round, such as by `tac` \
             below the names",
            columns[at].name
        ))
    })
}

/// Whether a column may hold parts of the seconds that another column counts.
pub(super) fn is_beside_seconds(head: &Head, at: usize) -> bool {
    const SECONDS: &str = "s ss sec secs second seconds tvsec";
    let are_whole = |column: usize| head.cells(column).iter().all(|cell| whole(cell).is_some());
    let mut columns = head.layout.columns.iter().enumerate();
    columns.any(|(other, column)| {
        other != at && is_among(SECONDS, &plain(&column.base)) && are_whole(other)
    })
}

/// The first column among `others` that counts rows, again and again where trials stand below each other.
pub(super) fn counter(head: &Head, others: impl Fn(&usize) -> bool) -> Option<usize> {
    (0..head.layout.columns.len()).filter(others).find(|at| {
        let numbers: Option<Vec<i64>> = head.cells(*at).iter().map(|cell| whole(cell)).collect();
        numbers.is_some_and(|numbers| {
            let anew = numbers.windows(2).filter(|two| two[1] != two[0] + 1).count();
            // Counters of a few bits begin anew within a trial.
            let is_full = numbers.iter().max().is_some_and(|most| (most + 1).count_ones() == 1);
            let may_wrap = is_full && anew > 0;
            numbers.len() >= SURELY_COUNTED && anew * 10 <= numbers.len() && !may_wrap
        })
    })
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
        if taken.contains(&at) {
            continue;
        }
        let (base, name) = (plain(&column.base), &column.name);
        let cells = head.cells(at);
        let number = |cell: &Vec<u8>| number(cell, layout.delimiter);
        let is_surface = is_among(SURFACES, &base);
        if !column.is_numeric {
            if !is_time(&layout.columns, at) {
                let may_name = is_surface && labels[0].is_none();
                notes.extend(of_texts(name, &cells, layout.delimiter, may_name)?);
            }
            continue;
        }
        let is_pandas = ["Unnamed: ", "level_", "__index_level_"];
        let is_pandas = is_pandas.iter().any(|start| column.base.starts_with(start));
        let is_counter = base.is_empty() || is_among(COUNTERS, &base) || is_pandas;
        let is_clock = is_time(&layout.columns, at)
            || at == 0 && layout.columns.len() > 1 && is_nameless(&column.base)
            || RUNNING.iter().any(|part| base.contains(part));
        let runs_on = cells.iter().map(number).collect::<Option<Vec<_>>>().is_some_and(|numbers| {
            runs_surely(&numbers) || (is_clock || is_counter) && runs_on(&numbers)
        });
        if (is_counter || cells.len() >= SURELY_COUNTED) && counts(cells.iter())
            || is_counter && runs_on
        {
            notes.push(format!(
                "column `{name}` only counts the rows, and is left out; use it by --source if it measures"
            ));
        } else if runs_on {
            notes.push(format!(
                "column `{name}` rises like a clock or a counter, and is left out; use it by --source"
            ));
        } else if is_among(INTERVALS, &base) {
            notes.push(format!(
                "column `{name}` is left out, since its name is one of times between rows; use it by --source"
            ));
        } else if is_surface || is_among(LABELS, &base) || is_label(&cells) {
            notes.push(format!(
                "column `{name}` looks like a label, and is left out; name it by --surface, --user or \
                 --trial, or use it by --source"
            ));
        } else {
            kept.push(column);
        }
    }
    if let Some((name, [one, other])) = quantities(head, &taken, kept.len() == 1) {
        return Err(format!(
            "column `{name}` says of what a row holds the value{} (`{one}`, `{other}`, …); save it with columns \
             for each, as by `pivot` of pandas or `pivot_wider` of R; if these are surfaces, name it by --surface",
            if kept.len() == 1 { "" } else { "s" }
        ));
    }
    let runs: BTreeSet<&str> = kept.iter().filter_map(|column| run(&column.base)).collect();
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
        let left_out = notes.iter().map(|note| format!("; {note}")).collect::<String>();
        let names = names.join(", ");
        return Err(format!("no column of samples is left; the columns: {names}{left_out}"));
    }
    let named = |(id, columns): (String, Vec<String>)| {
        Ok((SourceId::new(&id).map_err(|error| error.to_string())?, columns))
    };
    Ok((sources.into_iter().map(named).collect::<Result<_, String>>()?, notes))
}

fn number(cell: &[u8], delimiter: u8) -> Option<f64> {
    Numbers::new(delimiter).read(cell).ok().filter(|number| !number.is_nan())
}

/// The remark that a column that mostly holds texts is left out. An error if numbers
/// with other signs are among them, or if it `may_name` surfaces and holds several texts.
fn of_texts(
    name: &str,
    cells: &[Vec<u8>],
    delimiter: u8,
    may_name: bool,
) -> Result<Option<String>, String> {
    let is_text = |cell: &&Vec<u8>| number(cell, delimiter).is_none() && !is_missing(cell);
    let units: BTreeSet<String> = cells.iter().map(|cell| shown(cell).into_owned()).collect();
    if units.len() > 1 && units.iter().all(|unit| is_unit(unit)) {
        let units = units.into_iter().collect::<Vec<_>>().join(", ");
        return Err(format!(
            "column `{name}` holds several units ({units}), so that values beside it are not in one; bring them to \
             one unit first, or name the columns to use by --source"
        ));
    }
    let Some(text) = cells.iter().find(is_text) else {
        let is_empty = cells.iter().all(|cell| is_missing(cell));
        let empty = || format!("column `{name}` is left out, since most of its cells are empty");
        return Ok((!is_empty).then(empty));
    };
    if number(bare(text), delimiter).is_some() {
        return Err(format!(
            "column `{name}` holds `{}`: remove what stands beside the number, or name the columns to use \
             by --source",
            shown(text)
        ));
    }
    if let Some(other) = cells.iter().find(|cell| may_name && **cell != cells[0]) {
        return Err(format!(
            "column `{name}` holds `{}` and `{}`: give --surface '{name}' if these are surfaces, or name \
             the columns to use by --source",
            shown(&cells[0]),
            shown(other)
        ));
    }
    let text = shown(text);
    Ok(Some(format!(
        "column `{name}` is left out, since most of its cells are no numbers: `{text}`"
    )))
}

/// The name of a column of texts that say what the values of a row are, and two of them: most rows have another
/// text than the row before, and each text comes again; or rows hold a single value, and the column is called so.
fn quantities(
    head: &Head,
    taken: &BTreeSet<usize>,
    is_single: bool,
) -> Option<(String, [String; 2])> {
    let columns = head.layout.columns.iter().enumerate();
    let mut free = columns.filter(|(at, _)| !taken.contains(at));
    free.find_map(|(at, column)| {
        let cells = head.cells(at);
        let is_called = is_among(QUANTITIES, &plain(&column.base));
        // Numbers may number sensors; of other texts, a number with a sign beside it is none.
        let begins = |cell: &Vec<u8>| cell.iter().find(|byte| !b"+-. ".contains(byte)).copied();
        let is_text = !column.is_numeric
            && !cells.iter().filter_map(begins).any(|first| first.is_ascii_digit());
        let numbers_sensors = || is_called && cells.iter().all(|cell| whole(cell).is_some());
        if !(is_text || numbers_sensors()) {
            return None;
        }
        let different: BTreeSet<&Vec<u8>> = cells.iter().filter(|cell| !is_missing(cell)).collect();
        let changes = cells.windows(2).filter(|two| two[0] != two[1]).count();
        let come_again = 2 * changes > cells.len() && 4 * different.len() <= cells.len();
        let mut first = different.into_iter();
        let two = [first.next()?, first.next()?].map(|text| shown(text).into_owned());
        let is_one = is_single && is_called && is_text || come_again;
        (is_one && !is_time(&head.layout.columns, at)).then(|| (column.name.clone(), two))
    })
}

/// The run that a name tells: `Run 1: Force`, or `Force (N) Run #1`.
fn run(name: &str) -> Option<&str> {
    let is_number = |text: &str| text.trim_start_matches('#').bytes().all(|b| b.is_ascii_digit());
    let after = name.rfind(" Run ").filter(|at| is_number(&name[at + " Run ".len()..]));
    after.map(|at| &name[at + 1..]).or_else(|| Some(name.rsplit_once(": ")?.0))
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

/// Whether a column got its name by its place, or counts the columns.
fn is_nameless(name: &str) -> bool {
    name.strip_prefix("column ").unwrap_or(name).bytes().all(|byte| byte.is_ascii_digit())
}

/// A cell without brackets, a semicolon or a checksum beside its number.
fn bare(cell: &[u8]) -> &[u8] {
    let end = cell.iter().position(|byte| *byte == b'*').unwrap_or(cell.len());
    let is_mark = |byte: &u8| b"()[]{};".contains(byte);
    let from = cell[..end].iter().position(|byte| !is_mark(byte)).unwrap_or(end);
    let to =
        cell[from..end].iter().rposition(|byte| !is_mark(byte)).map_or(from, |at| from + at + 1);
    &cell[from..to]
}

/// Whether numbers of a column that is called so rise like a clock or a counter: they hardly ever fall, or mostly
/// rise by one step, where a counter begins anew after some.
fn runs_on(values: &[f64]) -> bool {
    let falls = values.windows(2).filter(|two| two[1] < two[0]).count();
    falls * 20 < values.len() && values.last() > values.first() || rises_evenly(values, 0.1)
}

/// Whether numbers rise like a clock or a counter, whatever they are called: by one step, or as the part of a
/// second does.
pub(super) fn runs_surely(values: &[f64]) -> bool {
    rises_evenly(values, 0.01) || are_parts_of_seconds(values)
}

/// Whether nearly all numbers rise by one step, to this share of it.
fn rises_evenly(values: &[f64], tolerance: f64) -> bool {
    let mut steps: Vec<f64> = values.windows(2).map(|two| two[1] - two[0]).collect();
    steps.sort_by(f64::total_cmp);
    let Some(middle) = steps.get(steps.len() / 2).filter(|_| values.len() >= SURELY_COUNTED) else {
        return false;
    };
    let is_alike = |step: &&f64| **step > 0.0 && (*step - middle).abs() <= tolerance * middle;
    steps.iter().filter(is_alike).count() * 10 >= steps.len() * 9
}

/// Whether numbers are thousandths, millionths or billionths of seconds that pass.
fn are_parts_of_seconds(values: &[f64]) -> bool {
    let most = values.iter().copied().fold(0.0, f64::max);
    let Some(unit) = [1e3, 1e6, 1e9].into_iter().find(|unit| (0.9..1.0).contains(&(most / unit)))
    else {
        return false;
    };
    let count =
        |is: &dyn Fn(f64) -> bool| values.windows(2).filter(|two| is(two[1] - two[0])).count();
    let is_whole = values.iter().all(|x| *x >= 0.0 && x.fract() == 0.0);
    let (rises, shallow) =
        (count(&|step| step > 0.0), count(&|step| step <= 0.0 && step > -0.5 * unit));
    is_whole && values.len() >= SURELY_COUNTED && shallow == 0 && rises * 5 >= values.len() * 4
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
