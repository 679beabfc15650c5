//! Estimates when each frame of a stream was sampled, on one time base, from its arrival times.
//!
//! Buffers delay each arrival by a time that is never negative and often large. So the line of
//! sampling times lies *below* all points (index, arrival time). The clock takes an edge of the
//! lower convex hull of these points, the edge under the middle of their span, since this is the
//! closest line below all points (S. B. Moon, P. Skelly and D. Towsley, *Estimation and removal of
//! clock skew from network delay measurements*, INFOCOM 1999). Arrival times cannot show the
//! smallest delay, which remains as a constant offset of all frames.
//!
//! Times are in seconds on the daemon's time base. This module does no I/O, since the arrival times
//! are passed in.

use std::collections::VecDeque;

/// Length of a bin of arrivals. The clock keeps only the point with the least delay in each bin.
const BIN_S: f64 = 0.5;
/// Number of bins kept; together they cover one minute.
const BINS: usize = 120;
/// Shortest span from which drift is estimated, since 1 ms of noise in 10 s makes an error of 100 ppm.
const LEAST_SPAN_S: f64 = 10.0;
/// Largest plausible drift, twice the drift of a stylus without a crystal (1 %).
const WORST_DRIFT: f64 = 0.02;
/// The index has jumped if this many bins in a row are off the line by more than [`STEP_S`].
const STEP_BINS: usize = 3;
const STEP_S: f64 = 0.01;

/// Converts frame indexes of a stream to times of the time base, by a line fitted to arrivals.
#[derive(Clone, Debug)]
pub(crate) struct Clock {
    period_s: f64,
    /// Finished bins, oldest first, as points (nominal time, delay).
    bins: VecDeque<ClockPoint>,
    /// The time when the unfinished bin began, and the bin's point with the least delay so far.
    current: Option<(f64, ClockPoint)>,
    line: Option<Line>,
}

/// `x` is the nominal time of an index; `y` is its delay, the arrival time minus `x`. Both in seconds.
#[derive(Clone, Copy, Debug, PartialEq)]
struct ClockPoint {
    x: f64,
    y: f64,
}

/// The line of delays; the delay at `x` is `at.y + slope · (x − at.x)`.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Line {
    at: ClockPoint,
    slope: f64,
}

impl Line {
    fn y(&self, x: f64) -> f64 {
        self.at.y + self.slope * (x - self.at.x)
    }
}

impl Clock {
    /// A clock for a stream of this nominal rate in Hz; an invalid rate counts as 1 Hz.
    pub(crate) fn new(rate_hz: f64) -> Self {
        let rate_hz = if rate_hz.is_finite() && rate_hz > 0.0 { rate_hz } else { 1.0 };
        Self { period_s: 1.0 / rate_hz, bins: VecDeque::new(), current: None, line: None }
    }

    /// Notes that all frames before `index` had arrived at `arrival_s`. Ignores a time that is not
    /// finite, and an index below the last one.
    pub(crate) fn observe(&mut self, index: u64, arrival_s: f64) {
        let x = index as f64 * self.period_s;
        let point = ClockPoint { x, y: arrival_s - x };
        let newest = self.current.map(|(_, point)| point).or(self.bins.back().copied());
        if !point.y.is_finite() || newest.is_some_and(|newest| x < newest.x) {
            return;
        }
        match &mut self.current {
            Some((since, best)) if arrival_s - *since < BIN_S => {
                if point.y <= best.y {
                    *best = point;
                    if self.line.is_none_or(|line| point.y < line.y(x)) {
                        self.fit();
                    }
                }
            }
            current => {
                if let Some((_, best)) = current.replace((arrival_s, point)) {
                    self.bins.push_back(best);
                    if self.bins.len() > BINS {
                        self.bins.pop_front();
                    }
                    self.forget_before_step();
                }
                self.fit();
            }
        }
    }

    /// The time at which frame `index` was sampled, plus the stream's constant delay; `None` before
    /// the first arrival.
    pub(crate) fn time_s(&self, index: u64) -> Option<f64> {
        let x = index as f64 * self.period_s;
        self.line.map(|line| x + line.y(x))
    }

    /// Index of the first frame sampled at `time_s` or later (0 for times before the stream);
    /// `None` before the first arrival.
    pub(crate) fn index_at(&self, time_s: f64) -> Option<u64> {
        let Line { at, slope } = self.line?;
        // time = x + at.y + slope · (x − at.x)
        let x = (time_s - at.y + slope * at.x) / (1.0 + slope);
        // Subtracting 1e-6 absorbs rounding, so that the time of an index gives this index again.
        Some((x / self.period_s - 1e-6).ceil() as u64)
    }

    fn fit(&mut self) {
        let current = self.current.map(|(_, point)| point);
        let points: Vec<ClockPoint> = self.bins.iter().copied().chain(current).collect();
        let (Some(first), Some(last)) = (points.first(), points.last()) else { return };
        let span = last.x - first.x;
        let lowest = |slope: f64| {
            let over = |p: &&ClockPoint| p.y - slope * (p.x - first.x);
            let at = points.iter().min_by(|a, b| over(a).total_cmp(&over(b)));
            at.map(|at| Line { at: *at, slope })
        };
        self.line = if span < LEAST_SPAN_S {
            lowest(0.0)
        } else {
            match edge_under(&points, first.x + 0.5 * span) {
                Some(line) if line.slope.abs() <= WORST_DRIFT => Some(line),
                _ => lowest(0.0),
            }
        };
    }

    /// After a jump of the index, forgets the bins before it, since no line fits both old and new bins.
    fn forget_before_step(&mut self) {
        let Some(old) = self.bins.len().checked_sub(STEP_BINS).filter(|old| *old >= STEP_BINS)
        else {
            return;
        };
        let (Some(line), Some(first)) = (self.line, self.bins.front()) else { return };
        // Over a short span, the drift is unknown and would look like a jump, so all bins stay.
        if self.bins[old - 1].x - first.x < LEAST_SPAN_S {
            return;
        }
        let off = |point: &ClockPoint| point.y - line.y(point.x);
        let all = |far: fn(f64) -> bool| self.bins.range(old..).all(|point| far(off(point)));
        // If the new points are early, the line follows them, and the old points lie above the line.
        let late = all(|off| off > STEP_S);
        let early = self.bins.range(..old).all(|point| off(point) > STEP_S);
        if late || early {
            self.bins.drain(..old);
        }
    }
}

/// The edge of the lower convex hull of `points` (in order of x) that holds x = `middle`.
fn edge_under(points: &[ClockPoint], middle: f64) -> Option<Line> {
    let mut hull: Vec<ClockPoint> = Vec::with_capacity(points.len());
    for &p in points {
        if let Some(last) = hull.last_mut().filter(|last| last.x >= p.x) {
            last.y = last.y.min(p.y);
            continue;
        }
        while let [.., a, b] = hull[..] {
            // if b is below the line from a to p, b stays in the hull
            if (b.y - a.y) * (p.x - a.x) < (p.y - a.y) * (b.x - a.x) {
                break;
            }
            hull.pop();
        }
        hull.push(p);
    }
    let edge = hull.windows(2).find(|edge| edge[1].x >= middle)?;
    let (a, b) = (edge[0], edge[1]);
    Some(Line { at: a, slope: (b.y - a.y) / (b.x - a.x) })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn uniform(seed: &mut u64) -> f64 {
        *seed =
            seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (*seed >> 11) as f64 / (1u64 << 53) as f64
    }

    /// The clock after `seconds` of simulated arrivals in bursts, and its largest error over any span
    /// of 5 s after `from_s`. Each burst has an exponential delay of mean `jitter_s`; 5 % of the bursts
    /// have an additional Pareto delay (index 1.5, so that its variance is infinite).
    fn run(
        [rate_hz, drift, burst_s, jitter_s]: [f64; 4],
        (seconds, from_s): (f64, f64),
        seed: u64,
    ) -> (Clock, f64) {
        let true_time = |index: u64| 3.0 + index as f64 / rate_hz * (1.0 + drift);
        let (mut clock, seed) = (Clock::new(rate_hz), &mut (seed + 1));
        let (mut index, mut last, mut worst) = (0, 0.0_f64, 0.0_f64);
        while (index as f64) < seconds * rate_hz {
            index += (burst_s * rate_hz * (0.5 + uniform(seed))) as u64 + 1;
            let mut late = -jitter_s * (1.0 - uniform(seed)).ln();
            if uniform(seed) < 0.05 {
                late += 0.005 * (1.0 - uniform(seed)).powf(-1.0 / 1.5);
            }
            last = last.max(true_time(index) + late);
            clock.observe(index, last);
            if last - 3.0 > from_s {
                let start = last - 6.0;
                let span = |t: f64| clock.index_at(t).unwrap() as f64;
                let frames = span(start + 5.0) - span(start);
                let true_frames = 5.0 * rate_hz / (1.0 + drift);
                worst = worst.max((frames - true_frames).abs() / rate_hz);
            }
        }
        (clock, worst)
    }

    #[test]
    fn drift_costs_at_most_1_ms_over_5_s_in_jitter_of_any_kind() {
        let mut worst = 0.0_f64;
        for seed in 0..40 {
            for drift_ppm in [-100.0, -37.0, 0.0, 100.0] {
                for (rate_hz, burst_s, jitter_s) in
                    [(10_000.0, 0.003, 0.000_5), (10_000.0, 0.016, 0.004), (44_100.0, 0.01, 0.002)]
                {
                    let line = [rate_hz, drift_ppm * 1e-6, burst_s, jitter_s];
                    let (_, error_s) = run(line, (40.0, 6.0), seed);
                    worst = worst.max(error_s);
                }
            }
        }
        println!("worst error of a 5 s span: {:.3} ms", worst * 1e3);
        assert!(worst <= 1e-3, "{worst}");
    }

    #[test]
    fn the_drift_is_found() {
        let (clock, _) = run([10_000.0, 100e-6, 0.01, 0.002], (60.0, 100.0), 7);
        let drift = clock.line.unwrap().slope;
        assert!((drift - 100e-6).abs() < 10e-6, "{drift}");
    }

    #[test]
    fn a_stylus_without_its_crystal_is_followed() {
        let (_, error_s) = run([10_000.0, 0.01, 0.01, 0.001], (60.0, 16.0), 3);
        assert!(error_s <= 1e-3, "{error_s}");
    }

    #[test]
    fn an_index_and_its_time_belong_to_each_other() {
        let (clock, _) = run([44_100.0, -80e-6, 0.01, 0.001], (30.0, 100.0), 1);
        for index in [0, 1, 44_099, 1_000_000] {
            assert_eq!(clock.index_at(clock.time_s(index).unwrap()), Some(index));
        }
        assert_eq!(clock.index_at(-1e9), Some(0));
    }

    #[test]
    fn a_step_of_the_index_is_followed_in_both_directions() {
        for step_s in [0.2, -0.2] {
            let mut clock = Clock::new(1000.0);
            for i in 0..30_000u64 {
                let step = if i < 20_000 { 0.0 } else { step_s };
                clock.observe(i, 1.0 + i as f64 * 1e-3 + step);
            }
            let error = clock.time_s(29_999).unwrap() - (1.0 + 29.999 + step_s);
            assert!(
                error.abs() < 1e-6 && clock.line.unwrap().slope.abs() < 1e-6,
                "{step_s}: {error}"
            );
        }
    }

    #[test]
    fn what_cannot_be_is_passed_over() {
        let mut clock = Clock::new(f64::NAN);
        assert_eq!((clock.time_s(0), clock.index_at(0.0)), (None, None));
        clock.observe(5, f64::NAN);
        clock.observe(5, f64::INFINITY);
        assert_eq!(clock.time_s(0), None);
        clock.observe(5, 1.0);
        clock.observe(4, 2.0);
        assert_eq!(clock.time_s(5), Some(1.0));
        clock.observe(u64::MAX, 3.0);
        assert!(clock.time_s(5).is_some_and(f64::is_finite));
    }
}
