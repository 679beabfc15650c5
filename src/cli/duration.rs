//! `surfaced duration`: how long to drag, and T* for each surface and source of a library.

use std::path::PathBuf;

use serde::Serialize;

use super::condition::WhereArgs;
use super::figure::{LookArgs, can_draw, draw};
use super::method::{at_least_one, honoured};
use super::show::Made;
use super::{Done, Failure, bad_files, say, share, show};
use crate::independence::{
    AccuracyCurve, Algorithm1Settings, CORRELATION, DurationReport, Estimator, PooledSettings,
    Question, ReportError, Rule, figure, report,
};
use crate::kernel::Threshold;
use crate::library::{Entry, Library};
use crate::recognise::{
    Goal, LeftOutAccuracy, MethodName, MethodSpec, RecogniseError, ScanTime, ready_model,
};
use crate::scene::SourceId;

/// Find how long to drag, and T*, the minimum time between independent samples
///
/// How long to drag: the shortest time after which the library's own trials, each left out in turn,
/// are named with the wanted accuracy. T*: how far apart in time two samples of a drag must lie to be
/// independent.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced duration lib\n  \
                        surfaced duration lib --accuracy 0.99\n  \
                        surfaced duration lib --source ir --surface G7EPDMFoam --out foam.svg\n  \
                        surfaced duration LMT_108_SurfaceMaterials_Database --source mi2\n  \
                        surfaced duration lib --source ir --rule mean-ci --draws 200\n\nTime: 6 s for LMT108's 200 dragging sounds, on two cores")]
pub(super) struct Args {
    /// A library, or any recordings that `eval` reads
    lib: PathBuf,
    /// Sources, with commas between them (default: all for the scan time; for T*, all that are
    /// recorded while dragging, or with a published rule those of domain `time`)
    #[arg(long, value_delimiter = ',', value_name = "ID,…", value_parser = SourceId::new)]
    source: Vec<SourceId>,
    /// Share of scans that must be named right (default: the share for whole scans, minus 0.01)
    #[arg(long, value_name = "SHARE", value_parser = share)]
    accuracy: Option<f64>,
    /// Surfaces that T* is found for, with commas between them (default: all)
    #[arg(long, value_delimiter = ',', value_name = "NAME,…")]
    surface: Vec<String>,
    /// User whose trials are used (default: all; for T*, the user with the most trials of a
    /// surface)
    #[arg(long, value_name = "NAME")]
    user: Option<String>,
    #[command(flatten)]
    only: WhereArgs,
    /// Let a published rule treat the named sources as time series, whatever their domain is
    /// (`pooled` always does)
    #[arg(long, requires = "source")]
    as_time: bool,
    /// How T* is found: by the size of the dependence over all pairs of all trials, or by the
    /// paper's Algorithm 1. Its bound is a quantile of its HSIC values (as printed), or the upper
    /// end of the interval of their mean (the authors' program)
    #[arg(long, value_enum, default_value_t = RuleName::Pooled)]
    rule: RuleName,
    /// Largest dependence that counts as none, as the correlation of a Gaussian process (`pooled`;
    /// default 0.1)
    #[arg(long, value_name = "CORRELATION")]
    dependence: Option<f64>,
    /// Number of independent samples that a scan must yield
    #[arg(long, default_value_t = 400, value_name = "N", value_parser = at_least_one)]
    samples: usize,
    /// Draw the dependence against the lag, and the accuracy against the scan time, as SVG or, named
    /// .pdf, as PDF
    #[arg(long, alias = "svg", value_name = "FILE")]
    out: Option<PathBuf>,
    #[command(flatten)]
    look: LookArgs,
    /// Print one JSON document on stdout
    #[arg(long)]
    json: bool,
    // This is the last field, since the help lists all later options under its heading.
    #[command(flatten)]
    algorithm1: Option<Algorithm1Args>,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum RuleName {
    Pooled,
    Quantile,
    MeanCi,
}

impl Args {
    fn question(&self) -> Done<Question> {
        let published = self.algorithm1.clone().unwrap_or_default();
        let estimator = match self.rule {
            RuleName::Pooled if self.algorithm1.is_some() => {
                return Err(Failure::usage(
                    "an option of the published rules was given: name --rule mean-ci or quantile, \
                     or leave it out; see --help",
                ));
            }
            RuleName::Pooled => {
                let dependence = self.dependence.unwrap_or(CORRELATION);
                Estimator::Pooled(PooledSettings { dependence })
            }
            _ if self.dependence.is_some() => {
                return Err(Failure::usage(
                    "--dependence belongs to the rule `pooled`: leave it out, or leave --rule out",
                ));
            }
            RuleName::Quantile => Estimator::Algorithm1(published.settings(Rule::Quantile)),
            RuleName::MeanCi => Estimator::Algorithm1(published.settings(Rule::MeanCi)),
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

#[derive(Serialize)]
struct DurationDocument<'a> {
    #[serde(flatten)]
    report: &'a DurationReport,
    answer: &'a ScanTime,
}

/// Settings of Algorithm 1, shared by its two rules.
#[derive(Clone, Default, clap::Args)]
#[command(next_help_heading = "Published rules (quantile, mean-ci)")]
struct Algorithm1Args {
    /// Number of starts drawn for each lag, R (default 500)
    #[arg(long, value_name = "R", value_parser = at_least_one)]
    draws: Option<usize>,
    /// Latest start t1,max, in samples (default 20000)
    #[arg(long, value_name = "SAMPLES", value_parser = at_least_one)]
    latest_start: Option<usize>,
    /// Largest lag to try, in samples (default 1000)
    #[arg(long, value_name = "SAMPLES", value_parser = at_least_one)]
    largest_lag: Option<usize>,
    /// Significance level of κ (default 0.05)
    #[arg(long, value_name = "ALPHA")]
    alpha: Option<f64>,
    /// Number of permutations for each κ (default 100)
    #[arg(long, value_name = "COUNT", value_parser = at_least_one)]
    permutations: Option<usize>,
    /// Compute κ from exact permutation moments, which is faster than permutations
    #[arg(long, conflicts_with = "permutations")]
    gamma: bool,
    /// Try every lag in ascending order, not a coarse grid that is refined
    #[arg(long)]
    exhaustive: bool,
    /// Stop at the first lag, as Algorithm 1 is printed, even if dependence returns beyond it
    #[arg(long)]
    first: bool,
    /// Seed of all random draws (default 1)
    #[arg(long, value_name = "SEED")]
    seed: Option<u64>,
}

impl Algorithm1Args {
    fn settings(&self, rule: Rule) -> Algorithm1Settings {
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

pub(super) fn run(args: &Args) -> Done {
    let question = args.question()?;
    args.out.as_deref().map_or(Ok(()), can_draw)?;
    let library = args.only.open(&args.lib)?;
    let (found, by_time, digest) = bad_files::work(&args.lib, library, |library| {
        let found = report(library, &question, |done, of| say::progress("surfaces", done, of));
        let found = found.map_err(|error| args.failure(error))?;
        match args.by_time(library) {
            Err(RecogniseError::Library(error)) => Err(error.into()),
            by_time => {
                let digest = if args.json { library.digest() } else { String::new() };
                Ok((found, by_time, digest))
            }
        }
    })?;
    let goal = Goal::wanted(args.accuracy);
    // Trials that cannot be compared may still have a T*, so this error does not end the command.
    let (answer, points) = match &by_time {
        Ok(found) => (found.scan_time(goal), found.points()),
        Err(error) => (ScanTime::without_model(goal, error.to_string()), Vec::new()),
    };
    if let Some(path) = &args.out {
        let curve = AccuracyCurve { points, target: answer.target, enough_s: answer.scan_s() };
        let data = (found.library.as_str(), found.synthetic);
        draw(path, &figure(&found.durations, Some(&curve), data, args.look.into())?)?;
        show::wrote(&[path]);
    }
    let refused = args.accuracy.map_or(Ok(()), |_| honoured(&answer));
    if args.json {
        let seed = args.algorithm1.as_ref().and_then(|published| published.seed).unwrap_or(1);
        let of = DurationDocument { report: &found, answer: &answer };
        show::json(&Made::new(of, seed, digest));
        return refused;
    }
    if refused.is_ok() {
        result!("{}", answer.line());
    }
    let is_published = matches!(found.settings, Estimator::Algorithm1(_));
    result!("{}", found.in_words(answer.scan_s()).trim_end());
    if say::is_verbose() || is_published {
        result!("\n{}", found.table().trim_end());
        let mut remarks: Vec<_> = found.durations.iter().flat_map(|d| &d.remarks).collect();
        remarks.sort();
        remarks.dedup();
        remarks.iter().for_each(|remark| say!("  {remark}"));
    } else {
        say!("--verbose shows the samples of each surface and source");
    }
    refused?;
    show::next(&format!(
        "surfaced plan {} finds the cheapest sources, scan time and method for these surfaces",
        show::quoted(&args.lib)
    ));
    Ok(())
}

impl Args {
    /// The accuracy of left-out trials at each scan time, using the sources and the user given by
    /// the arguments.
    fn by_time(&self, library: &Library) -> Result<LeftOutAccuracy, RecogniseError> {
        let mut scene = library.scene.clone();
        if !self.source.is_empty() {
            // `report` has checked that the library has these sources, so the default is not used.
            scene = scene.clone().only(&self.source).unwrap_or(scene);
        }
        let is_wanted = |entry: &Entry| {
            !entry.sources.is_empty()
                && self.user.as_ref().is_none_or(|user| *user == entry.key.user)
        };
        let entries: Vec<Entry> =
            library.entries.iter().map(|e| e.clone().within(&scene)).filter(is_wanted).collect();
        let method = MethodSpec::from(MethodName::Embedding).build(&scene);
        let all = (0..entries.len()).collect();
        let step = |done, of| say::progress("preparing the library", done, of);
        let ready = ready_model(&*method, &entries, &all, Some(&self.lib), &step)?;
        Ok(ready.model.embedding().map(|model| model.left_out_accuracy()).unwrap_or_default())
    }

    fn failure(&self, error: ReportError) -> Failure {
        match error {
            ReportError::Nothing(problem) => Failure::at(&self.lib, problem),
            ReportError::Library(error) => error.into(),
            ReportError::Duration(_) | ReportError::Scene(_) => Failure::usage(error),
        }
    }
}
