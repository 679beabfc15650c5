//! Corrections of answers by people, and the precision that follows from them.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::recognise::wilson_interval;

/// The truth about a scan, as a person gave it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "was", rename_all = "lowercase")]
pub enum Correction {
    /// It was of this surface.
    Surface {
        /// the label
        surface: String,
    },
    /// It was of a surface that the library lacks.
    Unknown,
    /// It was a bad scan, which nobody could name.
    Bad,
}

impl Correction {
    /// The surface, if it was one.
    pub fn surface(&self) -> Option<&str> {
        match self {
            Self::Surface { surface } => Some(surface),
            Self::Unknown | Self::Bad => None,
        }
    }
}

/// The precision of one answer, over the scans that somebody corrected. Bad scans do not count.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Precision {
    /// The answer; `None` for unknown.
    pub surface: Option<String>,
    /// Number of corrected scans with this answer.
    pub corrected: usize,
    /// Number of those that the answer named right.
    pub right: usize,
    /// Share of `corrected` that were right.
    pub precision: f64,
    /// Lower end of the 95 % Wilson interval of `precision`.
    pub precision_low: f64,
    /// Upper end of that interval.
    pub precision_high: f64,
}

/// The precision of answers with their corrections, by the surface that was answered.
pub fn precision<'a>(
    corrected: impl Iterator<Item = (Option<&'a str>, &'a Correction)>,
) -> Vec<Precision> {
    let mut counts: BTreeMap<Option<&str>, (usize, usize)> = BTreeMap::new();
    for (answered, correction) in corrected {
        let right = match correction {
            Correction::Bad => continue,
            Correction::Unknown => answered.is_none(),
            Correction::Surface { surface } => answered == Some(surface),
        };
        let (all, rights) = counts.entry(answered).or_default();
        *all += 1;
        *rights += usize::from(right);
    }
    let of = |(surface, (corrected, right)): (Option<&str>, (usize, usize))| {
        let (precision_low, precision_high) = wilson_interval(right, corrected);
        let precision = right as f64 / corrected as f64;
        let surface = surface.map(String::from);
        Precision { surface, corrected, right, precision, precision_low, precision_high }
    };
    counts.into_iter().map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn precision_counts_by_what_was_answered_and_not_bad_scans() {
        let was = |surface: &str| Correction::Surface { surface: surface.into() };
        let said = [
            (Some("oak"), was("oak")),
            (Some("oak"), was("ash")),
            (Some("oak"), Correction::Unknown),
            (Some("oak"), Correction::Bad),
            (None, Correction::Unknown),
            (None, was("elm")),
        ];
        let found = precision(said.iter().map(|(answered, was)| (*answered, was)));
        let counts: Vec<_> =
            found.iter().map(|p| (p.surface.as_deref(), p.right, p.corrected)).collect();
        assert_eq!(counts, [(None, 1, 2), (Some("oak"), 1, 3)]);
    }
}
