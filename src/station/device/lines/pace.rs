//! Measures the rate at which rows come, without I/O and without a clock. Neither the rows that were
//! buffered before a connection or a silence, nor the frames that were missing there, count.

/// Seconds over which the rate is measured, and the least relative error that is said.
const PACE_S: f64 = 10.0;
const PACE: f64 = 0.01;
/// Seconds after which a larger relative error is already said, and that error. Blocks of rows count for less.
const GROSS_S: f64 = 3.0;
const GROSS: f64 = 0.2;
/// Fewest rows by which a rate that is counted within [`PACE_S`] must differ.
const PACE_ROWS: f64 = 3.0;
/// Seconds after a silence in which a backlog may still come.
const SETTLE_S: f64 = 1.0;
/// Least seconds, and least rows, of a silence that may leave a backlog.
const SILENCE_S: f64 = 0.25;
const SILENCE_ROWS: f64 = 4.0;

#[derive(Debug, Default)]
pub(super) struct Pace {
    /// The time from which the rate is measured, and the frames before it; `None` before the first row.
    from: Option<(f64, u64)>,
    /// The time of the last row, and the first time since which rows come steadily.
    last_s: f64,
    steady_s: f64,
    /// When the measurement was last begun or ended.
    looked_s: f64,
    /// The wrong rate that was said last; `None` if the rate is right.
    pub off_hz: Option<f64>,
}

impl Pace {
    /// Begins anew with the next row, after a connection or a long silence.
    pub(super) fn restart(&mut self, now_s: f64) {
        (self.from, self.last_s) = (None, f64::NEG_INFINITY);
        (self.steady_s, self.looked_s) = (now_s, now_s);
    }

    /// To be called whenever rows have come, with the frames so far, the expected rate, whether it is not
    /// known yet how many frames a silence lacked, and the rate by the device's own clock, if it sends one.
    /// Returns whether `off_hz` has changed.
    pub(super) fn rows(
        &mut self,
        now_s: f64,
        frames: u64,
        rate_hz: f64,
        unsettled: bool,
        clock_hz: Option<f64>,
    ) -> bool {
        if unsettled || now_s - self.last_s >= SILENCE_S.max(SILENCE_ROWS / rate_hz) {
            self.steady_s = now_s;
        }
        self.last_s = now_s;
        // Rows that always come in large blocks are never steady, and are measured all the same.
        let overdue = now_s - self.looked_s >= 2.0 * PACE_S;
        if now_s - self.steady_s < SETTLE_S && !overdue {
            return false;
        }
        let Some((from_s, before)) = self.from else {
            (self.from, self.looked_s) = (Some((now_s, frames)), now_s);
            return false;
        };
        let passed_s = now_s - from_s;
        let is_early = passed_s < PACE_S;
        if is_early && (passed_s < GROSS_S || self.off_hz.is_some()) {
            return false;
        }
        if !is_early {
            (self.from, self.looked_s) = (Some((now_s, frames)), now_s);
        }
        let counted_hz = frames.saturating_sub(before) as f64 / passed_s;
        let least_hz = if clock_hz.is_some() { 0.0 } else { PACE_ROWS / passed_s };
        let seen_hz = clock_hz.unwrap_or(counted_hz);
        let least = if is_early { GROSS } else { PACE };
        let differ = |a: f64, b: f64| (a - b).abs() > (least * rate_hz).max(least_hz);
        let off_hz = Some(seen_hz).filter(|seen_hz| differ(*seen_hz, rate_hz));
        let changed = match (self.off_hz, off_hz) {
            (Some(before), Some(now)) => differ(before, now),
            (before, now) => before.is_some() != now.is_some(),
        };
        if changed {
            self.off_hz = off_hz;
        }
        changed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Takes rows of 400 Hz expected, from `from_s` on, in blocks of 10 ms; returns what was said.
    fn told(
        pace: &mut Pace,
        frames: &mut f64,
        (from_s, seconds): (f64, f64),
        hz: f64,
    ) -> Vec<Option<f64>> {
        let mut told = Vec::new();
        for block in 1..=(seconds * 100.0) as u32 {
            *frames += hz / 100.0;
            let now_s = from_s + f64::from(block) / 100.0;
            if pace.rows(now_s, *frames as u64, 400.0, false, None) {
                told.push(pace.off_hz.map(f64::round));
            }
        }
        told
    }

    #[test]
    fn a_gap_and_the_backlog_after_it_make_no_rate_and_a_wrong_rate_is_told_at_each_change() {
        let (mut pace, mut frames) = (Pace::default(), 0.0);
        pace.restart(0.0);
        // A board that boots for 2 s and then sends what it has buffered.
        frames += 800.0;
        assert_eq!(told(&mut pace, &mut frames, (2.0, 15.0), 400.0), []);
        // The connection is lost for 0.9 s; its frames are counted as missing with its first row.
        pace.restart(17.9);
        frames += 360.0;
        assert_eq!(told(&mut pace, &mut frames, (17.9, 15.0), 400.0), []);
        // A silence of 4 s without a lost connection, then all of its rows at once.
        frames += 1600.0;
        assert_eq!(told(&mut pace, &mut frames, (36.9, 30.0), 400.0), []);
        let wrong = told(&mut pace, &mut frames, (66.9, 40.0), 448.0);
        assert_eq!((wrong.len(), wrong.last()), (2, Some(&Some(448.0))), "{wrong:?}");
        let wrong = told(&mut pace, &mut frames, (106.9, 40.0), 800.0);
        assert_eq!(wrong.last(), Some(&Some(800.0)), "{wrong:?}");
        assert_eq!(told(&mut pace, &mut frames, (146.9, 40.0), 400.0).last(), Some(&None));
        let (mut pace, mut frames) = (Pace::default(), 0.0);
        pace.restart(0.0);
        assert_eq!(told(&mut pace, &mut frames, (0.0, 4.1), 800.0), [Some(800.0)], "at once");
    }
}
