//! A control chart for one number that a station measures again and again on the same part.
//!
//! The chart is an exponentially weighted moving average (EWMA; S. W. Roberts, Technometrics 1, 1959):
//! `z ← λ·x + (1 − λ)·z`, which begins at the centre. It has drifted once `z` is farther from the centre
//! than `L · s · √(λ / (2 − λ))` (J. M. Lucas and M. S. Saccucci, Technometrics 32, 1990). Centre and
//! spread `s` are the mean and the standard deviation of the first [`BASELINE`] values.
//!
//! These are estimates, and limits that ignore this give far too many false alarms (L. A. Jones, C. W.
//! Champ and S. E. Rigdon, Technometrics 43, 2001). So `L` is chosen such that all charts of a station
//! together give at most one false alarm in [`WITHIN`] values on average, where the average is also over
//! the estimates. It is an average over stations: one whose first values happened to be close together
//! has more false alarms than another. Values are assumed to be independent and normal.

/// Number of first values from which centre and spread are estimated. There is no chart before.
pub const BASELINE: usize = 25;
/// Number of values in which at most one false alarm comes, over all charts of a station.
pub const WITHIN: usize = 370;
/// Number of values within which nine of ten changes of size [`Chart::finds`] are found.
pub const SOON: usize = 15;
/// The weight of the newest value. Among 0.1, 0.15 and 0.2, it finds the smallest change within
/// [`SOON`] values.
const LAMBDA: f64 = 0.15;

/// For 1, 2, 4 … charts: the limit `L`, and the change in spreads that is found within [`SOON`] values
/// with probability 0.9. The tests verify both by simulation.
const DESIGN: [(f64, f64); 8] = [
    (3.552, 1.406),
    (3.943, 1.548),
    (4.321, 1.686),
    (4.689, 1.819),
    (5.049, 1.950),
    (5.405, 2.079),
    (5.758, 2.207),
    (6.109, 2.334),
];

/// The direction in which a value gets worse.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Worse {
    Lower,
    Higher,
    Both,
}

/// The chart of a series, all in the unit of its values.
#[derive(Clone, Debug, PartialEq)]
pub struct Chart {
    pub centre: f64,
    pub spread: f64,
    /// The largest distance of the average from the centre that is no drift.
    pub limit: f64,
    /// The smallest sudden change that is found within [`SOON`] values in nine of ten cases.
    pub finds: f64,
    /// The moving average after each value from the one after the first [`BASELINE`] values on.
    pub averages: Vec<f64>,
    /// Whether the average has left its limits, and has not come back within half of them since.
    pub has_drifted: bool,
}

impl Chart {
    /// Charts `values`, the oldest first; `None` for [`BASELINE`] values or fewer.
    ///
    /// `charts` is the number of charts of the station. `resolution` is the least spread, for values that
    /// were all alike.
    pub fn of(values: &[f64], charts: usize, resolution: f64, worse: Worse) -> Option<Self> {
        let (first, later) =
            values.split_at_checked(BASELINE).filter(|(_, later)| !later.is_empty())?;
        let centre = first.iter().sum::<f64>() / BASELINE as f64;
        let squares: f64 = first.iter().map(|value| (value - centre).powi(2)).sum();
        let spread = (squares / (BASELINE - 1) as f64).sqrt().max(resolution);
        let (factor, finds) = design(charts);
        // The standard deviation of the average, after many values of standard deviation 1.
        let unit = (LAMBDA / (2.0 - LAMBDA)).sqrt();
        let limit = factor * spread * unit;
        let (mut averages, mut has_drifted) = (Vec::new(), false);
        let mut average = centre;
        for value in later {
            average += LAMBDA * (value - average);
            averages.push(average);
            let distance = match worse {
                Worse::Lower => centre - average,
                Worse::Higher => average - centre,
                Worse::Both => (average - centre).abs(),
            };
            // An average that stays close to its limit would otherwise give alarm after alarm.
            has_drifted = distance > if has_drifted { limit / 2.0 } else { limit };
        }
        Some(Self { centre, spread, limit, finds: finds * spread, averages, has_drifted })
    }
}

/// The limit and the found change for a number of charts, interpolated on its logarithm.
fn design(charts: usize) -> (f64, f64) {
    let doublings = (charts.max(1) as f64).log2();
    // Beyond the table, the last two rows are continued; both columns are nearly straight there.
    let at = (doublings as usize).min(DESIGN.len() - 2);
    let (low, high, share) = (DESIGN[at], DESIGN[at + 1], doublings - at as f64);
    (low.0 + share * (high.0 - low.0), low.1 + share * (high.1 - low.1))
}

#[cfg(test)]
mod tests {
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::seed;

    fn normals(count: usize, rng: &mut ChaCha8Rng) -> Vec<f64> {
        (0..count).map(|_| seed::normal(rng)).collect()
    }

    /// How many times a chart begins to have drifted, value by value, and by which value first.
    fn alarms(values: &[f64], charts: usize) -> (usize, Option<usize>) {
        let chart = Chart::of(values, charts, 0.0, Worse::Both).unwrap();
        let (mut count, mut is_out, mut first) = (0, false, None);
        for (at, average) in chart.averages.iter().enumerate() {
            let now = (average - chart.centre).abs()
                > if is_out { chart.limit / 2.0 } else { chart.limit };
            if now && !is_out {
                count += 1;
                first = first.or(Some(at + 1));
            }
            is_out = now;
        }
        assert_eq!(is_out, chart.has_drifted);
        (count, first)
    }

    #[test]
    fn all_charts_of_a_station_give_at_most_one_false_alarm_in_370_values_on_average() {
        let mut rng = seed::rng(7, &[]);
        for (charts, stations) in [(1, 8000), (16, 500), (64, 125)] {
            let of_chart = |_| alarms(&normals(BASELINE + WITHIN, &mut rng), charts).0;
            let count: usize = (0..stations * charts).map(of_chart).sum();
            let mean = count as f64 / stations as f64;
            assert!((0.2..1.2).contains(&mean), "{charts} charts: {mean}");
        }
    }

    /// The share of stations that find `change` within [`SOON`] values after it began. The change grows
    /// over `ramp` values, and is whole before these [`SOON`] values begin.
    fn found(change: f64, spread: f64, charts: usize, ramp: usize, rng: &mut ChaCha8Rng) -> f64 {
        let stations = 2000;
        let finds = |_: &usize| {
            let mut series = normals(BASELINE + ramp + SOON, rng);
            for (at, value) in series.iter_mut().enumerate() {
                let share = (at + 1).saturating_sub(BASELINE) as f64 / ramp.max(1) as f64;
                *value = *value * spread + change * share.min(1.0) * f64::from(at >= BASELINE);
            }
            alarms(&series, charts).1.is_some()
        };
        (0..stations).filter(finds).count() as f64 / stations as f64
    }

    #[test]
    fn a_gain_that_falls_by_a_tenth_is_found_within_15_values_where_levels_spread_little_enough() {
        let mut rng = seed::rng(11, &[]);
        let tenth_db = 20.0 * 0.9_f64.log10().abs();
        // The spread of the level between scans, in dB, up to which this holds.
        for (charts, spread_db) in [(1, 0.58), (16, 0.42), (64, 0.37)] {
            for ramp in [0, 30] {
                let share = found(-tenth_db, spread_db, charts, ramp, &mut rng);
                assert!(share > 0.88, "{charts} charts, over {ramp} values: {share}");
            }
            let (_, finds) = design(charts);
            assert!(finds * spread_db < tenth_db, "{charts} charts");
            let share = found(-tenth_db, 3.0 * spread_db, charts, 0, &mut rng);
            assert!(share < 0.3, "three times the spread, {charts} charts: {share}");
        }
    }

    #[test]
    fn there_is_no_chart_before_enough_values() {
        let chart = |count: usize| Chart::of(&vec![1.0; count], 1, 0.01, Worse::Both);
        assert_eq!(chart(0), None);
        assert_eq!(chart(BASELINE), None);
        let chart = chart(BASELINE + 2).unwrap();
        assert_eq!((chart.centre, chart.spread, chart.averages.len()), (1.0, 0.01, 2));
        assert!(!chart.has_drifted, "values that are all alike");
    }

    #[test]
    fn a_drift_counts_only_where_values_get_worse_and_ends_once_they_are_back() {
        let mut series = normals(BASELINE, &mut seed::rng(3, &[]));
        series.extend([5.0; 10]);
        let drifted = |series: &[f64], worse| Chart::of(series, 1, 0.0, worse).unwrap().has_drifted;
        let all = [Worse::Lower, Worse::Higher, Worse::Both];
        assert_eq!(all.map(|worse| drifted(&series, worse)), [false, true, true]);
        series.extend([0.0; 30]);
        assert!(!drifted(&series, Worse::Both));
    }

    #[test]
    fn more_charts_have_wider_limits_beyond_the_table_too() {
        let factors = [1, 3, 16, 128, 129, 1000].map(|charts| design(charts).0);
        assert!(factors.is_sorted_by(|a, b| a < b), "{factors:?}");
        assert_eq!(design(16), DESIGN[4]);
        assert_eq!(design(128), DESIGN[7]);
    }
}
