//! Settings of the published rules of `surfaced duration`.

use crate::cli::method::at_least_one;
use crate::duration::{Algorithm1Settings, Rule};
use crate::kernel::Threshold;

/// Settings of Algorithm 1, which its two rules share.
#[derive(clap::Args)]
#[command(next_help_heading = "Published rules (quantile, mean-ci)")]
pub struct Algorithm1Args {
    /// R, the draws of a start for each lag (default 500)
    #[arg(long, value_name = "R", value_parser = at_least_one)]
    draws: Option<usize>,
    /// Latest start t1,max, in samples (default 20000)
    #[arg(long, value_name = "SAMPLES", value_parser = at_least_one)]
    latest_start: Option<usize>,
    /// Largest lag to look at, in samples (default 1000)
    #[arg(long, value_name = "SAMPLES", value_parser = at_least_one)]
    largest_lag: Option<usize>,
    /// Significance level of κ (default 0.05)
    #[arg(long, value_name = "ALPHA")]
    alpha: Option<f64>,
    /// Permutations for each κ (default 100)
    #[arg(long, value_name = "COUNT", value_parser = at_least_one)]
    permutations: Option<usize>,
    /// κ from the exact permutation moments instead of permutations: faster
    #[arg(long, conflicts_with = "permutations")]
    gamma: bool,
    /// Look at every lag upwards instead of a coarse grid that is refined
    #[arg(long)]
    exhaustive: bool,
    /// Stop at the first lag, as Algorithm 1 is printed, even if dependence returns beyond it
    #[arg(long)]
    first: bool,
    /// Seed of everything that is drawn at random (default 1)
    #[arg(long, value_name = "SEED")]
    seed: Option<u64>,
}

impl Algorithm1Args {
    /// The first of these flags that was given.
    pub fn given(&self) -> Option<&'static str> {
        [
            (self.draws.is_some(), "--draws"),
            (self.latest_start.is_some(), "--latest-start"),
            (self.largest_lag.is_some(), "--largest-lag"),
            (self.alpha.is_some(), "--alpha"),
            (self.permutations.is_some(), "--permutations"),
            (self.gamma, "--gamma"),
            (self.exhaustive, "--exhaustive"),
            (self.first, "--first"),
            (self.seed.is_some(), "--seed"),
        ]
        .into_iter()
        .find_map(|(is_given, flag)| is_given.then_some(flag))
    }

    pub fn settings(&self, rule: Rule) -> Algorithm1Settings {
        let default = Algorithm1Settings::default();
        Algorithm1Settings {
            rule,
            draws: self.draws.unwrap_or(default.draws),
            latest_start: self.latest_start.unwrap_or(default.latest_start),
            alpha: self.alpha.unwrap_or(default.alpha),
            threshold: match (self.gamma, self.permutations) {
                (true, _) => Threshold::Gamma,
                (false, Some(count)) => Threshold::Permutations(count),
                (false, None) => default.threshold,
            },
            largest_lag: self.largest_lag.unwrap_or(default.largest_lag),
            exhaustive: self.exhaustive,
            look_beyond: !self.first,
            seed: self.seed.unwrap_or(default.seed),
        }
    }
}
