//! The results of shards (parts of the queries) of the paper's evaluation, and how to join shards.

use std::collections::BTreeSet;
use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// A part of the queries: every `of`-th query, beginning with the `number`-th (counted from 1).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Shard {
    pub number: usize,
    pub of: usize,
}

impl Shard {
    pub const WHOLE: Self = Self { number: 1, of: 1 };

    /// Whether the query with this index belongs to the shard.
    pub fn has(self, query: usize) -> bool {
        query % self.of == self.number - 1
    }

    /// Name of the file that holds the shard's result.
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
    pub library_trials: usize,
    pub labels: Vec<String>,
    /// Fold, query and nearest library trial of each answer, sorted.
    pub answers: Vec<(usize, usize, usize)>,
}

/// The result of a shard, or of all shards joined.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PaperPart {
    /// Version of this format, 1.
    pub format: u32,
    pub data: String,
    pub synthetic: bool,
    /// The settings of the method as text; they are the same in all shards of a run.
    pub settings: String,
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
        if !part.is_of_run(&whole) {
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

#[cfg(test)]
mod tests {
    use super::*;

    fn part(number: usize, answers: Vec<(usize, usize, usize)>) -> PaperPart {
        let row = RowPart { folds: vec!["user1".into()], answers, ..RowPart::default() };
        let trials = vec![("a".into(), "expert".into(), 1), ("a".into(), "user1".into(), 1)];
        let shard = Shard { number, of: 2 };
        PaperPart { shard, trials, rows: vec![row], ..PaperPart::default() }
    }

    #[test]
    fn shards_join_in_any_order() {
        let (one, two) = (part(1, vec![(0, 1, 0)]), part(2, vec![(0, 0, 1)]));
        let whole = merge(vec![two.clone(), one.clone()]).unwrap();
        assert_eq!(whole, merge(vec![one, two]).unwrap());
        assert_eq!(whole.rows[0].answers, [(0, 0, 1), (0, 1, 0)]);
        assert_eq!(whole.shard, Shard::WHOLE);
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
