//! Settings of the method `reference`.

use serde::{Deserialize, Serialize};

use super::halving::Stage;
use super::score::SumPrecision;

/// The method's name.
pub const NAME: &str = "reference";

/// Whether sample positions are drawn once for the whole library or anew for each pair of trials.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PositionMode {
    /// Once a repetition, for every trial: far cheaper.
    #[default]
    Shared,
    /// Anew for every pair, as the authors' program does.
    PerPair,
}

/// Settings of the method; the defaults are the paper's, and are left out where settings are
/// written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
pub struct ReferenceOptions {
    /// Samples drawn from a source, n.
    #[serde(rename = "n")]
    pub samples: usize,
    /// Repetitions whose scores are averaged, R.
    pub repetitions: usize,
    /// Nearest neighbours, k.
    #[serde(skip_serializing_if = "is_one")]
    pub neighbours: usize,
    /// How positions are drawn.
    #[serde(skip_serializing_if = "is_default")]
    pub positions: PositionMode,
    /// Seed of all positions.
    #[serde(skip_serializing_if = "is_one")]
    pub seed: u64,
    /// How kernel sums are computed.
    #[serde(skip_serializing_if = "is_default")]
    pub precision: SumPrecision,
    /// Tabulate K(y, y) of library trials over σ: dearer to prepare, cheaper to compare with.
    #[serde(skip_serializing_if = "is_true")]
    pub tabulate: bool,
    /// Stages of successive halving, in order; none compares every trial by all repetitions.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub halving: Vec<Stage>,
}

fn is_one<T: PartialEq + From<u8>>(value: &T) -> bool {
    *value == T::from(1)
}

fn is_default<T: PartialEq + Default>(value: &T) -> bool {
    *value == T::default()
}

fn is_true(value: &bool) -> bool {
    *value
}

impl ReferenceOptions {
    /// The stages to go through; the last one keeps what it has.
    pub(super) fn stages(&self, trials: usize) -> Vec<Stage> {
        let Self { repetitions, neighbours, halving, .. } = self;
        let mut stages: Vec<Stage> = Vec::new();
        for stage in halving {
            let so_far = stages.last().map_or((0, trials), |s| (s.repetitions, s.keep));
            let keep = stage.keep.max(*neighbours).max(2);
            if so_far.0 < stage.repetitions && stage.repetitions < *repetitions && keep < so_far.1 {
                stages.push(Stage { repetitions: stage.repetitions, keep });
            }
        }
        stages.push(Stage { repetitions: *repetitions, keep: trials });
        stages
    }
}

impl Default for ReferenceOptions {
    fn default() -> Self {
        Self {
            samples: 400,
            repetitions: 10,
            neighbours: 1,
            positions: PositionMode::Shared,
            seed: 1,
            precision: SumPrecision::Fast,
            tabulate: true,
            halving: Vec::new(),
        }
    }
}
