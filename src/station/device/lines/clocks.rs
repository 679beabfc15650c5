//! Finds out which columns only count or tell the time, from the steps between their numbers.

use super::intake::count::{CLOCK_WRAPS, wraps};

/// Fewest numbers that show what a column counts.
pub(super) const FEWEST: u64 = 20;
/// Most differences between successive numbers of a column that are kept.
const MOST_STEPS: usize = 4096;

pub(super) const ROWS: &str = "rows";
pub(super) const MICROS: &str = "microseconds";
const TIME: &str = "time";
/// Units of clocks, and their number in a second.
const UNITS: [(&str, f64); 4] =
    [("seconds", 1.0), ("milliseconds", 1e3), (MICROS, 1e6), ("nanoseconds", 1e9)];
/// Seconds since 1970 in the years 2001 to 2096.
const EPOCH_S: std::ops::Range<f64> = 1e9..4e9;

/// The steps (differences) from each number of a column to the next.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Steps {
    pub first: f64,
    pub last: f64,
    pub numbers: u64,
    /// Number of steps of exactly 1, of 0, and below 0.
    ones: u64,
    pub zeros: u64,
    pub down: u64,
    /// The least and the greatest number, and the shortest step down.
    ends: [f64; 2],
    fall: f64,
    /// Numbers of the first steps that are neither 1 nor down.
    others: Vec<u64>,
    /// Sum of the steps that go up.
    sum: f64,
    /// Whether some number is no integer.
    fractions: bool,
    /// The first steps that go up. Steps near their median are usual, even if rows are lost.
    up: Vec<f64>,
}

impl Steps {
    pub(super) fn add(&mut self, x: f64) {
        self.fractions |= x.fract() != 0.0;
        if self.numbers == 0 {
            (self.first, self.ends, self.fall) = (x, [x; 2], f64::INFINITY);
        } else {
            let step = x - self.last;
            self.ends = [self.ends[0].min(x), self.ends[1].max(x)];
            if step < 0.0 {
                self.fall = self.fall.min(-step);
            } else if step != 1.0 && self.others.len() < MOST_STEPS {
                self.others.push(self.numbers);
            }
            self.ones += u64::from(step == 1.0);
            self.zeros += u64::from(step == 0.0);
            self.down += u64::from(step < 0.0);
            self.sum += step.max(0.0);
            if step > 0.0 && self.up.len() < MOST_STEPS {
                self.up.push(step);
            }
        }
        self.last = x;
        self.numbers += 1;
    }

    /// Whether enough numbers came, all of them alike.
    pub(super) fn is_constant(&self) -> bool {
        self.numbers >= FEWEST && self.zeros + 1 == self.numbers
    }

    pub(super) fn usual(&self) -> f64 {
        let mut up = self.up.clone();
        up.sort_unstable_by(f64::total_cmp);
        let Some(median) = up.get(up.len() / 2).copied() else { return 0.0 };
        let near: Vec<f64> =
            up.into_iter().filter(|step| (step / median - 1.0).abs() < 0.25).collect();
        near.iter().sum::<f64>() / near.len() as f64
    }

    /// Whether the column only falls by most of its range, and rises else, like the part of a second.
    fn begins_anew(&self) -> bool {
        let steps = self.numbers.saturating_sub(1);
        let is_deep = self.fall >= 0.5 * (self.ends[1] - self.ends[0]);
        self.down > 1 && is_deep && !self.fractions && (self.down + self.zeros) * 4 <= steps
    }

    /// Whether the column is a clock of milliseconds or hundredths, at nearly the rate of the rows, rather than a
    /// counter: steps other than 1 come at even distances, unlike rows that are lost.
    fn beats(&self, seconds: f64) -> bool {
        const FEWEST: usize = 5;
        let is_near = |unit: &f64| (self.sum / seconds / unit - 1.0).abs() < 0.02;
        if ![100.0, 1000.0].iter().any(is_near) {
            return false;
        }
        let apart: Vec<f64> = self.others.windows(2).map(|two| (two[1] - two[0]) as f64).collect();
        let mean = apart.iter().sum::<f64>() / apart.len().max(1) as f64;
        let square = apart.iter().map(|x| (x - mean).powi(2)).sum::<f64>();
        apart.len() >= FEWEST && square / (apart.len() as f64) < (0.5 * mean).powi(2)
    }

    /// The unit in which the column counts, for rows at this rate; `None` if it does not count.
    pub(super) fn kind(&self, rate_hz: f64) -> Option<&'static str> {
        let steps = self.numbers.saturating_sub(1).max(1);
        // Allows a few negative steps, since a counter of 8 bits starts again every 256 rows.
        let often = self.down * 100 > steps;
        if self.numbers < FEWEST || often && !self.begins_anew() || self.up.is_empty() {
            return None;
        }
        let is_usual = |wrap: f64| [wrap, wrap - 1.0].contains(&self.ends[1]);
        let seconds = steps as f64 / rate_hz;
        let counts = (self.ones + self.down) * 10 >= steps * 9 && !self.beats(seconds);
        let are_micros = || (self.usual() * rate_hz / 1e6 - 1.0).abs() < 0.2;
        if self.begins_anew() && !(counts && (!often || wraps().any(is_usual))) {
            // No row can be counted by what begins anew at an unusual number.
            let is_full = (0.9..=1.0).contains(&(self.ends[1] / CLOCK_WRAPS[0]));
            return Some(if is_full && are_micros() { MICROS } else { TIME });
        }
        let rising = self.down == 0;
        let since_1970 = |(_, unit): &&(&str, f64)| {
            rising && [self.first, self.last].iter().all(|x| EPOCH_S.contains(&(x / unit)))
        };
        let passes = |(_, unit): &&(&str, f64)| (self.sum / seconds / unit - 1.0).abs() < 0.1;
        let whole_seconds = rising && !self.fractions && self.sum >= 2.0;
        match () {
            () if counts => Some(ROWS),
            () if are_micros() => Some(MICROS),
            () if UNITS.iter().any(|unit| since_1970(&unit) || passes(&unit)) => {
                let unit = UNITS.iter().find(since_1970).or_else(|| UNITS.iter().find(passes));
                unit.map(|(name, _)| *name)
            }
            () if whole_seconds && (self.sum - seconds).abs() < 1.5 => Some(UNITS[0].0),
            () if rising && (self.zeros == 0 || !self.fractions && self.up.len() >= 3) => {
                Some(TIME)
            }
            () => None,
        }
    }
}

/// A rate with this number of digits.
pub(super) fn rounded(rate_hz: f64, digits: i32) -> f64 {
    let unit = 10_f64.powi(digits - 1 - rate_hz.max(1e-3).log10().floor() as i32);
    (rate_hz * unit).round() / unit
}
