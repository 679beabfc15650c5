//! The rate of a trial's rows by their times, whatever the clock: exact, written coarsely, with jitter, or with
//! rows that are lost.

const S: f64 = 1e9;

/// The even grid that the times of a trial lie near.
pub(super) struct Grid {
    /// Nanoseconds from sample to sample, and from row to row of even ones.
    pub step: f64,
    pub even: f64,
    pub rate_hz: f64,
    /// How far apart the distances of rows from their places on the grid may lie, in ns.
    pub tolerance: f64,
}

impl Grid {
    pub(super) fn of(times: &[i64]) -> Result<Self, String> {
        let steps = || times.windows(2).map(|two| two[1].saturating_sub(two[0]));
        let mut sorted: Vec<i64> = steps().collect();
        sorted.sort_unstable();
        let Some(&median) = sorted.get(sorted.len() / 2) else {
            return Err("has a single row; expected a row for each sample".into());
        };
        // The unit in which the times are written, where it is coarse.
        let mut unit = 0;
        for step in steps() {
            unit = common_divisor(unit, step);
            if (unit as f64) < 0.02 * step as f64 {
                break;
            }
        }
        let (median, unit) = (median as f64, unit as f64);
        let longer = sorted.iter().filter(|step| **step as f64 > 1.5 * median).count();
        let is_coarse = unit >= 0.02 * median && sorted.first() != sorted.last();
        // One or two lost rows of an exact clock may lie as evenly.
        let may_be_even = is_coarse && (longer == 0 || longer > 2);
        let even = may_be_even.then(|| even_step(times, unit)).flatten();
        let refined = |step, _| places(times, step).1.unwrap_or(step);
        let step = even.unwrap_or_else(|| (0..2).fold(usual_step(times), refined));
        if !(100.0..5.0 * S).contains(&step) {
            return Err(format!(
                "has a row every {:e} s, which no recording has; is the unit of its times right? see \
                 --time-unit",
                step / S
            ));
        }
        // Times that are written coarsely lie beside the grid, though the samples do not.
        let most = if even.is_some() { 2.0 } else { 0.95 };
        let tolerance = (2.01 * unit).min(most * step).max(0.04 * step);
        let (exact, whole) = (S / step, (S / step).round().max(1.0));
        let are_exact = steps().all(|ns| {
            let steps = ns as f64 / step;
            (steps - steps.round()).abs() < 1e-3
        });
        // Coarse times tell the rate less well than they tell whether the rows are even.
        let is_rough = is_coarse && !are_exact;
        let rate_hz = if is_rough {
            let long = steps().fold(0, i64::saturating_add) as f64;
            roundest(exact, if even.is_some() { unit } else { step } / long).max(1.0)
        } else if (exact - whole).abs() > 1e-3 * exact && are_exact {
            // Such as 12.5 Hz.
            exact
        } else {
            whole
        };
        let even = if is_rough { step } else { S / rate_hz };
        Ok(Self { step, even, rate_hz, tolerance })
    }

    /// How many steps a time is long.
    pub(super) fn steps(&self, ns: i64) -> f64 {
        ns as f64 / self.step
    }
}

/// The step of times that lie on a straight line, but for the unit in which they are written; `None` if they
/// do not, such as where rows are lost.
fn even_step(times: &[i64], unit: f64) -> Option<f64> {
    let n = times.len() as f64;
    let at = |time: i64| time.saturating_sub(times[0]) as f64;
    let (mean_row, mean) = ((n - 1.0) / 2.0, times.iter().map(|time| at(*time)).sum::<f64>() / n);
    let product = |(row, time): (usize, &i64)| (row as f64 - mean_row) * (at(*time) - mean);
    let step = times.iter().enumerate().map(product).sum::<f64>() / (n * (n * n - 1.0) / 12.0);
    let off = |(row, time): (usize, &i64)| at(*time) - row as f64 * step;
    let (low, high) = (times.iter().enumerate().map(off))
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
    (high - low <= 1.1 * unit).then_some(step)
}

/// The usual step of times, from the time of several rows, which jitter moves little. Times that rows are
/// lost in are left out.
fn usual_step(times: &[i64]) -> f64 {
    let rows = (times.len() / 3).clamp(1, 8);
    let long = times.windows(rows + 1).map(|of| of[rows].saturating_sub(of[0]) as f64);
    let mut long: Vec<f64> = long.collect();
    long.sort_by(f64::total_cmp);
    let median = long[long.len() / 2];
    long.retain(|long| (long - median).abs() <= 0.5 * median / rows as f64);
    long.iter().sum::<f64>() / (long.len() * rows) as f64
}

/// The number of steps from each row to the next, and the mean step; none if each is a gap. The place of a row
/// is near its time, by a phase that follows the times slowly, so that jitter counts as no lost row.
pub(super) fn places(times: &[i64], step: f64) -> (Vec<usize>, Option<f64>) {
    const FOLLOWS: f64 = 0.1;
    /// A row that is late by a smaller share of a step is not the next but one.
    const LATE: f64 = 0.6;
    /// Longer ones say nothing of the step.
    const LONGEST: f64 = 6.5;
    // How far the last row lies behind the phase.
    let (mut late, mut long, mut count) = (0.0, 0.0, 0.0);
    let mut place = |two: &[i64]| {
        let ns = two[1].saturating_sub(two[0]) as f64;
        let steps = (ns / step + late + 1.0 - LATE).floor().max(1.0);
        late = match ns > LONGEST * step {
            true => 0.0,
            false => {
                (long, count) = (long + ns, count + steps);
                (1.0 - FOLLOWS) * (ns / step + late - steps)
            }
        };
        steps as usize
    };
    let places = times.windows(2).map(&mut place).collect();
    (places, (count > 0.0).then(|| long / count))
}

/// The roundest number within a share of `rate_hz`, as far as coarse times tell it; else the nearest one.
fn roundest(rate_hz: f64, share: f64) -> f64 {
    let round = [1000.0, 100.0, 50.0, 10.0, 5.0].map(|unit| (rate_hz / unit).round() * unit);
    let near = round.into_iter().find(|round| (round / rate_hz - 1.0).abs() <= share);
    near.unwrap_or_else(|| rate_hz.round())
}

fn common_divisor(mut a: i64, mut b: i64) -> i64 {
    while b != 0 {
        (a, b) = (b, a % b);
    }
    a
}
