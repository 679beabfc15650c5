//! Rows of a table in which sensors of several rates were merged: a source gets the rate of the rows in which
//! it has values. Rows that came late are sorted first.

use std::ops::Range;

use super::gather::Rows;
use super::mend::{Gaps, LONGEST_STEP, MOST_FILLED, Mended, Piece, S, SHARE_FILLED, mend};
use crate::scene::SourceId;

/// A sensor that ends before this share of the rows has passed may rather be slower than the others.
const FEWEST_TOGETHER: f64 = 0.8;

/// Sorts rows by their times. Returns how many came after a row of a later time.
pub(super) fn in_order(rows: &mut Rows) -> usize {
    let mut latest = i64::MIN;
    let overtaken = rows.times.iter().filter(|time| {
        latest = latest.max(**time);
        **time < latest
    });
    let overtaken = overtaken.count();
    if overtaken > 0 {
        let width = rows.values.len() / rows.times.len();
        let mut order: Vec<usize> = (0..rows.times.len()).collect();
        order.sort_by_key(|row| rows.times[*row]);
        let values = order.iter().flat_map(|row| &rows.values[row * width..][..width]);
        rows.values = values.copied().collect();
        rows.times.sort_unstable();
    }
    overtaken
}

/// Makes the parts of one trial, of sources with these columns. The error continues a sentence that begins
/// with the trial.
pub(super) fn mend_sources(
    rows: Rows,
    sources: &[(SourceId, Vec<String>)],
    rate_hz: Option<f64>,
    gaps: Gaps,
) -> Result<Mended, String> {
    let names: Vec<String> = sources.iter().flat_map(|(_, columns)| columns.clone()).collect();
    let count = rows.values.len() / names.len().max(1);
    let time = |row: usize| match rate_hz {
        None => rows.times[row],
        Some(rate_hz) => (row as f64 * S / rate_hz).round() as i64,
    };
    let mut from = 0;
    let ranges = sources.iter().map(|(_, columns)| {
        from += columns.len();
        from - columns.len()..from
    });
    let ranges: Vec<_> = ranges.collect();
    let values = |row: usize, of: &Range<usize>| &rows.values[row * names.len()..][of.clone()];
    // The rows in which a source has a value.
    let own = |of: &Range<usize>| {
        let of = of.clone();
        (0..count).filter(move |row| values(*row, &of).iter().any(|value| !value.is_nan()))
    };
    // Without times, longer runs of rows without any value stand for gaps.
    let (mut filled, mut last) = (count as f64, 0);
    for row in own(&(0..names.len())).filter(|_| rate_hz.is_some()) {
        filled -= if row > last + MOST_FILLED { (row - last - 1) as f64 } else { 0.0 };
        last = row;
    }
    let is_apart = |of: &Range<usize>| {
        let are_few = (own(of).count() as f64) < (1.0 - SHARE_FILLED) * filled;
        are_few && are_regular(&own(of).map(time).collect::<Vec<_>>())
    };
    for (of, (source, columns)) in ranges.iter().zip(sources) {
        let last = own(of).next_back().unwrap_or(0) as f64;
        let is_dense = own(of).count() as f64 >= (1.0 - SHARE_FILLED) * last;
        if is_dense && last > 0.0 && last < FEWEST_TOGETHER * (count - 1) as f64 {
            return Err(format!(
                "has values of `{}` (source `{source}`) in its first {} of {count} rows alone: if that sensor is \
                 slower, and its samples stand closer than they came, put it into a table of its own; if it ended \
                 early, cut the table there; or name the columns to use by --source",
                columns[0],
                last + 1.0
            ));
        }
    }
    if !ranges.iter().any(is_apart) {
        return mend(rows, &names, rate_hz, gaps);
    }
    let mut all = Mended::default();
    for (of, (source, columns)) in ranges.iter().zip(sources) {
        let own_values = own(of).flat_map(|row| values(row, of)).copied();
        let own = Rows { times: own(of).map(time).collect(), values: own_values.collect() };
        let mended = mend(own, columns, None, gaps);
        let mended = mended.map_err(|problem| format!("{problem} (source `{source}`)"))?;
        all.parts = match of.start {
            0 => mended.parts,
            _ => overlaps(&all.parts, &mended.parts),
        };
        all.repeated += mended.repeated;
        all.too_short += mended.too_short;
        all.resampled_hz = all.resampled_hz.or(mended.resampled_hz);
    }
    match all.parts.is_empty() {
        true => Err("has no time at which all sources have rows".into()),
        false => Ok(all),
    }
}

/// Whether times come in steps of one length, so that few are lost; gaps that are cut do not count.
fn are_regular(times: &[i64]) -> bool {
    let steps = times.windows(2).map(|two| two[1].saturating_sub(two[0]) as f64);
    let mut steps: Vec<f64> = steps.collect();
    steps.sort_by(f64::total_cmp);
    let Some(usual) = steps.get(steps.len() / 2) else { return false };
    let lost = (1.5 * usual)..(LONGEST_STEP * usual);
    let lost = steps.iter().filter(|step| lost.contains(*step)).count();
    lost as f64 <= SHARE_FILLED * steps.len() as f64
}

/// The parts of a trial in which both these sources, and another one, have frames.
fn overlaps(parts: &[Vec<Piece>], others: &[Vec<Piece>]) -> Vec<Vec<Piece>> {
    let mut all = Vec::new();
    for part in parts {
        for other in others {
            let both = || part.iter().chain(other);
            // A slow source has its first frame up to a step late.
            let step = |piece: &Piece| (S / piece.rate_hz) as i64;
            let from =
                both().map(|piece| piece.start.saturating_sub(step(piece))).max().unwrap_or(0);
            let to = both().map(|piece| piece.end().saturating_add(step(piece))).min().unwrap_or(0);
            all.extend(both().map(|piece| piece.within(from, to)).collect::<Option<Vec<_>>>());
        }
    }
    all
}

impl Piece {
    fn frames(&self) -> usize {
        self.values.len() / self.width
    }

    /// Time of the last frame in ns.
    fn end(&self) -> i64 {
        self.start.saturating_add(((self.frames() - 1) as f64 * S / self.rate_hz) as i64)
    }

    /// The frames in a range of times; `None` if there are fewer than two.
    fn within(&self, from: i64, to: i64) -> Option<Self> {
        let place = |time: i64| time.saturating_sub(self.start) as f64 * self.rate_hz / S;
        // Times are rounded to nanoseconds.
        let first = (place(from) - 1e-3).ceil().max(0.0) as usize;
        let end = ((place(to) + 1e-3).floor() + 1.0).clamp(0.0, self.frames() as f64) as usize;
        let values = first * self.width..end * self.width;
        (first + 2 <= end).then(|| Self {
            start: self.start.saturating_add((first as f64 * S / self.rate_hz) as i64),
            values: self.values[values.clone()].to_vec(),
            filled: self.filled.get(values).unwrap_or_default().to_vec(),
            ..*self
        })
    }
}
