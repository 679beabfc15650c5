//! The results of a run in all settings of the paper: of shards (parts of the queries), how to join
//! shards, and the comparison with the published results.

use std::collections::BTreeSet;
use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::rows::{ALL, Row, TABLE_1, TABLE_2, rows};
use crate::evaluate::{Confusion, Outcome, Prediction, Protocol};
use crate::recognise::{log_discrepancy, medians};
use crate::trial::TrialKey;

/// A part of the queries: every `of`-th query, beginning with the `number`-th (counted from 1).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Shard {
    pub number: usize,
    pub of: usize,
}

impl Shard {
    pub const WHOLE: Self = Self { number: 1, of: 1 };

    pub(crate) fn has(self, query: usize) -> bool {
        query % self.of == self.number - 1
    }

    pub fn file_name(self) -> String {
        format!("shard-{:04}-of-{:04}.json", self.number, self.of)
    }
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.number, self.of)
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts =
            text.split_once('/').and_then(|(a, b)| Some((a.parse().ok()?, b.parse().ok()?)));
        match parts {
            Some((number, of)) if 1 <= number && number <= of => Ok(Self { number, of }),
            _ => Err("expected NUMBER/COUNT, counted from 1, such as 3/64".into()),
        }
    }
}

/// Answers in one setting. Trials are given by their indices in [`PaperPart::trials`].
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RowPart {
    /// The setting as text: its place in the paper, its protocol and its name.
    pub setting: String,
    pub missing: Vec<String>,
    pub not_run: Option<String>,
    pub folds: Vec<String>,
    /// Number of trials in the largest library of a fold.
    pub library_trials: usize,
    pub labels: Vec<String>,
    /// Fold, query and nearest library trial of each answer, sorted.
    pub answers: Vec<(usize, usize, usize)>,
}

/// The result of a shard, or of all shards joined.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PaperPart {
    /// Version of this format, 2.
    pub format: u32,
    pub data: String,
    pub synthetic: bool,
    /// The settings of the method as text; they are the same in all shards of a run.
    pub settings: String,
    pub seed: u64,
    /// The digest of the trials; see [`crate::library::Library::digest`].
    pub library: String,
    pub shard: Shard,
    /// Surface, user and number of every trial.
    pub trials: Vec<(String, String, u32)>,
    /// The answers in each setting, in the order of `rows`.
    pub rows: Vec<RowPart>,
}

impl PaperPart {
    pub fn is_of_run(&self, other: &Self) -> bool {
        let head = |part: &Self| {
            let settings: Vec<_> = part.rows.iter().map(|row| row.setting.clone()).collect();
            (part.format, part.data.clone(), part.settings.clone(), part.trials.clone(), settings)
        };
        head(self) == head(other) && self.shard.of == other.shard.of
    }
}

/// Joins the shards of a run, given in any order; an error says what is missing or wrong.
pub fn merge(mut parts: Vec<PaperPart>) -> Result<PaperPart, String> {
    parts.sort_by_key(|part| part.shard);
    for part in &parts {
        let trials = part.trials.len();
        let fits = |row: &RowPart| {
            row.answers.iter().all(|&(f, q, a)| f < row.folds.len() && q < trials && a < trials)
        };
        if !part.rows.iter().all(fits) || part.shard.number == 0 {
            let shard = part.shard;
            return Err(format!(
                "shard {shard} is damaged; remove its file, and run shard {shard} again"
            ));
        }
    }
    let mut parts = parts.into_iter();
    let mut whole = parts.next().ok_or(
        "no shards to join; name the files that `surfaced eval --paper --shard` wrote, or their \
         folder",
    )?;
    let (first, of) = (whole.shard, whole.shard.of);
    let mut numbers = BTreeSet::from([first.number]);
    for part in parts {
        let shard = part.shard;
        if !part.is_of_run(&whole) || part.library != whole.library {
            return Err(format!(
                "shard {shard} is of another run than shard {first}: other data or settings"
            ));
        }
        if !numbers.insert(shard.number) {
            return Err(format!("shard {shard} was given twice"));
        }
        for (row, more) in whole.rows.iter_mut().zip(part.rows) {
            row.answers.extend(more.answers);
        }
    }
    let missing: Vec<String> =
        (1..=of).filter(|n| !numbers.contains(n)).map(|n| n.to_string()).collect();
    if !missing.is_empty() {
        return Err(format!("of {of} shards, these are missing: {}", missing.join(", ")));
    }
    whole.rows.iter_mut().for_each(|row| row.answers.sort_unstable());
    whole.shard = Shard::WHOLE;
    Ok(whole)
}

/// Results in one setting. Our accuracies are fractions from 0 to 1, the paper's are percentages.
#[derive(Clone, Debug, Serialize)]
pub struct ReportRow {
    #[serde(flatten)]
    pub row: Row,
    pub sources: Vec<&'static str>,
    pub missing: Vec<String>,
    pub not_run: Option<String>,
    pub accuracy_mean: Option<f64>,
    /// Sample standard deviation over folds.
    pub accuracy_std: Option<f64>,
    /// Lower end of the 95 % Wilson interval over queries.
    pub accuracy_low: Option<f64>,
    pub accuracy_high: Option<f64>,
    /// Mean over classes of TP/(TP+FP).
    pub precision_mean: Option<f64>,
    pub classes: usize,
    pub queries: usize,
    pub library_trials: usize,
    /// Our accuracy minus the paper's, in percentage points.
    pub difference_points: Option<f64>,
}

#[derive(Clone, Debug, Serialize)]
pub struct PaperReport {
    pub data: String,
    pub synthetic: bool,
    pub settings: String,
    pub rows: Vec<ReportRow>,
    /// Confusion matrix (truth against answer) with all sources, by `expert-vs-users`.
    pub confusion: Option<Confusion>,
}

/// Number of surfaces in the paper's dataset.
const SURFACES: usize = 108;
const TABLES: [&str; 2] = [TABLE_1, TABLE_2];

impl PaperReport {
    pub fn new(part: &PaperPart) -> Self {
        let keys: Vec<TrialKey> =
            part.trials.iter().map(|(s, user, number)| TrialKey::new(s, user, *number)).collect();
        let mut confusion = None;
        let mut report = Vec::new();
        for (row, answers) in rows().into_iter().zip(&part.rows) {
            let outcome = outcome(answers, &keys);
            let is_main = row.name == ALL && row.protocol == Protocol::ExpertVsUsers;
            report.push(report_row(row, answers, outcome.as_ref()));
            if is_main {
                confusion = outcome.map(|outcome| outcome.confusion);
            }
        }
        let PaperPart { data, synthetic, settings, .. } = part.clone();
        Self { data, synthetic, settings, rows: report, confusion }
    }

    /// The data that are missing to fill the paper's tables, in three lines; `None` if none are.
    pub fn lacking(&self) -> Option<String> {
        let of_tables = || self.rows.iter().filter(|row| TABLES.contains(&row.row.place));
        let is_filled = |row: &&ReportRow| row.accuracy_mean.is_some() && row.missing.is_empty();
        let counts = TABLES.map(|table| {
            let of = || of_tables().filter(|row| row.row.place == table);
            format!("{} of {} rows of {table}", of().filter(is_filled).count(), of().count())
        });
        let lacking: Vec<&ReportRow> = of_tables().filter(|row| !is_filled(row)).collect();
        let sources: BTreeSet<&str> =
            lacking.iter().flat_map(|row| &row.missing).map(String::as_str).collect();
        let sources: Vec<&str> = sources.into_iter().collect();
        // A row with a source that can be run may still lack trials.
        let protocols: BTreeSet<&str> = (lacking.iter())
            .filter(|row| row.accuracy_mean.is_none() && !row.sources.is_empty())
            .map(|row| row.row.protocol.needs())
            .collect();
        let missing = [
            (!sources.is_empty()).then(|| format!("the sources {}", sources.join(", "))),
            (!protocols.is_empty()).then(|| protocols.into_iter().collect::<Vec<_>>().join("; ")),
        ];
        let missing = missing.into_iter().flatten().collect::<Vec<_>>().join("; and ");
        (!lacking.is_empty()).then(|| {
            format!(
                "these data fill {}\nmissing: {missing}\nthe dataset LMT108 has them; `surfaced eval` \
                 without --paper measures these data as they are",
                counts.join(" and ")
            )
        })
    }
}

fn outcome(row: &RowPart, keys: &[TrialKey]) -> Option<Outcome> {
    let predictions: Vec<Prediction> = (row.answers.iter())
        .filter_map(|&(fold, query, answer)| {
            let (key, surface) = (keys.get(query)?.clone(), keys.get(answer)?.surface.clone());
            Some(Prediction { key, fold, surface, ..Prediction::default() })
        })
        .collect();
    Outcome::new(&predictions, &row.folds, row.labels.clone(), row.library_trials, "reference")
}

fn report_row(row: Row, part: &RowPart, outcome: Option<&Outcome>) -> ReportRow {
    let mut sources: Vec<&str> = row.terms.iter().map(|(_, stream)| stream.source).collect();
    sources.dedup();
    sources.retain(|source| !part.missing.iter().any(|missing| missing == source));
    let difference = |outcome: &Outcome| {
        // A setting without all its sources or surfaces is not comparable with the paper's.
        let is_same = part.missing.is_empty() && outcome.classes == SURFACES;
        let published = row.published.filter(|_| is_same)?;
        Some(outcome.accuracy_mean * 100.0 - published.accuracy)
    };
    ReportRow {
        sources,
        missing: part.missing.clone(),
        not_run: part.not_run.clone(),
        accuracy_mean: outcome.map(|o| o.accuracy_mean),
        accuracy_std: outcome.and_then(|o| o.accuracy_std),
        accuracy_low: outcome.map(|o| o.share.interval().0),
        accuracy_high: outcome.map(|o| o.share.interval().1),
        precision_mean: outcome.map(|o| o.precision_mean),
        classes: outcome.map_or(0, |o| o.classes),
        queries: outcome.map_or(0, |o| o.queries),
        library_trials: part.library_trials,
        difference_points: outcome.and_then(difference),
        row,
    }
}

// The score of one source between two trials does not depend on the other sources used. So the
// score is computed once, and each row of the paper's tables only adds logarithms of scores.

/// ln of the scores between one query and library trials, in one stream (a sampled source).
#[derive(Clone, Debug, PartialEq)]
pub(super) struct LogScores {
    /// Indices of the library trials, ascending.
    pub library: std::sync::Arc<[usize]>,
    /// ln of the score of each library trial; NaN if query or trial lacks the source.
    pub values: Vec<f64>,
}

impl LogScores {
    fn of(&self, trial: usize) -> Option<f64> {
        let at = self.library.binary_search(&trial).ok()?;
        self.values.get(at).copied().filter(|value| !value.is_nan())
    }
}

/// Index of the library trial that is nearest to a query (Eq. 9, 1-NN).
///
/// `terms` are the weights and scores of streams; `keys` must be sorted. As in the method `reference`,
/// the stream's median over the other trials replaces a missing score, and a tie goes to the smaller
/// key. Trials without any score are left out. `None` if no trial has a score.
pub(super) fn nearest(
    library: &[usize],
    terms: &[(f64, &LogScores)],
    keys: &[TrialKey],
) -> Option<usize> {
    debug_assert!(keys.is_sorted());
    let scores_of = |&trial: &usize| terms.iter().map(|(_, scores)| scores.of(trial)).collect();
    let scores: Vec<Vec<Option<f64>>> = library.iter().map(scores_of).collect();
    let weights: Vec<f64> = terms.iter().map(|(weight, _)| *weight).collect();
    let medians = medians(terms.len(), &scores);
    let scored = library
        .iter()
        .zip(&scores)
        .filter_map(|(&trial, scores)| Some((log_discrepancy(&weights, scores, &medians)?, trial)));
    let nearest = scored.min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    nearest.map(|(_, trial)| trial)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scores(values: &[f64]) -> LogScores {
        LogScores { library: (0..values.len()).collect(), values: values.to_vec() }
    }

    fn keys() -> Vec<TrialKey> {
        ["a", "b", "c"].map(|surface| TrialKey::new(surface, "expert", 1)).to_vec()
    }

    #[test]
    fn weights_decide_between_sources() {
        let (x, y) = (scores(&[0.0, 1.0, 9.0]), scores(&[1.5, 0.0, 9.0]));
        assert_eq!(nearest(&[0, 1, 2], &[(1.0, &x), (1.0, &y)], &keys()), Some(1));
        assert_eq!(nearest(&[0, 1, 2], &[(3.0, &x), (1.0, &y)], &keys()), Some(0));
        assert_eq!(nearest(&[1, 2], &[(3.0, &x), (1.0, &y)], &keys()), Some(1));
    }

    #[test]
    fn a_tie_goes_to_the_smaller_key_and_a_gap_to_the_median() {
        let x = scores(&[0.5, 0.5, 0.5]);
        assert_eq!(nearest(&[0, 1, 2], &[(1.0, &x)], &keys()), Some(0));
        let gap = scores(&[f64::NAN, 1.0, 2.0]);
        assert_eq!(nearest(&[0, 1, 2], &[(1.0, &x), (1.0, &gap)], &keys()), Some(1));
        assert_eq!(nearest(&[0], &[(1.0, &gap)], &keys()), None);
    }

    fn part(number: usize, answers: Vec<(usize, usize, usize)>) -> PaperPart {
        let row = RowPart { folds: vec!["user1".into()], answers, ..RowPart::default() };
        let trials = vec![("a".into(), "expert".into(), 1), ("a".into(), "user1".into(), 1)];
        let shard = Shard { number, of: 2 };
        PaperPart { shard, trials, rows: vec![row], ..PaperPart::default() }
    }

    #[test]
    fn what_does_not_join_is_said() {
        let one = part(1, vec![]);
        let other = PaperPart { settings: "t".into(), ..part(2, vec![]) };
        let damaged = part(2, vec![(0, 9, 0)]);
        for (parts, problem) in [
            (vec![], "no shards to join"),
            (vec![one.clone()], "of 2 shards, these are missing: 2"),
            (vec![one.clone(), one.clone()], "shard 1/2 was given twice"),
            (vec![one.clone(), other], "shard 2/2 is of another run than shard 1/2"),
            (vec![one, damaged], "shard 2/2 is damaged"),
        ] {
            let said = merge(parts).unwrap_err();
            assert!(said.starts_with(problem), "{said}");
        }
    }

    #[test]
    fn shards_share_the_queries_out() {
        let shards: Vec<Shard> = ["1/3", "2/3", "3/3"].map(|s| s.parse().unwrap()).to_vec();
        for query in 0..20 {
            assert_eq!(shards.iter().filter(|shard| shard.has(query)).count(), 1);
        }
        for bad in ["0/3", "4/3", "3", "a/b"] {
            assert!(bad.parse::<Shard>().is_err());
        }
    }
}
