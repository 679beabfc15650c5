//! Reads the rows of a table, in text or Parquet, into a group for each trial.

use std::borrow::Cow;
use std::path::Path;

use super::cell::{Numbers, is_missing, shortened, shown, thousands};
use super::gather::{Gathered, Group};
use super::layout::Line;
use super::mend::MOST_FILLED;
use super::stamp::Stamps;
use super::text::Lines;
use super::{Clock, Form, Head, columns, names::trial_number, session_name};
use crate::trial::{EXPERT, Series, TrialKey, normal};

/// The places of a table's columns, by a [`Form`].
pub(super) struct Table<'a> {
    head: &'a Head,
    labels: [Option<usize>; 4],
    pub stamps: Option<(usize, Stamps)>,
    pub said: Option<String>,
    /// The columns of all sources, in their order.
    values: Vec<usize>,
    /// A column of times or counts that are not used, since the rate is given.
    unused_clock: Option<usize>,
}

/// Rows after which an empty line or a comment may divide trials. Some programs write one after each few rows.
const FEWEST_DIVIDED: usize = 16;

/// Counters of 16 and 32 bits begin anew here, though the trial goes on.
const WRAPS: [f64; 2] = [65_536.0, 4_294_967_296.0];

/// A row may come after this many rows of later times, as by a network or in batches of several threads.
const MOST_OVERTAKEN: f64 = 100.0;
const FEWEST_OF_TRIAL: usize = 8;

impl<'a> Table<'a> {
    pub(super) fn new(head: &'a Head, form: &Form) -> Result<Self, String> {
        let layout = &head.layout;
        let mut labels = [None; 4];
        for (column, label) in labels.iter_mut().zip(&form.labels) {
            *column = label.as_ref().map(|label| layout.column(label)).transpose()?;
        }
        if let (Some(own), Clock::Rate(given)) = (layout.rate_hz, &form.clock)
            && own != *given
        {
            return Err(format!(
                "its second row says {own} Hz, but it would be read at {given} Hz; import the tables of each \
                 rate on their own"
            ));
        }
        columns::oldest_first(head)?;
        let (mut stamps, mut said) = (None, None);
        if let Clock::Times { column, unit_s } = &form.clock {
            let at = layout.column(column)?;
            let name = &layout.columns[at].name;
            let (known, how) = columns::stamps(head, at, *unit_s, form.from_1904)
                .map_err(|problem| format!("column `{name}` {problem}"))?;
            said = Some(format!("times are column `{name}`, {how}"));
            stamps = Some((at, known));
        }
        let columns = form.columns();
        let values =
            columns.iter().map(|name| layout.column(name)).collect::<Result<Vec<_>, _>>()?;
        for (number, (&at, name)) in values.iter().zip(&columns).enumerate() {
            thousands(&head.cells(at)).map_err(|problem| format!("column `{name}` {problem}"))?;
            let (own, first) = (&layout.columns[at].unit, form.units.get(number));
            if first.is_some_and(|first| first != own) {
                let [own, first] = [Some(own), first]
                    .map(|unit| unit.and_then(Option::as_deref).unwrap_or("no unit"));
                return Err(format!(
                    "column `{name}` has {own}, but {first} in the first table; tables of one library \
                     have the same units"
                ));
            }
        }
        let is_other = |at: &usize| !values.contains(at) && !labels.contains(&Some(*at));
        let unused_clock = match form.clock {
            // Times that cannot be read are not needed.
            Clock::Rate(_) => {
                let unused = columns::clock(head, None, form.from_1904).ok().flatten();
                let unused = unused.map(|name| layout.column(&name)).transpose()?;
                let unused = unused.filter(is_other).or_else(|| columns::counter(head, is_other));
                unused.filter(|at| !columns::is_beside_seconds(head, *at))
            }
            Clock::Times { .. } => None,
        };
        Ok(Self { head, labels, stamps, said, values, unused_clock })
    }

    /// Reads all rows into their groups. `scratch` is a folder for rows that do not fit into memory.
    pub(super) fn gather<'s>(
        &self,
        path: &Path,
        form: &Form,
        lines: &mut Lines,
        scratch: &'s Path,
    ) -> Result<Gathered<'s>, String> {
        let mut gathered = Gathered::new(self.values.len(), self.stamps.is_some(), scratch);
        if !form.known.is_empty() {
            let columns = self.head.layout.columns.iter().filter(|column| column.is_numeric);
            let names = columns.map(|column| column.name.clone());
            gathered.said.further = names.filter(|name| !form.known.contains(name)).collect();
        }
        let mut of_name = form.of_name(path)?;
        of_name[3] = form.session_of(path)?;
        let widest = form.widest();
        let layout = &self.head.layout;
        let mut numbers = Numbers::new(layout.delimiter);
        let mut values = vec![0.0; self.values.len()];
        let mut steps = vec![Steps::default(); values.len()];
        let (mut label, mut known, mut at) = (Vec::new(), None::<Vec<u8>>, 0);
        let is_bare = self.stamps.is_none() && self.labels == [None; 4];
        // Without numbers of trials, rows alone tell where another one begins.
        let are_unnumbered = self.labels[2].is_none();
        // Whether the next row does not follow the one before it in its trial.
        let mut is_broken = false;
        // Rows since an empty line or a comment, and the first and the latest of the unused times.
        let (mut undivided, mut times) = (0, None::<(f64, f64)>);
        let mut list = Vec::new();
        while let Some((line, text)) = lines.next()? {
            let mut cells = reused(list);
            let found = match line < layout.first {
                true => Ok(Line::Nothing),
                false => layout.cells(text, &mut cells),
            };
            let found = match found {
                Ok(found) => found,
                Err(problem) => {
                    let problem = format!("line {line} {problem}: {}", shortened(text));
                    list = reused(cells);
                    if !lines.is_cut() {
                        return Err(problem);
                    }
                    // Writing the last line was cut off.
                    gathered.said.no_rows += 1;
                    continue;
                }
            };
            let is_text = found == Line::Text;
            gathered.said.no_rows += usize::from(is_text);
            let are_names = found == Line::Row && text == self.head.names.as_slice();
            // Another trial may begin there.
            is_broken |= are_names || is_text;
            if found == Line::Nothing {
                is_broken |= undivided >= FEWEST_DIVIDED && are_unnumbered;
                undivided = 0;
            }
            // If nothing else says that a sample is missing, a row of empty cells does.
            let is_empty = || {
                is_bare
                    && cells.len() == layout.columns.len()
                    && cells.len() > 1
                    && cells.iter().all(|cell| cell.is_empty())
            };
            if are_names || found != Line::Row && !is_empty() {
                list = reused(cells);
                continue;
            }
            if self.labels[..3].iter().flatten().any(|column| is_missing(cells[*column])) {
                gathered.said.unlabelled += 1;
                is_broken = true;
                list = reused(cells);
                continue;
            }
            label.clear();
            for column in self.labels.iter().flatten() {
                label.extend_from_slice(cells[*column]);
                label.push(0);
            }
            if known.as_ref() != Some(&label) {
                at = match gathered.places.get(&label) {
                    Some(at) => *at,
                    None => {
                        let key = self.key(&cells, &of_name);
                        let key = key.map_err(|problem| format!("line {line}: {problem}"))?;
                        let at = gathered.group(key);
                        let trial = self.labels[2].map(|column| shown(cells[column]));
                        same_trial(&mut gathered.groups[at], trial.unwrap_or_default())
                            .map_err(|problem| format!("line {line}: {problem}"))?;
                        gathered.places.insert(label.clone(), at);
                        at
                    }
                };
                // A surface that comes again is another stretch of rows.
                is_broken |= are_unnumbered;
                known = Some(label.clone());
            }
            let group = &mut gathered.groups[at];
            if (group.rows + 1).saturating_mul(widest) > Series::MOST_SAMPLES {
                return Err(format!(
                    "line {line}: {} has more than {} samples, too many for a trial; name a column of \
                     trials by --trial, or cut the table",
                    group.key,
                    Series::MOST_SAMPLES
                ));
            }
            let time = match &self.stamps {
                None => None,
                Some((column, stamps)) => {
                    let cell = cells[*column];
                    let is_number = matches!(stamps, Stamps::Numbers { .. } | Stamps::Days { .. });
                    let marked = if is_number { numbers.check(cell) } else { Ok(()) };
                    let marked = marked.map_err(|problem| format!("`{}` {problem}", shown(cell)));
                    let time = marked.and_then(|()| time(stamps, cell, group));
                    let time = time.map_err(|problem| {
                        let name = &layout.columns[*column].name;
                        format!("line {line}, column `{name}`: {problem}")
                    })?;
                    Some(time)
                }
            };
            for ((value, column), steps) in values.iter_mut().zip(&self.values).zip(&mut steps) {
                let number = numbers.read(cells[*column]).and_then(|number| {
                    let is_small = number.is_nan() || (number as f32).is_finite();
                    is_small.then_some(number).ok_or_else(|| "is not a finite number".into())
                });
                let number = number.map_err(|problem| {
                    let (name, cell) = (&layout.columns[*column].name, shown(cells[*column]));
                    format!("line {line}, column `{name}`: `{cell}` {problem}")
                })?;
                *value = number as f32;
                steps.add(number);
            }
            undivided += 1;
            let unused = self.unused_clock.and_then(|column| numbers.read(cells[column]).ok());
            if let Some(time) = unused.filter(|time| !time.is_nan()) {
                let (first, last) = times.unwrap_or((time, time));
                // Not where two rows are swapped.
                let begins_anew = time < last
                    && time - first < 0.5 * (last - first)
                    && !WRAPS.iter().any(|wrap| (0.8..=1.0).contains(&(last / wrap)));
                is_broken |= begins_anew && are_unnumbered;
                if begins_anew && are_unnumbered {
                    let column = self.unused_clock.map(|at| layout.columns[at].name.clone());
                    gathered.said.parted_by = column;
                }
                times = Some((if begins_anew { time } else { first }, time));
            }
            let full = |error| {
                format!("line {line}: cannot keep its rows in {}: {error}", scratch.display())
            };
            if std::mem::take(&mut is_broken) && time.is_none() && gathered.groups[at].rows > 0 {
                // A gap of unknown length, which cuts the trial.
                let nothing = vec![f32::NAN; values.len()];
                for _ in 0..=MOST_FILLED {
                    gathered.push(at, None, &nothing).map_err(full)?;
                }
            }
            gathered.push(at, time, &values).map_err(full)?;
            list = reused(cells);
        }
        let of_columns = self.values.iter().zip(&steps).filter(|(_, steps)| steps.are_lost());
        let names = of_columns.map(|(column, _)| layout.columns[*column].name.clone());
        gathered.said.coarse = names.collect();
        match gathered.groups.is_empty() {
            true if gathered.said.unlabelled > 0 => Err("no row of it has a label".into()),
            true => Err("it holds no rows of numbers; expected a line for each sample".into()),
            false => Ok(gathered),
        }
    }

    fn key(&self, cells: &[&[u8]], of_name: &[Option<String>; 4]) -> Result<TrialKey, String> {
        let cell = |at: usize| match self.labels[at] {
            Some(column) => Some(shown(cells[column]).replace("\"\"", "\"")),
            None => of_name[at].clone(),
        };
        let number = cell(2).map(|text| {
            trial_number(&text)
                .ok_or_else(|| format!(
                    "the trial is `{text}`; expected a whole number (--trial, or {{trial}} in --names, such \
                     as '{{surface}}/{{trial}}/{text}')"
                ))
        });
        let (surface, user) = (cell(0).unwrap_or_default(), cell(1).unwrap_or(EXPERT.into()));
        if surface.is_empty() || user.is_empty() {
            return Err("no surface or no user is named".into());
        }
        let session = cell(3).filter(|text| !text.is_empty());
        let session = session.as_deref().map(session_name).transpose()?;
        let number = number.transpose()?.unwrap_or(1);
        Ok(TrialKey::new(normal(&surface), normal(&user), number).with_session(session))
    }
}

/// The steps between the numbers of a column, and how many of them a sample cannot hold.
#[derive(Clone, Default)]
struct Steps {
    last: f64,
    all: usize,
    lost: usize,
}

impl Steps {
    fn add(&mut self, number: f64) {
        let is_step = number != self.last && !number.is_nan();
        self.all += usize::from(is_step);
        self.lost += usize::from(is_step && number as f32 == self.last as f32);
        self.last = number;
    }

    fn are_lost(&self) -> bool {
        self.lost * 2 > self.all
    }
}

/// Remembers how the trial of a new group is written; refuses another text for that of a known group, unless
/// both are the same number.
fn same_trial(group: &mut Group, text: Cow<'_, str>) -> Result<(), String> {
    let number = |text: &str| text.replace(',', ".").parse::<f64>().ok();
    let known = group.trial.get_or_insert_with(|| text.to_string());
    if *known == text || number(&text).is_some_and(|n| number(known) == Some(n)) {
        return Ok(());
    }
    Err(format!(
        "the trials `{known}` and `{text}` end with one number; give each a number of its own"
    ))
}

/// An empty list in the memory of another one, for cells of the next line.
fn reused<'a>(mut list: Vec<&[u8]>) -> Vec<&'a [u8]> {
    list.clear();
    // Nothing is left that could be converted; the list keeps its memory.
    list.into_iter().map(|_| &[][..]).collect()
}

/// The time of a row of a group, in ns.
fn time(stamps: &Stamps, cell: &[u8], group: &mut Group) -> Result<i64, String> {
    let Some(read) = stamps.read(cell) else {
        return Err(format!("`{}` is not a time like those before", shown(cell)));
    };
    let lasts = match stamps {
        Stamps::Clock { lasts } => Some(*lasts as f64),
        // Counters of 32 bits, such as Arduino's `micros`, begin anew.
        Stamps::Numbers { unit_ns, since_1970: false } => Some(4_294_967_296.0 * unit_ns),
        _ => None,
    };
    let beyond = || "the time is beyond all ranges".to_string();
    let mut time = read.checked_add(group.offset).ok_or_else(beyond)?;
    let [first, latest, last] = group.times.unwrap_or([time; 3]);
    if time < last {
        let before = latest - group.offset;
        let most =
            latest.saturating_sub(first) as f64 * (MOST_OVERTAKEN / group.rows as f64).min(0.5);
        match lasts {
            Some(lasts) if before as f64 > 0.9 * lasts && (read as f64) < 0.1 * lasts => {
                group.offset = group.offset.checked_add(lasts as i64).ok_or_else(beyond)?;
                time = read.checked_add(group.offset).ok_or_else(beyond)?;
            }
            // A clock that begins anew goes back further, and not before a trial has some rows.
            _ if group.rows <= FEWEST_OF_TRIAL || (latest.saturating_sub(time) as f64) < most => {}
            _ => {
                return Err(
                    "the time does not rise; if a trial begins there, name trials by --trial, or \
                            put each into a file of its own"
                        .into(),
                );
            }
        }
    }
    group.times = Some([first, latest.max(time), time]);
    Ok(time)
}
