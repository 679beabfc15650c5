//! Tells lost rows from late ones, by the times of rows, without I/O and without a clock.
//!
//! The lateness of a row is its time minus the time at which its index is due. Buffers and jitter make
//! rows late for a moment; a loss makes all later rows late for good. So the least lateness of a few
//! rows shows what was lost, whatever delayed some of them.

/// The least lateness of the latest rows, in the unit of its caller.
#[derive(Debug)]
pub(super) struct Lateness {
    /// Times of rows, such as their indexes, after which the least lateness is measured anew.
    span: f64,
    since: f64,
    least: f64,
    before: f64,
}

impl Lateness {
    /// Looks back by one to two times `span`.
    pub(super) fn new(span: f64) -> Self {
        Self { span, since: f64::NEG_INFINITY, least: f64::INFINITY, before: f64::INFINITY }
    }

    pub(super) fn add(&mut self, at: f64, late: f64) {
        if at - self.since >= self.span {
            (self.since, self.before, self.least) = (at, self.least, f64::INFINITY);
        }
        self.least = self.least.min(late);
    }

    /// The least lateness; `None` before the first row.
    pub(super) fn least(&self) -> Option<f64> {
        Some(self.least.min(self.before)).filter(|least| least.is_finite())
    }
}

/// Number of steps from which the period of a clock column is measured.
const STEPS: usize = 256;
/// Share of the period by which a new measure makes the lateness so far meaningless.
const OFF: f64 = 0.03;
/// Rows that a clock column may be late by its jitter.
const JITTER: f64 = 0.95;
/// Number of rows over which the lateness of a clock column is compared.
const LOOKBACK: f64 = 16.0;

/// Counts the rows that are missing in a column of times, whose rate may be another than expected.
#[derive(Debug)]
pub(super) struct RowClock {
    pub period_us: f64,
    /// The measured rate in Hz; `None` until enough rows have come.
    pub measured_hz: Option<f64>,
    late: f64,
    rows: f64,
    lateness: Lateness,
    /// Microseconds before each row, and how many rows were counted as missing there.
    steps: Vec<(f64, f64)>,
}

impl RowClock {
    pub(super) fn new(rate_hz: f64) -> Self {
        Self {
            period_us: 1e6 / rate_hz,
            measured_hz: None,
            late: 0.0,
            rows: 0.0,
            lateness: Lateness::new(LOOKBACK),
            steps: Vec::new(),
        }
    }

    /// Number of rows missing before a row that comes `step_us` microseconds after the last one.
    pub(super) fn missing(&mut self, step_us: f64) -> u64 {
        self.rows += 1.0;
        let late = self.late + step_us / self.period_us - 1.0;
        let least = self.lateness.least().unwrap_or(0.0);
        let missing = (late - least + 1.0 - JITTER).floor().max(0.0);
        self.late = late - missing;
        self.lateness.add(self.rows, self.late);
        self.steps.push((step_us, missing));
        if self.steps.len() == STEPS {
            self.measure();
        }
        missing as u64
    }

    /// Begins again after a restart of the device's clock; keeps the period.
    pub(super) fn restart(&mut self) {
        (self.late, self.lateness) = (0.0, Lateness::new(LOOKBACK));
        self.steps.clear();
    }

    /// Measures the period. Either rows were lost where they were counted as missing, or none were and
    /// the period was wrong: of the two, that one holds by which rows come less unevenly.
    fn measure(&mut self) {
        let (all_us, missing) =
            self.steps.iter().fold((0.0, 0.0), |(us, n), s| (us + s.0, n + s.1));
        let rows = self.steps.len() as f64;
        let uneven = |period_us: f64, counts: f64| {
            let (mut late_us, mut least, mut most) = (0.0, 0.0f64, 0.0f64);
            for (step_us, missing) in &self.steps {
                late_us += step_us - period_us * (1.0 + counts * missing);
                (least, most) = (least.min(late_us), most.max(late_us));
            }
            most - least
        };
        let (even_us, lossy_us) = (all_us / rows, all_us / (rows + missing));
        let slack_us = 1e-3 * even_us;
        let is_even = uneven(even_us, 0.0) <= uneven(lossy_us, 1.0) + slack_us;
        let found_us = if is_even { even_us } else { lossy_us };
        if (found_us / self.period_us - 1.0).abs() > OFF {
            self.period_us = found_us;
            self.restart();
        } else {
            self.period_us += 0.5 * (found_us - self.period_us);
        }
        self.measured_hz = Some(1e6 / self.period_us);
        self.steps.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Rows of 1000 µs with jitter of up to `jitter` periods; the clock expects `told_hz`.
    fn run(jitter: f64, told_hz: f64, lost: impl Fn(u64) -> bool) -> (RowClock, u64) {
        let (mut clock, mut last_us, mut missing) = (RowClock::new(told_hz), 0.0, 0);
        let mut seed = 1_u64;
        for row in 1..4000_u64 {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            let late = (seed >> 11) as f64 / (1_u64 << 53) as f64 * jitter;
            if lost(row) {
                continue;
            }
            let us = (row as f64 + late) * 1000.0;
            let new = clock.missing(us - last_us);
            // Learns a wrong rate first.
            missing += if row > 1000 { new } else { 0 };
            last_us = us;
        }
        (clock, missing)
    }

    #[test]
    fn jitter_and_a_wrong_rate_are_no_loss() {
        for (jitter, told_hz) in
            [(0.0, 1000.0), (0.8, 1000.0), (0.5, 960.0), (0.3, 1100.0), (0.1, 2000.0), (0.2, 400.0)]
        {
            let (clock, missing) = run(jitter, told_hz, |_| false);
            assert_eq!(missing, 0, "jitter {jitter} at {told_hz} Hz");
            let off = clock.measured_hz.unwrap() / 1000.0 - 1.0;
            assert!(off.abs() < 0.02, "{off}: jitter {jitter} at {told_hz} Hz");
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        #[test]
        fn every_lost_row_is_missing_and_no_other(
            jitter in 0.0..0.8f64, every in 7u64..200, gap in 1u64..6,
        ) {
            let lost = |row: u64| row > 1000 && row < 3900 && row % every < gap;
            let (_, missing) = run(jitter, 1000.0, lost);
            let expected = (1..4000).filter(|row| lost(*row)).count() as u64;
            prop_assert_eq!(missing, expected);
        }
    }
}
