//! Reads the rows of a table, in text or Parquet, into a group for each trial.

use std::path::Path;

use super::cell::Numbers;
use super::gather::{Gathered, Group};
use super::stamp::Stamps;
use super::text::{Lines, shortened, shown};
use super::{Clock, Form, Head, columns, name_of, session_name, trial_number};
use crate::trial::{EXPERT, Series, TrialKey, normal};

/// The places of a table's columns, by a [`Form`].
pub(super) struct Table<'a> {
    head: &'a Head,
    labels: [Option<usize>; 4],
    pub stamps: Option<(usize, Stamps)>,
    pub said: Option<String>,
    /// The columns of all sources, in their order.
    values: Vec<usize>,
}

impl<'a> Table<'a> {
    pub(super) fn new(head: &'a Head, form: &Form) -> Result<Self, String> {
        let layout = &head.layout;
        let mut labels = [None; 4];
        for (column, label) in labels.iter_mut().zip(&form.labels) {
            *column = label.as_ref().map(|label| layout.column(label)).transpose()?;
        }
        let (mut stamps, mut said) = (None, None);
        if let Clock::Times { column, unit_s } = &form.clock {
            let at = layout.column(column)?;
            let column = &layout.columns[at];
            let unit_ns = unit_s.map(|unit| unit * 1e9).or_else(|| columns::told_unit_ns(column));
            let (known, how) = Stamps::of(&head.cells(at), unit_ns, form.from_1904)
                .map_err(|problem| format!("column `{}` {problem}", column.name))?;
            said = Some(format!("times are column `{}`, {how}", column.name));
            stamps = Some((at, known));
        }
        let columns = form.columns();
        let values = columns.iter().map(|name| layout.column(name)).collect::<Result<_, _>>()?;
        Ok(Self { head, labels, stamps, said, values })
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
        let mut of_name = match self.labels[0] {
            Some(_) => Default::default(),
            None => form.names.parts(&name_of(path)).ok_or_else(|| {
                format!("its name does not fit the pattern `{}`; see --names", form.names.0)
            })?,
        };
        of_name[3] = form.session_of(path)?;
        let widest = form.sources.iter().map(|(_, columns)| columns.len()).max().unwrap_or(1);
        let layout = &self.head.layout;
        let mut numbers = Numbers::new(layout.delimiter);
        let mut values = vec![0.0; self.values.len()];
        let (mut label, mut known, mut at) = (Vec::new(), None::<Vec<u8>>, 0);
        let mut list = Vec::new();
        while let Some((line, text)) = lines.next()? {
            let mut cells = reused(list);
            let there = line >= layout.first
                && layout
                    .cells(text, &mut cells)
                    .map_err(|problem| format!("line {line} {problem}: {}", shortened(text)))?;
            if !there || text == self.head.names.as_slice() {
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
                        gathered.places.insert(label.clone(), at);
                        at
                    }
                };
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
            for (value, column) in values.iter_mut().zip(&self.values) {
                let number = numbers.read(cells[*column]).and_then(|number| {
                    let is_small = number.is_nan() || (number as f32).is_finite();
                    is_small.then_some(number).ok_or_else(|| "is not a finite number".into())
                });
                *value = number.map_err(|problem| {
                    let (name, cell) = (&layout.columns[*column].name, shown(cells[*column]));
                    format!("line {line}, column `{name}`: `{cell}` {problem}")
                })? as f32;
            }
            gathered.push(at, time, &values).map_err(|error| {
                format!("line {line}: cannot keep its rows in {}: {error}", scratch.display())
            })?;
            list = reused(cells);
        }
        match gathered.groups.is_empty() {
            true => Err("it holds no rows of numbers; expected a line for each sample".into()),
            false => Ok(gathered),
        }
    }

    fn key(&self, cells: &[&[u8]], of_name: &[Option<String>; 4]) -> Result<TrialKey, String> {
        let cell = |at: usize| match self.labels[at] {
            Some(column) => Some(shown(cells[column]).into_owned()),
            None => of_name[at].clone(),
        };
        let number = cell(2).map(|text| {
            trial_number(&text)
                .ok_or_else(|| format!("the trial is `{text}`; expected a whole number"))
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
    if let Some(last) = group.last_time
        && time < last
    {
        let before = last - group.offset;
        match lasts {
            Some(lasts) if before as f64 > 0.9 * lasts && (read as f64) < 0.1 * lasts => {
                group.offset = group.offset.checked_add(lasts as i64).ok_or_else(beyond)?;
                time = read.checked_add(group.offset).ok_or_else(beyond)?;
            }
            _ => return Err("the time does not rise".into()),
        }
    }
    group.last_time = Some(time);
    Ok(time)
}
