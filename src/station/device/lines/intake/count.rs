//! Tells by a column of row numbers or microseconds how many frames are missing before a row.

use super::{LinesIntake, MOST_HELD_S};
use crate::device::lines::lateness::RowClock;
use crate::device::lines::layout::Count;
use crate::device::serial::gap;

/// Values at which clocks of 16, 30 (MicroPython) and 32 bits start again from 0.
pub(in crate::device::lines) const CLOCK_WRAPS: [f64; 3] =
    [65_536.0, 1_073_741_824.0, 4_294_967_296.0];
/// Numbers of values, other than powers of two, after which counters begin again.
const DECIMAL_WRAPS: [f64; 5] = [100.0, 1000.0, 10_000.0, 99_999.0, 100_000.0];
/// Highest power of two at which a counter may begin again; an f64 holds all numbers up to it.
const MOST_BITS: i32 = 53;
/// Most seconds that a row may come too late, but at least a number of rows.
const OUT_OF_ORDER_S: f64 = 0.05;
const OUT_OF_ORDER_ROWS: f64 = 8.0;

/// The numbers of values after which a counter may begin again, in no order.
pub(in crate::device::lines) fn wraps() -> impl Iterator<Item = f64> {
    let binary = (1..=MOST_BITS).map(|bits| f64::from(bits).exp2());
    DECIMAL_WRAPS.into_iter().chain(binary)
}

impl LinesIntake {
    /// Whether a row came twice or after later ones, by its number. After a silence, or if too many rows
    /// follow each other so, the counter has begun again instead.
    pub(super) fn is_out_of_order(&self, value: f64, now_s: f64) -> bool {
        let most = OUT_OF_ORDER_ROWS.max(OUT_OF_ORDER_S * self.rate_hz);
        let goes_on = self.rows > 0 && !self.is_after_silence(now_s);
        if matches!(self.count, Some(Count::Micros(_)))
            || !goes_on
            || f64::from(self.out_of_order) >= most
        {
            return false;
        }
        let back = self.last - value;
        match self.wrap {
            // Of a short counter, a few back may as well be many ahead.
            Some(wrap) if wrap < 4.0 * most => back == 0.0,
            Some(wrap) => back.rem_euclid(wrap) <= most,
            None => (0.0..=most).contains(&back) && !self.begins_again(value),
        }
    }

    /// Whether a row follows the last one directly, in a counter that begins again.
    fn begins_again(&self, value: f64) -> bool {
        wraps().any(|wrap| self.last <= wrap && value + wrap - self.last == 1.0)
    }

    /// Number of frames that are known to be missing before a row, and whether the row's counter
    /// restarted. After a silence, the number may be unknown; it is then a number plus any multiple of
    /// a unit.
    pub(super) fn missing_before(
        &mut self,
        counted: Option<f64>,
        now_s: f64,
    ) -> (u64, bool, Option<(u64, f64)>) {
        let Some(value) = counted else { return (0, false, Some((0, 1.0))) };
        let before = std::mem::replace(&mut self.last, value);
        if self.rows == 0 {
            return (0, false, None);
        }
        let silent_s = now_s - self.last_s;
        let by_time = matches!(self.count, Some(Count::Micros(_)));
        // The row before has index 0, so a row that follows it directly has index 1.
        let index = match by_time {
            true => self.index_by_clock(value, before, silent_s),
            false => self.index_by_counter(value, before, silent_s),
        };
        let is_silent = self.is_after_silence(now_s);
        let wrap = self.wrap.filter(|wrap| !by_time && *wrap < MOST_HELD_S * self.rate_hz);
        if let (Some(wrap), true, 1..) = (wrap, is_silent, index) {
            return (0, false, Some((index - 1, wrap)));
        }
        let (missing, restarted) = gap(Some(1), index, 1, silent_s, self.rate_hz, self.reopened);
        if restarted {
            self.wrap = None;
            self.clock.iter_mut().for_each(RowClock::restart);
        }
        (missing, restarted, None)
    }

    /// Index of a row after the one `before`, by a counter that may have begun again; 0 if it restarted.
    fn index_by_counter(&mut self, value: f64, before: f64, silent_s: f64) -> u64 {
        if value > before {
            return (value - before).round() as u64;
        }
        let most = (silent_s + 1.0) * self.rate_hz + 1.0;
        let known = self.wrap.into_iter();
        let mut wraps: Vec<f64> = wraps().collect();
        wraps.sort_unstable_by(f64::total_cmp);
        // A counter that begins with 1 ends with the number of its values.
        let fits = |wrap: &f64| (1.0..=most).contains(&(value + wrap - before).round());
        let Some(wrap) = known.chain(wraps).filter(|wrap| before <= *wrap).find(fits) else {
            return 0;
        };
        let index = (value + wrap - before).round() as u64;
        if index == 1 {
            self.wrap = Some(wrap);
        }
        index
    }

    /// Index of a row after the one `before`, by a column of microseconds; 0 if its clock restarted.
    fn index_by_clock(&mut self, value: f64, before: f64, silent_s: f64) -> u64 {
        let most_us = 1e6 * (silent_s + 1.0);
        // A clock may stand still for a row that comes at the same moment.
        let wraps = CLOCK_WRAPS.into_iter().filter(|wrap| before < *wrap);
        let step_us = match value >= before {
            true => Some(value - before),
            false => wraps.map(|wrap| value + wrap - before).find(|step| *step <= most_us),
        };
        let clock = self.clock.get_or_insert_with(|| RowClock::new(self.rate_hz));
        step_us.map_or(0, |step_us| 1 + clock.missing(step_us))
    }
}
