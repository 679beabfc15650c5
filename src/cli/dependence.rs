//! `surfaced dependence`: whether paired samples of two CSV files depend on each other, by HSIC.

use std::path::PathBuf;

use super::{Done, Failure, samples, show};
use crate::kernel::{Threshold, test_independence};
use crate::seed;

/// Test whether the paired samples of two CSV files depend on each other (HSIC)
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced dependence x.csv y.csv\n  \
                        surfaced dependence x.csv y.csv --gamma --json\n\nTime: a second for a thousand rows")]
pub struct Args {
    /// CSV file: a row a sample, a column a channel, no header
    x: PathBuf,
    /// CSV file with the sample that goes with each of X, row by row
    y: PathBuf,
    /// Significance level of κ
    #[arg(long, default_value_t = 0.05, value_name = "ALPHA")]
    alpha: f64,
    /// Permutations of one side, for κ and the p-value
    #[arg(long, default_value_t = 1000, value_name = "COUNT")]
    permutations: usize,
    /// κ and the p-value from the exact permutation moments instead of permutations
    #[arg(long, conflicts_with = "permutations")]
    gamma: bool,
    /// Seed of the permutations
    #[arg(long, default_value_t = 1, value_name = "SEED")]
    seed: u64,
    /// Print one JSON document on stdout
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Done {
    let (x, y) = (samples::read(&args.x)?, samples::read(&args.y)?);
    let threshold =
        if args.gamma { Threshold::Gamma } else { Threshold::Permutations(args.permutations) };
    let mut rng = seed::rng(args.seed, &[b"dependence"]);
    let result = test_independence(x.view(), y.view(), args.alpha, threshold, &mut rng).map_err(
        |error| {
            let files = format!("{} (side 1), {} (side 2)", args.x.display(), args.y.display());
            Failure::Failed(format!("{files}: {error}"))
        },
    )?;
    if args.json {
        show::json(&result);
        return Ok(());
    }
    result!("n = {}, σ_x = {:.6}, σ_y = {:.6}", result.n, result.sigma_x, result.sigma_y);
    result!("HSIC_b = {:.6e}   κ = {:.6e}   p = {:.4}", result.hsic, result.kappa, result.p_value);
    let verdict = if result.hsic > result.kappa {
        "they depend on each other"
    } else {
        "no dependence seen, which is not a proof of independence"
    };
    result!("at level {}: {verdict}", args.alpha);
    show::next("surfaced duration my-library says how far apart samples of a recording must lie");
    Ok(())
}
