//! Makes trials with a fixed rate of the rows of a table: drops repeated rows, fills short gaps by
//! straight lines and says where, and cuts at longer ones, which are never filled.

use super::gather::Rows;
use super::grid::{Grid, places};
use crate::trial::Series;

/// The longest run of samples that is filled.
pub(super) const MOST_FILLED: usize = 5;
/// A longer step from row to row, in usual steps, is a gap that is not filled.
pub(super) const LONGEST_STEP: f64 = MOST_FILLED as f64 + 1.5;
/// The largest share of the samples of a channel that is filled.
pub(super) const SHARE_FILLED: f64 = 0.05;
/// The fewest rows of a part of a trial that was cut.
const FEWEST: usize = 10;
pub(super) const S: f64 = 1e9;

/// The treatment of gaps that are too long to be filled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Gaps {
    /// Cut the trial there, and make a trial of each part
    Cut,
    /// Do not use the trial
    Error,
}

/// Frames without gaps at a fixed rate.
#[derive(Debug)]
pub(crate) struct Piece {
    /// Time of the first frame in ns; 0 without a clock.
    pub start: i64,
    pub rate_hz: f64,
    /// Values in each frame.
    pub width: usize,
    /// Frames of all columns, row by row.
    pub values: Vec<f32>,
    /// For each frame and column, whether the value was filled in; empty if none was.
    pub filled: Vec<bool>,
}

#[derive(Debug, Default)]
pub(crate) struct Mended {
    /// The parts of the trial between gaps: one piece of all sources, or one of each.
    pub parts: Vec<Vec<Piece>>,
    /// Rows that had the time of the row before.
    pub repeated: usize,
    pub too_short: usize,
    /// Rows a second, if the rows were interpolated in time.
    pub resampled_hz: Option<f64>,
}

/// Makes the parts of one trial whose columns, of these `names`, share their rows.
pub(super) fn mend(
    mut rows: Rows,
    names: &[String],
    rate_hz: Option<f64>,
    gaps: Gaps,
) -> Result<Mended, String> {
    let width = names.len();
    let mut mended = Mended::default();
    let mut grid = None;
    if rate_hz.is_none() {
        mended.repeated = without_repeated(&mut rows, width)?;
        grid = Some(Grid::of(&rows.times)?);
    }
    let count = rows.values.len() / width;
    if count < 2 {
        return Err("has a single row; expected a row for each sample".into());
    }
    let missing = |row: usize, column: usize| rows.values[row * width + column].is_nan();
    // Rows that are cut out, and rows before which the trial is cut.
    let (mut out, mut cuts) = (vec![false; count], vec![false; count]);
    for (column, name) in names.iter().enumerate() {
        let mut run = 0;
        let mut all = 0;
        for row in 0..=count {
            if row < count && missing(row, column) {
                run += 1;
                all += 1;
                continue;
            }
            if run > MOST_FILLED {
                out[row - run..row].fill(true);
            }
            run = 0;
        }
        if all == count {
            return Err(format!("has no value in column `{name}`"));
        }
    }
    if let Some(grid) = &grid {
        let times = rows.times.windows(2).zip(&mut cuts[1..]);
        // Two times may be further apart than an i64 can say.
        let long = |two: &[i64]| grid.steps(two[1].saturating_sub(two[0]));
        times.for_each(|(two, cut)| *cut = long(two) > LONGEST_STEP);
        let bursts = cuts.iter().filter(|cut| **cut).count();
        if bursts > 2 && bursts * 50 > count {
            return Err(format!(
                "comes in bursts: {bursts} pauses in {count} rows, so its times are not those of its \
                 samples; give --rate HZ",
            ));
        }
    }
    let mut ranges: Vec<(usize, usize)> = Vec::new();
    for row in 0..count {
        match ranges.last_mut() {
            _ if out[row] => {}
            Some((_, end)) if *end == row && !cuts[row] => *end += 1,
            _ => ranges.push((row, row + 1)),
        }
    }
    let is_cut = ranges.len() > 1;
    if is_cut && gaps == Gaps::Error {
        let at = ranges.first().map_or(0, |(_, end)| *end);
        return Err(format!(
            "has a gap of more than {MOST_FILLED} samples after its row {at}; --gaps cut makes a trial \
             of each part"
        ));
    }
    for (start, end) in ranges {
        let has_all = |row: &usize| (0..width).all(|column| !missing(*row, column));
        let ends = ((start..end).find(has_all), (start..end).rev().find(has_all));
        let fewest = if is_cut { FEWEST } else { 2 };
        match ends {
            (Some(start), Some(end)) if end + 1 - start >= fewest => {
                let piece = piece(&rows, start..end + 1, names, rate_hz, grid.as_ref())?;
                if let (Some(grid), true) = (&grid, piece.1) {
                    mended.resampled_hz = Some(S / grid.step);
                }
                mended.parts.push(vec![piece.0]);
            }
            _ => mended.too_short += 1,
        }
    }
    match mended.parts.is_empty() {
        true => Err(format!(
            "has no {FEWEST} rows in a row without a gap; if rows of other trials stand between them, sort the \
             rows by trial; if these sensors have different rates, name each by --source"
        )),
        false => Ok(mended),
    }
}

/// Drops rows that have the time of the next row, and returns their number.
fn without_repeated(rows: &mut Rows, width: usize) -> Result<usize, String> {
    let (mut kept, mut different) = (0, 0);
    let count = rows.times.len();
    for row in 0..count {
        let is_repeated = kept > 0 && rows.times[kept - 1] == rows.times[row];
        kept += usize::from(!is_repeated);
        rows.times[kept - 1] = rows.times[row];
        for column in 0..width {
            let (from, to) = (row * width + column, (kept - 1) * width + column);
            let (last, earlier) = (rows.values[from], rows.values[to]);
            different += usize::from(is_repeated && column == 0 && last != earlier);
            if !(is_repeated && last.is_nan()) {
                rows.values[to] = last;
            }
        }
    }
    rows.times.truncate(kept);
    rows.values.truncate(kept * width);
    if different * 5 > count {
        return Err(format!(
            "repeats times: {different} of {count} rows have the time of the row before, so the clock is \
             coarser than the samples; give --rate HZ"
        ));
    }
    Ok(count - kept)
}

/// Fills what is missing in a range of rows, and brings it to the rate; true if interpolated in time.
fn piece(
    rows: &Rows,
    range: std::ops::Range<usize>,
    names: &[String],
    rate_hz: Option<f64>,
    grid: Option<&Grid>,
) -> Result<(Piece, bool), String> {
    let width = names.len();
    let mut values = rows.values[range.start * width..range.end * width].to_vec();
    let times = if grid.is_some() { &rows.times[range.clone()] } else { &[] };
    let count = range.len();
    let mut filled = vec![false; values.len()];
    for (column, name) in names.iter().enumerate() {
        let mut known = 0;
        let mut missing = 0;
        for row in 0..count {
            if values[row * width + column].is_nan() {
                missing += 1;
                continue;
            }
            let (a, b) = (values[known * width + column], values[row * width + column]);
            for between in known + 1..row {
                let place =
                    |row: usize| times.get(row).map_or(row as f64, |time| (time - times[0]) as f64);
                let share = (place(between) - place(known)) / (place(row) - place(known));
                values[between * width + column] = straight(a, b, share);
                filled[between * width + column] = true;
            }
            known = row;
        }
        if missing as f64 > SHARE_FILLED * count as f64 {
            return Err(format!(
                "misses {missing} of {count} values in column `{name}`; at most 5 % are filled: if this \
                 sensor has another rate than those beside it, name it by --source"
            ));
        }
    }
    let start = times.first().copied().unwrap_or(0);
    let Some(grid) = grid else {
        let filled = if filled.contains(&true) { filled } else { Vec::new() };
        return Ok((
            Piece { start, rate_hz: rate_hz.unwrap_or(1.0), width, values, filled },
            false,
        ));
    };
    let off = |(row, time): (usize, &i64)| (time - start) as f64 - row as f64 * grid.even;
    let (low, high) = times
        .iter()
        .enumerate()
        .map(off)
        .fold((0.0_f64, 0.0_f64), |(low, high), x| (low.min(x), high.max(x)));
    let is_even = high - low <= grid.tolerance;
    let mut piece = Piece { start, rate_hz: grid.rate_hz, width, values, filled };
    if !is_even {
        resample(&mut piece, times, grid)?;
    }
    if !piece.filled.contains(&true) {
        piece.filled.clear();
    }
    Ok((piece, !is_even))
}

fn straight(a: f32, b: f32, share: f64) -> f32 {
    (f64::from(a) + share * (f64::from(b) - f64::from(a))) as f32
}

/// Interpolates rows linearly at the rate of the grid. A frame counts as filled if the row before it or
/// after it was, or if rows are lost there.
fn resample(piece: &mut Piece, times: &[i64], grid: &Grid) -> Result<(), String> {
    let last = times.len() - 1;
    let long = (times[last] - times[0]) as f64;
    // No step is longer than `LONGEST_STEP` of the grid, so this is bounded by the rows.
    let count = (long * piece.rate_hz / S + 1e-6).floor() as usize + 1;
    if count > Series::MOST_SAMPLES {
        return Err(format!("is {:.0} minutes long, too long for a trial", long / S / 60.0));
    }
    let width = piece.width;
    let (mut values, mut filled) = (Vec::with_capacity(count * width), Vec::new());
    let (places, _) = places(times, grid.step);
    let lost: usize = places.iter().map(|steps| steps - 1).sum();
    if lost as f64 > SHARE_FILLED * (times.len() + lost) as f64 {
        return Err(format!(
            "misses {lost} of {} rows by its times; at most 5 % are filled: if the rows are even, give --rate HZ",
            times.len() + lost
        ));
    }
    let mut before = 0;
    for frame in 0..count {
        let at = frame as f64 * S / piece.rate_hz;
        while before + 2 <= last && (times[before + 1] - times[0]) as f64 <= at {
            before += 1;
        }
        let step = (times[before + 1] - times[before]) as f64;
        let share = ((at - (times[before] - times[0]) as f64) / step).clamp(0.0, 1.0);
        let is_lost = places[before] > 1 && (0.01..=0.99).contains(&share);
        for column in 0..width {
            let [a, b] = [before, before + 1].map(|row| row * width + column);
            values.push(straight(piece.values[a], piece.values[b], share));
            let of_filled = piece.filled[a] && share < 0.99 || piece.filled[b] && share > 0.01;
            filled.push(is_lost || of_filled);
        }
    }
    (piece.values, piece.filled) = (values, filled);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const NAN: f32 = f32::NAN;

    fn ms(times: &[i64]) -> Vec<i64> {
        times.iter().map(|time| time * 1_000_000).collect()
    }

    fn mended(times: &[i64], values: &[f32], gaps: Gaps) -> Result<Mended, String> {
        let rows = Rows { times: ms(times), values: values.to_vec() };
        let rate_hz = times.is_empty().then_some(100.0);
        mend(rows, &["x".to_string()], rate_hz, gaps)
    }

    fn rising(rows: usize) -> Vec<f32> {
        (0..rows).map(|row| row as f32).collect()
    }

    fn lengths(all: &Mended) -> Vec<usize> {
        all.parts.iter().map(|part| part[0].values.len()).collect()
    }

    #[test]
    fn uneven_times_are_resampled_by_straight_lines() {
        let rows = || (0..30_u16).filter(|row| *row != 3);
        let times: Vec<i64> = rows().map(|row| 10 * i64::from(row)).collect();
        let values: Vec<f32> = rows().map(f32::from).collect();
        let all = mended(&times, &values, Gaps::Cut).unwrap();
        assert_eq!(all.parts[0][0].values, (0..30_u16).map(f32::from).collect::<Vec<_>>());
        let filled = (0..30).filter(|row| all.parts[0][0].filled[*row]).collect::<Vec<_>>();
        assert_eq!((filled, all.parts[0][0].rate_hz, all.parts.len()), (vec![3], 100.0, 1));
        let said = mended(&[0, 10, 20, 40], &[0.0; 4], Gaps::Cut).unwrap_err();
        assert!(said.contains("misses 1 of 5 rows"), "{said}");
    }

    #[test]
    fn jitter_of_a_clock_is_no_lost_row() {
        let draw = |row: i64| (row * 7919 + row * row * 104_729).rem_euclid(1009);
        for (rate_hz, most_ms, one_in, lost) in [
            (500, 1, 25, 0),
            (200, 2, 1, 0),
            (100, 3, 1, 0),
            (250, 1, 1, 0),
            (200, 1, 1, 12),
            (50, 4, 1, 9),
        ] {
            let is_lost = |row: &i64| lost == 0 || draw(*row) % 997 >= lost;
            let rows = || (0..900).filter(is_lost);
            let late = |row: i64| match draw(row) % one_in {
                0 => draw(row + 1) % (2 * most_ms + 1) - most_ms,
                _ => 0,
            };
            let mut times: Vec<i64> = rows().map(|row| row * 1000 / rate_hz + late(row)).collect();
            times.sort_unstable();
            let values: Vec<f32> = rows().map(|row| row as f32).collect();
            let all = mended(&times, &values, Gaps::Error).unwrap();
            assert_eq!(all.parts[0][0].rate_hz, rate_hz as f64, "{most_ms} ms");
            let filled = all.parts[0][0].filled.iter().filter(|filled| **filled).count();
            // Up to two frames lie between the rows beside a lost one.
            let gone = 900 - times.len();
            let fits = filled + 2 >= gone && filled <= 2 * gone + 2;
            assert!(fits, "{rate_hz} Hz: {filled} filled of {gone} lost");
        }
    }

    #[test]
    fn coarse_times_of_even_samples_leave_the_samples_alone() {
        for rate_hz in [120, 400, 700, 870, 900, 952, 960, 1000] {
            for rows in [100, 2000] {
                let times: Vec<i64> = (0..rows).map(|row| row * 1000 / rate_hz).collect();
                let values: Vec<f32> = (0..rows).map(|row| (row % 7) as f32).collect();
                let all = mended(&times, &values, Gaps::Error).unwrap();
                assert_eq!(all.parts[0][0].values, values, "{rate_hz} Hz");
                // A few rows by a coarse clock tell the rate to 1 %.
                let right = rows == 100 || all.parts[0][0].rate_hz == rate_hz as f64;
                assert!(right, "{rate_hz} Hz: {}", all.parts[0][0].rate_hz);
            }
        }
    }

    #[test]
    fn even_rows_keep_their_samples_at_a_rate_that_is_not_whole() {
        for ms in [80, 400, 30, 16, 1250, 2000] {
            let times: Vec<i64> = (0..100).map(|row| row * ms).collect();
            let values: Vec<f32> = (0..100).map(|row| (row % 7) as f32).collect();
            let all = mended(&times, &values, Gaps::Error).unwrap();
            let found = (all.parts[0][0].rate_hz, &all.parts[0][0].values);
            assert_eq!(found, (1000.0 / ms as f64, &values));
        }
    }

    #[test]
    fn short_runs_are_filled_and_marked_and_longer_ones_cut() {
        let mut values = rising(200);
        values[50..55].fill(NAN);
        let all = mended(&[], &values, Gaps::Error).unwrap();
        assert_eq!(all.parts[0][0].values, rising(200));
        let marked = (0..200).filter(|row| all.parts[0][0].filled[*row]).collect::<Vec<_>>();
        assert_eq!(marked, [50, 51, 52, 53, 54]);
        values[55] = NAN;
        assert!(mended(&[], &values, Gaps::Error).unwrap_err().contains("after its row 50"));
        assert_eq!(lengths(&mended(&[], &values, Gaps::Cut).unwrap()), [50, 144]);
        let scattered: Vec<_> = (0..200).map(|row| if row % 10 == 5 { NAN } else { 1.0 }).collect();
        assert!(mended(&[], &scattered, Gaps::Cut).unwrap_err().contains("misses 20 of"));
    }

    #[test]
    fn a_gap_in_time_is_never_drawn_straight_and_needs_no_memory() {
        let mut times: Vec<i64> = (0..100).map(|row| row * 10).collect();
        times[60..].iter_mut().for_each(|time| *time += 4_000_000_000);
        let values = rising(100);
        let all = mended(&times, &values, Gaps::Cut).unwrap();
        assert_eq!(lengths(&all), [60, 40]);
        assert_eq!(all.parts[1][0].start, times[60] * 1_000_000);
        assert!(mended(&times, &values, Gaps::Error).unwrap_err().contains("after its row 60"));
        assert!(mended(&[0, 1, 2_000_000_000_000], &[1.0; 3], Gaps::Cut).is_err());
        // Six hundred years, more than an i64 holds in nanoseconds.
        let times: Vec<i64> = (0..40)
            .map(|row| row * 10 + if row < 20 { -9_000_000_000_000 } else { 9_000_000_000_000 })
            .collect();
        assert_eq!(lengths(&mended(&times, &values[..40], Gaps::Cut).unwrap()), [20, 20]);
    }

    #[test]
    fn the_last_of_a_repeated_time_counts_and_a_coarse_clock_is_refused() {
        let mut times: Vec<i64> = (0..20).map(|row| row * 10).collect();
        times.insert(3, 20);
        let mut values = rising(20);
        values.insert(2, 7.0);
        let all = mended(&times, &values, Gaps::Error).unwrap();
        assert_eq!((all.repeated, all.parts[0][0].values[2]), (1, 2.0));
        let coarse: Vec<i64> = (0..100).map(|row| row / 10 * 1000).collect();
        let values = rising(100);
        assert!(mended(&coarse, &values, Gaps::Cut).unwrap_err().contains("coarser"));
        let bursts: Vec<i64> = (0..100).map(|row| row / 10 * 1000 + row % 10).collect();
        assert!(mended(&bursts, &values, Gaps::Cut).unwrap_err().contains("bursts"));
    }
}
