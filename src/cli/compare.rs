//! `surfaced compare`: compares two trials, source by source, or two sets of samples. `surfaced
//! dependence`: tests whether paired samples depend on each other, by HSIC.

use std::path::{Path, PathBuf};

use ndarray::Array2;

use super::method::at_least_one;
use super::{Done, Failure, SourceArgs, parsed, share, show};
use crate::dataset::csv::CsvTable;
use crate::kernel::{Threshold, neighbours_alike, test_independence};
use crate::library::{Entry, Library, LibraryError, recording};
use crate::recognise::{Comparison, TestOptions, compare, score_samples};
use crate::scene::Scene;
use crate::seed;
use crate::trial::Trial;

/// Compare two trials, source by source
///
/// The p-values hold for samples that are independent: where samples that follow each other in time are
/// alike, trials of one surface differ too often.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced compare lib/oak/1 lib/beech/1\n  \
                        surfaced compare LMT_108_SurfaceMaterials_Database:G4Bamboo:1 \
                        LMT_108_SurfaceMaterials_Database:G4CherryTree:1 --sources mi2\n  \
                        surfaced compare --samples z.csv y.csv --json\n\nTime: a second")]
pub(super) struct Args {
    /// The query: a trial's folder, a trial's only file, or DATA:SURFACE:NUMBER (with :USER if
    /// necessary); with --samples, a CSV file
    a: PathBuf,
    /// The library trial, in the same form
    b: PathBuf,
    /// A and B are CSV files of samples: one row per sample, one column per channel, no header
    #[arg(long, conflicts_with_all = ["permutations", "alpha", "seed", "sources"])]
    samples: bool,
    /// First shift the mean of A to the mean of B, channel by channel
    #[arg(long, requires = "samples")]
    align_mean: bool,
    /// Length scale of the kernel (default: by the median heuristic)
    #[arg(long, requires = "samples", value_name = "X", value_parser = sigma)]
    sigma: Option<f64>,
    #[command(flatten)]
    sources: SourceArgs,
    /// Number of permutations within pairs, for κ and the p-value of trials
    #[arg(long, default_value_t = 1000, value_name = "COUNT", value_parser = at_least_one)]
    permutations: usize,
    /// Significance level of κ
    #[arg(long, default_value_t = 0.05, value_name = "ALPHA", value_parser = share)]
    alpha: f64,
    /// Seed of all random draws
    #[arg(long, default_value_t = 1, value_name = "SEED")]
    seed: u64,
    /// Print one JSON document on stdout
    #[arg(long)]
    json: bool,
}

fn sigma(text: &str) -> Result<f64, String> {
    parsed(text, |x: &f64| x.is_finite() && *x > 0.0, "a positive number")
}

pub(super) fn run(args: &Args) -> Done {
    if args.samples { compare_samples(args) } else { compare_trials(args) }
}

/// Reads a CSV file of samples, with shape (rows, columns).
fn samples(path: &Path) -> Result<Array2<f64>, LibraryError> {
    CsvTable::read(path)?.values().map_err(|problem| LibraryError::file(path, problem))
}

fn compare_samples(args: &Args) -> Done {
    let (z, y) = (samples(&args.a)?, samples(&args.b)?);
    if z.ncols() != y.ncols() {
        let (a, b) = (args.a.display(), args.b.display());
        return Err(Failure::Failed(format!(
            "{a} has {}, but {b} has {}; samples of one source have the same channels",
            show::counted(z.ncols(), "column"),
            y.ncols()
        )));
    }
    let result = score_samples(z.view(), y.view(), args.align_mean, args.sigma);
    show::result(args.json, &result, |result| {
        result!("n = {}, {} channel(s), σ = {:.6}", result.n, result.dims, result.sigma);
        result!("MMD²_b = {:.6e}   score n·MMD²_b = {:.6}", result.mmd2, result.score);
        show::next("--align-mean and --sigma X change how the two are compared");
    });
    Ok(())
}

#[derive(serde::Serialize)]
struct CompareReport {
    a: String,
    b: String,
    synthetic: bool,
    #[serde(flatten)]
    comparison: Comparison,
}

fn compare_trials(args: &Args) -> Done {
    let (a, scene, a_synthetic) = find(&args.a)?;
    let (b, of_b, b_synthetic) = find(&args.b)?;
    let scene = args.sources.narrow(scene.with(of_b))?;
    let &Args { permutations, alpha, seed, .. } = args;
    let options = TestOptions { samples: 400, repetitions: 10, permutations, alpha, seed };
    let comparison = compare(&a, &b, &scene, &options)?;
    let (a, b, synthetic) = (a.key.to_string(), b.key.to_string(), a_synthetic || b_synthetic);
    let report = CompareReport { a, b, synthetic, comparison };
    show::result(args.json, &report, |report| print(report, alpha));
    Ok(())
}

fn print(report: &CompareReport, alpha: f64) {
    let mark = if report.synthetic { "  (synthetic)" } else { "" };
    result!("A  {}\nB  {}{mark}\n", report.a, report.b);
    let sources = report.comparison.sources.iter().map(|s| {
        vec![
            s.source.to_string(),
            format!("{:.4}", s.score),
            format!("{:.4e}", s.mmd2),
            format!("{:.4e}", s.sigma),
            format!("{:.4e}", s.kappa),
            format!("{:.4}", s.p_value),
            if s.p_value <= alpha { "differ" } else { "" }.into(),
        ]
    });
    show::table(&["source", ">score n·MMD²", ">MMD²", ">σ", ">κ", ">p", ""], sources);
    result!();
    let alike = report.comparison.sources.iter().filter_map(|s| s.neighbours.map(|r| (s, r)));
    let alike = show::listed(alike.map(|(s, r)| format!("{} ({r:.2})", s.source)));
    if !alike.is_empty() {
        result!("neighbouring samples are alike, so that p is too small: {alike}");
    }
    result!("discrepancy score (product over sources)  {:.6e}", report.comparison.ds);
    show::next("surfaced eval my-library measures how well a library's surfaces are named");
}

/// The trial that an argument names, the scene of its library, and whether the trial is synthetic.
fn find(argument: &Path) -> Done<(Trial, Scene, bool)> {
    if argument.is_dir() {
        super::hold(argument);
        return alone(&recording::open_trial(argument, &Scene::lmt108())?);
    }
    if argument.is_file() {
        return alone(&super::open(argument)?);
    }
    let text = argument.to_string_lossy();
    let parts: Vec<&str> = text.split(':').collect();
    let [data, surface, number, ref user @ ..] = parts[..] else {
        return Err(Failure::Failed(format!(
            "{text}: there is no such trial; expected its folder (LIBRARY/SURFACE/TRIAL), its only \
             file, or DATA:SURFACE:NUMBER[:USER]"
        )));
    };
    let user = user.first();
    let library = super::open(Path::new(data))?;
    let is_wanted = |entry: &&Entry| {
        entry.key.surface == surface
            && entry.key.number.to_string() == number
            && user.is_none_or(|user| entry.key.user == *user)
    };
    let found: Vec<&Entry> = library.entries.iter().filter(is_wanted).collect();
    let by = user.map(|user| format!(" by {user}")).unwrap_or_default();
    match found[..] {
        [entry] => Ok((entry.load()?, library.scene.clone(), library.synthetic)),
        [] => Err(Failure::Failed(format!(
            "{data}: no trial {number} of `{surface}`{by}; its surfaces: {}",
            library.surfaces().join(", ")
        ))),
        _ => {
            let names = found.iter().map(|entry| entry.name_in(Path::new(data)));
            Err(Failure::Failed(format!(
                "{data}: there are {} trials {number} of `{surface}`{by}: {}; add :USER, or give a folder",
                found.len(),
                names.collect::<Vec<_>>().join(", ")
            )))
        }
    }
}

fn alone(one: &Library) -> Done<(Trial, Scene, bool)> {
    let entry = &one.entries[0];
    Ok((entry.load()?, one.scene.clone(), one.synthetic))
}

/// Test whether the paired samples of two CSV files depend on each other (HSIC)
///
/// The test holds for pairs that are independent of each other: rows that follow each other in time are alike,
/// and then too often seem to depend.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced dependence x.csv y.csv\n  \
                        surfaced dependence x.csv y.csv --gamma --json\n\nTime: a second for a thousand rows")]
pub(super) struct DependenceArgs {
    /// CSV file: one row per sample, one column per channel, no header
    x: PathBuf,
    /// CSV file of the same form; each row is paired with the same row of X
    y: PathBuf,
    /// Significance level of κ
    #[arg(long, default_value_t = 0.05, value_name = "ALPHA")]
    alpha: f64,
    /// Number of permutations of one file's rows, for κ and the p-value
    #[arg(long, default_value_t = 1000, value_name = "COUNT")]
    permutations: usize,
    /// Compute κ and the p-value from exact permutation moments, not by permutations
    #[arg(long, conflicts_with = "permutations")]
    gamma: bool,
    /// Seed of the permutations
    #[arg(long, default_value_t = 1, value_name = "SEED")]
    seed: u64,
    /// Print one JSON document on stdout
    #[arg(long)]
    json: bool,
}

pub(super) fn dependence(args: &DependenceArgs) -> Done {
    let (x, y) = (samples(&args.x)?, samples(&args.y)?);
    let threshold =
        if args.gamma { Threshold::Gamma } else { Threshold::Permutations(args.permutations) };
    let mut rng = seed::rng(args.seed, &[b"dependence"]);
    let result = test_independence(x.view(), y.view(), args.alpha, threshold, &mut rng).map_err(
        |error| {
            let files = format!("{} (side 1), {} (side 2)", args.x.display(), args.y.display());
            Failure::Failed(format!("{files}: {error}"))
        },
    )?;
    show::result(args.json, &result, |test| {
        result!("n = {}, σ_x = {:.6}, σ_y = {:.6}", test.n, test.sigma_x, test.sigma_y);
        result!("HSIC_b = {:.6e}   κ = {:.6e}   p = {:.4}", test.hsic, test.kappa, test.p_value);
        // Not by κ: where many permutations tie, rounding alone would decide.
        let verdict = match test.p_value <= args.alpha {
            true => "they depend on each other",
            false => "no dependence was found; this does not prove independence",
        };
        result!("at level {}: {verdict}", args.alpha);
        let alike = [&x, &y].map(|side| neighbours_alike(side.view()));
        if let [Some(of_x), Some(of_y)] = alike {
            result!(
                "neighbouring rows are alike in both files (correlation {of_x:.2} and {of_y:.2}): if they \
                 follow each other in time, the pairs are not independent, and p is too small"
            );
        }
        show::next(
            "surfaced duration my-library says how far apart samples of a recording must lie",
        );
    });
    Ok(())
}
