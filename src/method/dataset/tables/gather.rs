//! Gathers the rows of a table by trial. What does not fit into memory waits in a temporary file.

use std::collections::HashMap;
use std::fs::File;
use std::io::{self, BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::Path;

use super::Said;
use crate::trial::TrialKey;

/// How many bytes of rows are held in memory.
const MOST_HELD: usize = 32 << 20;

/// Rows of one trial: times in ns (empty without a clock), and values; NaN if missing.
#[derive(Debug, Default)]
pub(crate) struct Rows {
    pub times: Vec<i64>,
    pub values: Vec<f32>,
}

#[derive(Debug)]
pub(crate) struct Group {
    pub key: TrialKey,
    /// The trial as the table's first row of it writes it.
    pub trial: Option<String>,
    /// Number of rows, on disk and in memory.
    pub rows: usize,
    /// The first and the latest time, and that of the last row.
    pub times: Option<[i64; 3]>,
    /// Time to add to each time, since the clock began anew.
    pub offset: i64,
    held: Rows,
    /// Places in the file, each with a number of rows.
    parts: Vec<(u64, usize)>,
}

pub(crate) struct Gathered<'a> {
    /// Values in each row.
    columns: usize,
    has_times: bool,
    scratch: &'a Path,
    pub groups: Vec<Group>,
    of_keys: HashMap<TrialKey, usize>,
    /// The group of each combination of labels, as they are written.
    pub places: HashMap<Vec<u8>, usize>,
    pub said: Said,
    held: usize,
    file: Option<File>,
}

impl<'a> Gathered<'a> {
    pub(crate) fn new(columns: usize, has_times: bool, scratch: &'a Path) -> Self {
        let (groups, of_keys, places) = (Vec::new(), HashMap::new(), HashMap::new());
        let said = Said::default();
        Self { columns, has_times, scratch, groups, of_keys, places, said, held: 0, file: None }
    }

    /// The group of a trial, which is new if no row of it came yet.
    pub(crate) fn group(&mut self, key: TrialKey) -> usize {
        let at = *self.of_keys.entry(key.clone()).or_insert(self.groups.len());
        if at < self.groups.len() {
            return at;
        }
        self.groups.push(Group {
            key,
            trial: None,
            rows: 0,
            times: None,
            offset: 0,
            held: Rows::default(),
            parts: Vec::new(),
        });
        at
    }

    pub(crate) fn push(&mut self, at: usize, time: Option<i64>, values: &[f32]) -> io::Result<()> {
        let group = &mut self.groups[at];
        group.rows += 1;
        group.held.times.extend(time);
        group.held.values.extend_from_slice(values);
        self.held += 8 * usize::from(time.is_some()) + 4 * values.len();
        if self.held > MOST_HELD { self.store() } else { Ok(()) }
    }

    fn store(&mut self) -> io::Result<()> {
        let file = match &mut self.file {
            Some(file) => file,
            none => none.insert(tempfile::tempfile_in(self.scratch)?),
        };
        let mut at = file.seek(SeekFrom::End(0))?;
        let mut to = BufWriter::with_capacity(1 << 16, file);
        for group in &mut self.groups {
            let rows = group.held.values.len() / self.columns;
            if rows > 0 {
                group.held.times.iter().try_for_each(|time| to.write_all(&time.to_le_bytes()))?;
                group.held.values.iter().try_for_each(|x| to.write_all(&x.to_le_bytes()))?;
                group.parts.push((at, rows));
                at += (8 * group.held.times.len() + 4 * group.held.values.len()) as u64;
                group.held = Rows::default();
            }
        }
        self.held = 0;
        to.flush()
    }

    pub(crate) fn take(&mut self, at: usize) -> io::Result<Rows> {
        let group = &mut self.groups[at];
        let held = std::mem::take(&mut group.held);
        if group.parts.is_empty() {
            return Ok(held);
        }
        let mut all = Rows::default();
        if self.has_times {
            all.times.reserve_exact(group.rows);
        }
        all.values.reserve_exact(group.rows * self.columns);
        // A group has parts only after `store` made the file.
        let Some(file) = &mut self.file else { return Ok(held) };
        for (start, rows) in std::mem::take(&mut group.parts) {
            file.seek(SeekFrom::Start(start))?;
            let mut from = BufReader::with_capacity(1 << 16, &*file);
            if self.has_times {
                for _ in 0..rows {
                    all.times.push(i64::from_le_bytes(taken(&mut from)?));
                }
            }
            for _ in 0..rows * self.columns {
                all.values.push(f32::from_le_bytes(taken(&mut from)?));
            }
        }
        all.times.extend(held.times);
        all.values.extend(held.values);
        Ok(all)
    }
}

fn taken<const N: usize>(from: &mut impl Read) -> io::Result<[u8; N]> {
    let mut bytes = [0; N];
    from.read_exact(&mut bytes).map(|()| bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_that_were_stored_come_back_in_their_order() {
        let dir = tempfile::tempdir().unwrap();
        let mut gathered = Gathered::new(2, true, dir.path());
        let keys = ["oak", "ash"].map(|name| TrialKey::new(name, "anna", 1));
        for row in 0..100 {
            let at = gathered.group(keys[row % 3 % 2].clone());
            let x = row as f32;
            gathered.push(at, Some(row as i64), &[x, -x]).unwrap();
            if row % 30 == 29 {
                gathered.store().unwrap();
            }
        }
        let all = [0, 1].map(|at| gathered.take(at).unwrap());
        let of = |which: usize| (0..100).filter(move |row| row % 3 % 2 == which);
        for (rows, which) in all.iter().zip([0, 1]) {
            assert_eq!(rows.times, of(which).map(|row| row as i64).collect::<Vec<_>>());
            let values = of(which).flat_map(|row| [row as f32, -(row as f32)]);
            assert_eq!(rows.values, values.collect::<Vec<_>>());
        }
    }
}
