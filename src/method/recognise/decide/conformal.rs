//! Tests whether the surface of a query is in the library at all (conformal prediction).
//!
//! The nonconformity of a trial is its distance to the nearest surface in discriminant space. Library
//! trials are left out one group at a time, and a model trained without the group measures the trials
//! of the group. A query is measured by each of these models, and compared with the trials that the
//! model left out. The p-value (`fit` in JSON) is the share of trials that are at least as strange as
//! the query; the query is counted among them (cross-conformal prediction, Vovk 2015, "Cross-conformal
//! predictors", Annals of Mathematics and Artificial Intelligence 74). For surfaces of the library,
//! and people like the library's, about a share α of the scans has a p-value of α or less. A finished
//! scan is compared with whole trials, and a shorter scan with beginnings of trials that are no longer
//! than the scan. Trials of one person differ less from each other than from another person's. In a
//! library of one person, excerpts of 40 % therefore stand for whole trials, and three excerpts count
//! as one trial.
//!
//! Only `embedding` gives a p-value, because it can leave out library trials cheaply. `reference`
//! would have to compare all trials of the library with each other each time the library is read.
//!
//! `src/method/evaluate/README.md` shows which unknown surfaces are detected in real sounds. Fewer scans are
//! rejected there than α states, since whole scans are compared with excerpts of the same person. Many
//! of its unknown surfaces have a near twin in the library: another version of the same tile or foam.

use super::LeftOutBy;
use super::interval::beta_quantile;

/// A scan is compared with whole trials if it has at least this share of their median length.
const WHOLE: f64 = 0.95;

/// Nonconformity of left-out library trials of one length.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub(crate) struct Calibration {
    pub scan_s: f64,
    /// Most scans that are cut from one trial; together they count as one trial.
    pub of_each: usize,
    /// Nonconformity of each group's scans, ascending.
    by_group: Vec<Vec<f64>>,
}

impl Calibration {
    /// `scans` gives the group of each scan, and its nonconformity by the model without that group.
    pub(crate) fn new(
        scan_s: f64,
        of_each: usize,
        scans: impl Iterator<Item = (usize, f64)>,
    ) -> Self {
        let mut by_group: Vec<Vec<f64>> = Vec::new();
        for (group, value) in scans {
            by_group.resize(by_group.len().max(group + 1), Vec::new());
            by_group[group].push(value);
        }
        by_group.iter_mut().for_each(|values| values.sort_by(f64::total_cmp));
        Self { scan_s, of_each, by_group }
    }

    fn trials(&self) -> f64 {
        self.by_group.iter().map(Vec::len).sum::<usize>() as f64 / self.of_each as f64
    }

    /// The share of trials that are at least as strange as the query; the query counts as one of them.
    /// `of_query` gives the query's nonconformity by the model without a given group.
    fn p_value(&self, of_query: impl Fn(usize) -> f64) -> f64 {
        let at_least = |(group, values): (usize, &Vec<f64>)| {
            let own = of_query(group);
            values.len() - values.partition_point(|&value| value < own)
        };
        let stranger: usize = self.by_group.iter().enumerate().map(at_least).sum();
        (stranger as f64 / self.of_each as f64 + 1.0) / (self.trials() + 1.0)
    }
}

/// Nonconformity of left-out library trials, whole and cut to their beginnings.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub(crate) struct Conformity {
    /// Calibrations in ascending order of length; the last is for whole scans.
    by_length: Vec<Calibration>,
}

impl Conformity {
    /// Takes calibrations in ascending order of length; the last must be for whole scans.
    pub(crate) fn new(mut by_length: Vec<Calibration>) -> Self {
        by_length.retain(|calibration| calibration.trials() > 0.0);
        Self { by_length }
    }

    /// These calibrations after those of shorter scans, in ascending order of length.
    pub(crate) fn after(&self, shorter: impl Iterator<Item = Calibration>) -> Self {
        Self::new(shorter.chain(self.by_length.iter().cloned()).collect())
    }

    /// Number of trials that the p-value of a whole scan is based on.
    pub(crate) fn trials(&self) -> usize {
        self.by_length.last().map_or(0, |calibration| calibration.trials().round() as usize)
    }

    /// The p-value of a scan of `scan_s` seconds, from 1/(n + 1) to 1; pass infinity for a scan
    /// without a drag. `of_query` gives the scan's nonconformity by the model without a given group.
    /// `None` if the scan is shorter than every calibrated length.
    pub(crate) fn p_value(&self, scan_s: f64, of_query: impl Fn(usize) -> f64) -> Option<f64> {
        let (whole, beginnings) = self.by_length.split_last()?;
        let calibration = if scan_s >= WHOLE * whole.scan_s {
            whole
        } else {
            beginnings.iter().rev().find(|c| c.scan_s <= scan_s + 1e-9)?
        };
        Some(calibration.p_value(of_query))
    }
}

/// Why no scan can be called unknown.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RejectionError {
    #[error("a rate of false rejections of {0} is not possible; expected above 0, below 1")]
    Rate(f64),
    #[error(
        "calling surfaces unknown at {} % false rejections takes {needed} trials that can be left \
         out, but the library has {trials}: enrol more, or allow more false rejections", 100.0 * rate
    )]
    TooFew { rate: f64, needed: usize, trials: usize },
    #[error(
        "this method cannot say whether a surface is unknown: that would take comparing every \
         trial of the library with all others; the method `embedding` can"
    )]
    NoPValue,
}

/// False rejection rate used by default, if the library has enough trials for it.
const USUAL_RATE: f64 = 0.01;

/// Scans are called unknown by default only with at least this many left-out trials.
pub(crate) const FEWEST: usize = 9;

/// The p-value at or below which a query is called unknown.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Rejection {
    /// Stated rate of false rejections, α.
    pub rate: f64,
    /// Number of left-out library trials that the threshold is based on.
    pub trials: usize,
    #[serde(flatten)]
    pub left_out: LeftOutBy,
    /// Lower end of the 95 % interval of the rate, given these trials; `None` if people or sessions were
    /// left out, since their trials are not independent.
    pub rate_low: Option<f64>,
    pub rate_high: Option<f64>,
}

impl Rejection {
    /// The threshold for a rate of 1 %, or for the lowest rate that a p-value from `trials` trials can
    /// reach.
    ///
    /// # Errors
    /// If there are fewer than `FEWEST` trials, since more than one scan in ten would be wrongly rejected.
    pub fn usual(trials: usize, left_out: LeftOutBy) -> Result<Self, RejectionError> {
        if trials < FEWEST {
            let rate = 1.0 / (FEWEST + 1) as f64;
            return Err(RejectionError::TooFew { rate, needed: FEWEST, trials });
        }
        Self::new(trials, left_out, USUAL_RATE.max(1.0 / (trials + 1) as f64))
    }

    /// The threshold for a rate of `rate`, based on `trials` left-out trials. Given exchangeable trials, the
    /// true rate follows Beta(k, n + 1 − k), k = ⌊α(n + 1)⌋ (Vovk 2012, "Conditional validity of
    /// inductive conformal predictors"). For k = 1 its density is highest at 0, so the interval of
    /// highest density begins at 0.
    ///
    /// # Errors
    /// If there are fewer than 1/α − 1 trials: no p-value can then be as low as `rate`.
    pub(crate) fn new(
        trials: usize,
        left_out: LeftOutBy,
        rate: f64,
    ) -> Result<Self, RejectionError> {
        if !(rate > 0.0 && rate < 1.0) {
            return Err(RejectionError::Rate(rate));
        }
        let k = (rate * (trials + 1) as f64 + 1e-9).floor();
        if k < 1.0 {
            let needed = (1.0 / rate - 1e-9).ceil() as usize - 1;
            return Err(RejectionError::TooFew { rate, needed, trials });
        }
        let end = |level| beta_quantile(k, (trials + 1) as f64 - k, level);
        let ends = if k < 2.0 { (0.0, end(0.95)) } else { (end(0.025), end(0.975)) };
        let (rate_low, rate_high) = (left_out == LeftOutBy::Trials).then_some(ends).unzip();
        Ok(Self { rate, trials, left_out, rate_low, rate_high })
    }

    pub fn rejects(&self, p_value: f64) -> bool {
        p_value <= self.rate + 1e-12
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn calibration(scan_s: f64, values: Vec<f64>) -> Calibration {
        let groups = values.len() / 2;
        Calibration::new(scan_s, 1, values.into_iter().enumerate().map(|(i, x)| (i % groups, x)))
    }

    #[test]
    fn the_usual_rate_is_as_low_as_the_trials_can_show() {
        assert!(Rejection::usual(8, LeftOutBy::Trials).is_err());
        for (trials, rate) in [(9, 0.1), (24, 0.04), (99, 0.01), (1000, 0.01)] {
            let usual = Rejection::usual(trials, LeftOutBy::Trials).unwrap();
            assert!((usual.rate - rate).abs() < 1e-12, "{trials}");
            assert!(usual.rejects(1.0 / (trials + 1) as f64));
            assert!(usual.rate_low.unwrap() <= rate && rate < usual.rate_high.unwrap());
        }
        // P(rate ≤ x) = 1 − (1 − x)^n for k = 1.
        let interval = Rejection::usual(24, LeftOutBy::Trials).unwrap();
        assert!(interval.rate_low == Some(0.0));
        assert!((interval.rate_high.unwrap() - 0.117).abs() < 1e-3);
        let of_people = Rejection::usual(24, LeftOutBy::People).unwrap();
        assert_eq!((of_people.rate, of_people.rate_high), (interval.rate, None));
    }

    #[test]
    fn too_few_trials_are_refused_and_99_are_enough_for_one_percent() {
        let error = Rejection::new(98, LeftOutBy::Trials, 0.01).unwrap_err().to_string();
        assert!(error.contains("1 % false rejections takes 99 trials"), "{error}");
        let enough = Rejection::new(99, LeftOutBy::Trials, 0.01).unwrap();
        assert!(enough.rejects(1.0 / 100.0) && !enough.rejects(2.0 / 100.0));
        assert!(enough.rate_low < Some(0.01) && Some(0.01) < enough.rate_high, "{enough:?}");
        assert!(
            Rejection::new(99, LeftOutBy::Trials, 0.0).is_err()
                && Rejection::new(99, LeftOutBy::Trials, f64::NAN).is_err()
        );
    }

    #[test]
    fn of_exchangeable_queries_no_more_than_the_stated_share_is_rejected() {
        // A permutation of 0 … 999; each value in turn is the query, and 199 others are the library.
        let value = |i: usize| ((i * 617) % 1000) as f64;
        let test = Rejection::new(199, LeftOutBy::People, 0.05).unwrap();
        let rejected = (0..1000).filter(|&q| {
            let others = (1..=199).map(|j| value((q + 5 * j) % 1000)).collect();
            let conformity = Conformity::new(vec![calibration(4.8, others)]);
            test.rejects(conformity.p_value(4.8, |_| value(q)).unwrap())
        });
        let share = rejected.count() as f64 / 1000.0;
        assert!((0.03..=0.06).contains(&share), "{share}");
    }

    #[test]
    fn a_short_scan_is_compared_with_short_beginnings() {
        let long: Vec<f64> = (0..99).map(f64::from).collect();
        let short: Vec<f64> = long.iter().map(|x| x + 50.0).collect();
        let conformity = Conformity::new(vec![calibration(0.5, short), calibration(4.8, long)]);
        assert_eq!(conformity.p_value(4.7, |_| 90.0), Some(0.10));
        assert_eq!(conformity.p_value(1.0, |_| 90.0), Some(0.60));
        assert_eq!(conformity.p_value(0.4, |_| 90.0), None);
        assert_eq!(conformity.trials(), 99);
    }

    #[test]
    fn each_group_is_compared_by_the_model_without_it_and_excerpts_of_one_trial_count_as_one() {
        let scans = [(0, 1.0), (0, 2.0), (0, 3.0), (1, 10.0), (1, 20.0), (1, 30.0)];
        let excerpts = Conformity::new(vec![Calibration::new(1.0, 3, scans.into_iter())]);
        assert_eq!(excerpts.trials(), 2);
        // Two of three excerpts of one trial, and one of the other, are stranger: (2/3 + 1/3 + 1)/3.
        let p_value = excerpts.p_value(2.0, |group| [1.5, 25.0][group]).unwrap();
        assert!((p_value - 2.0 / 3.0).abs() < 1e-12, "{p_value}");
    }
}
