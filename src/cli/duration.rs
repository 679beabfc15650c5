//! `surfaced duration`: T* and the scan duration of each surface and source of a library.

use std::path::PathBuf;

use super::figure::write;
use super::method::at_least_one;
use super::{Done, Failure, show};
use crate::duration::{
    CORRELATION, Estimator, PooledSettings, Question, ReportError, Rule, Settings, figure, report,
};
use crate::kernel::Threshold;
use crate::scene::SourceId;

/// Compute T*, the minimum time between independent samples, and how long a scan must last
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced duration lib --source ir\n  \
                        surfaced duration lib --source ir --surface G7EPDMFoam --svg foam.svg\n  \
                        surfaced duration LMT_108_SurfaceMaterials_Database --source mi2\n  \
                        surfaced duration lib --source ir --rule mean-ci --draws 200\n\nTime: 5 s for LMT108's 200 dragging sounds, on two cores")]
pub struct Args {
    /// A library, or any recordings that `eval` reads
    lib: PathBuf,
    /// Sources, with commas between them (default: all that are recorded while dragging; with a
    /// published rule, those of domain `time`)
    #[arg(long, value_delimiter = ',', value_name = "ID,…", value_parser = SourceId::new)]
    source: Vec<SourceId>,
    /// Surfaces, with commas between them (default: all)
    #[arg(long, value_delimiter = ',', value_name = "NAME,…")]
    surface: Vec<String>,
    /// Whose trials (default: for each surface, those of the user with the most)
    #[arg(long, value_name = "NAME")]
    user: Option<String>,
    /// Let a published rule take the named sources as series in time, whatever their domain is
    /// (`pooled` always does)
    #[arg(long, requires = "source")]
    as_time: bool,
    /// How T* is found: by the size of the dependence over all pairs of all trials, or by the
    /// paper's Algorithm 1, whose bound is the quantile of its HSIC values (as printed) or the upper
    /// end of the interval of their mean (the authors' program)
    #[arg(long, value_enum, default_value_t = RuleName::Pooled)]
    rule: RuleName,
    /// Dependence that is small enough, as the correlation of a Gaussian process (`pooled`; default
    /// 0.1)
    #[arg(long, value_name = "CORRELATION")]
    dependence: Option<f64>,
    /// Independent samples that a scan must yield
    #[arg(long, default_value_t = 400, value_name = "N", value_parser = at_least_one)]
    samples: usize,
    #[command(flatten)]
    algorithm1: Algorithm1Args,
    /// Draw the curves (HSIC, κ, T*) as SVG
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// Print one JSON document on stdout
    #[arg(long)]
    json: bool,
}

/// Settings of Algorithm 1, which its two rules share.
#[derive(clap::Args)]
#[command(next_help_heading = "Published rules (quantile, mean-ci)")]
struct Algorithm1Args {
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

#[derive(Clone, Copy, clap::ValueEnum)]
enum RuleName {
    Pooled,
    Quantile,
    MeanCi,
}

impl Args {
    fn question(&self) -> Result<Question, Failure> {
        let estimator = match self.rule {
            RuleName::Pooled => {
                if let Some(flag) = self.algorithm1.given() {
                    return Err(Failure::Usage(format!(
                        "{flag} belongs to the published rules: name --rule mean-ci or quantile, \
                         or leave it out"
                    )));
                }
                let dependence = self.dependence.unwrap_or(CORRELATION);
                Estimator::Pooled(PooledSettings { dependence })
            }
            _ if self.dependence.is_some() => {
                return Err(Failure::Usage(
                    "--dependence belongs to the rule `pooled`: leave it out, or leave --rule out"
                        .into(),
                ));
            }
            RuleName::Quantile => Estimator::Algorithm1(self.algorithm1.settings(Rule::Quantile)),
            RuleName::MeanCi => Estimator::Algorithm1(self.algorithm1.settings(Rule::MeanCi)),
        };
        Ok(Question {
            sources: self.source.clone(),
            surfaces: self.surface.clone(),
            user: self.user.clone(),
            as_time: self.as_time,
            samples: self.samples,
            estimator,
        })
    }
}

impl Algorithm1Args {
    /// The first of these flags that was given.
    fn given(&self) -> Option<&'static str> {
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

    fn settings(&self, rule: Rule) -> Settings {
        let default = Settings::default();
        Settings {
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

/// Runs the command.
pub fn run(args: &Args) -> Done {
    let question = args.question()?;
    let library = super::open(&args.lib)?;
    let steps = show::Steps::new();
    let answer = report(&library, &question, |done, of| steps.show("surfaces", done, of));
    drop(steps);
    let answer = answer.map_err(|error| match error {
        ReportError::Library(error) => Failure::Failed(error.to_string()),
        ReportError::Duration(error) => Failure::Usage(error.to_string()),
        ReportError::Scene(error) => Failure::Usage(error.to_string()),
        ReportError::NoTimeSource => Failure::Failed(format!(
            "{}: {error}; name one with --source and --as-time to take it as a series in time",
            super::shown(&args.lib)
        )),
        ReportError::NotOfTime(_) => Failure::Failed(format!(
            "{}: {error}; --as-time takes it as a series in time all the same",
            super::shown(&args.lib)
        )),
        ReportError::Nothing(problem) => {
            Failure::Failed(format!("{}: {problem}", super::shown(&args.lib)))
        }
    })?;
    if let Some(path) = &args.svg {
        write(path, &figure(&answer.durations, None)?)?;
    }
    if args.json {
        show::json(&answer);
    } else {
        result!("{}", answer.table().trim_end());
        let mut remarks: Vec<_> = answer.durations.iter().flat_map(|d| &d.remarks).collect();
        remarks.sort();
        remarks.dedup();
        for remark in remarks {
            say!("  {remark}");
        }
        show::next(&format!(
            "surfaced plan {} finds out how much of a drag names your surfaces well enough",
            show::quoted(&args.lib)
        ));
    }
    Ok(())
}
