//! Notices that two columns have changed places, by their means and spreads.

/// Seconds over which means are taken.
const WINDOW_S: f64 = 2.0;
/// Fewest rows of a window.
const FEWEST: u32 = 20;
/// Least distance of two columns' means, in units of their spreads, by which they differ.
const APART: f64 = 6.0;
/// Most of this distance by which a column may differ from what the other was.
const NEAR: f64 = 0.2;

#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Moments {
    mean: f64,
    /// Sum of squared differences from the mean (Welford 1962); later, the standard deviation.
    spread: f64,
}

/// The means of the columns in successive windows.
#[derive(Debug, Default)]
pub(super) struct Swaps {
    now: Vec<Moments>,
    rows: u32,
    since_s: f64,
    /// The columns in the first window; empty before its end.
    before: Vec<Moments>,
    /// Two columns that have changed places, counted from 0, not taken yet.
    pub found: Option<(usize, usize)>,
}

impl Swaps {
    /// Takes a row that arrived at `now_s`.
    pub(super) fn add(&mut self, row: impl Iterator<Item = f64>, now_s: f64) {
        if self.rows == 0 {
            self.since_s = now_s;
            self.now.clear();
        }
        self.rows += 1;
        let rows = f64::from(self.rows);
        for (column, x) in row.enumerate() {
            if column == self.now.len() {
                self.now.push(Moments::default());
            }
            let Moments { mean, spread } = &mut self.now[column];
            let off = x - *mean;
            *mean += off / rows;
            *spread += off * (x - *mean);
        }
        if now_s - self.since_s >= WINDOW_S && self.rows >= FEWEST {
            self.end_window();
        }
    }

    fn end_window(&mut self) {
        let rows = f64::from(std::mem::take(&mut self.rows));
        self.now.iter_mut().for_each(|column| column.spread = (column.spread / rows).sqrt());
        if self.before.len() != self.now.len() {
            self.before.clone_from(&self.now);
            return;
        }
        let (before, now) = (&self.before, &self.now);
        let pairs = (0..now.len()).flat_map(|one| (one + 1..now.len()).map(move |two| (one, two)));
        let swapped = |&(one, two): &(usize, usize)| {
            let apart = (before[one].mean - before[two].mean).abs();
            let near =
                |at: usize, was: usize| (now[at].mean - before[was].mean).abs() <= NEAR * apart;
            apart > APART * (before[one].spread + before[two].spread)
                && near(one, two)
                && near(two, one)
        };
        if let Some(pair) = pairs.into_iter().find(swapped) {
            self.found = Some(pair);
            // Said once; the columns stay in their new places.
            self.before.clone_from(&self.now);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Feeds ten seconds of rows at 100 Hz; `row` gives the one at a time in seconds.
    fn found(row: impl Fn(f64) -> [f64; 3]) -> Option<(usize, usize)> {
        let mut swaps = Swaps::default();
        (0..1000).map(|i| f64::from(i) * 0.01).for_each(|t| swaps.add(row(t).into_iter(), t));
        swaps.found
    }

    #[test]
    fn columns_that_change_places_are_found_and_drags_are_not() {
        let noise = |t: f64| 0.1 * (t * 9e3).sin();
        let swap = |t: f64| match t < 5.0 {
            true => [noise(t), 9.81 + noise(t), 0.02],
            false => [9.81 + noise(t), noise(t), 0.02],
        };
        assert_eq!(found(swap), Some((0, 1)));
        assert_eq!(found(|t| [noise(t), 9.81 + noise(t) * t, 0.02 * t]), None);
        // Columns that are alike cannot be told apart.
        assert_eq!(found(|t| [noise(t), noise(t), noise(t)]), None);
    }
}
