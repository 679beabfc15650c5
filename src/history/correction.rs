//! Corrections of answers by people, and the precision that follows from them.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::recognise::wilson_interval;

/// The truth about a scan, as a person gave it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "was", rename_all = "lowercase")]
pub enum Correction {
    Surface {
        surface: String,
    },
    /// The scan was of a surface that the library lacks.
    Unknown,
    /// The scan was so bad that nobody could name it.
    Bad,
}

impl Correction {
    pub fn surface(&self) -> Option<&str> {
        match self {
            Self::Surface { surface } => Some(surface),
            Self::Unknown | Self::Bad => None,
        }
    }
}

/// How often one answer was right, among the scans that somebody corrected. Bad scans are left out.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Precision {
    /// The answer; `None` for unknown.
    pub surface: Option<String>,
    pub corrected: usize,
    /// How many of the corrected scans had this answer as their truth.
    pub right: usize,
    pub precision: f64,
    /// Ends of the 95 % Wilson interval.
    pub precision_low: f64,
    pub precision_high: f64,
}

/// The precision of each answer (a surface or unknown), from pairs of an answer and its correction.
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
