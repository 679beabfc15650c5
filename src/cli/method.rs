//! How trials are compared: the method and its settings, or a plan that names them.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::ValueEnum;
use clap::builder::PossibleValue;

use super::answers::AccuracyArgs;
use super::{Failure, SourceArgs};
use crate::evaluate::plan::Plan;
use crate::recognise::{
    EmbeddingOptions, MOST_COUNT, MethodName, MethodSpec, Model, PositionMode, ReferenceOptions,
    STAGES, ScanTime, SumPrecision, TreeOptions,
};
use crate::scene::Scene;

impl ValueEnum for MethodName {
    fn value_variants<'a>() -> &'a [Self] {
        &Self::ALL
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        Some(PossibleValue::new(self.as_str()).help(self.help()))
    }
}

impl ValueEnum for PositionMode {
    fn value_variants<'a>() -> &'a [Self] {
        &[Self::Shared, Self::PerPair]
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        Some(match self {
            Self::Shared => {
                PossibleValue::new("shared").help("Once a repetition, for the whole library")
            }
            Self::PerPair => PossibleValue::new("per-pair")
                .help("Anew for each pair of trials, as the authors' program does"),
        })
    }
}

/// Settings of a method.
#[derive(Clone, Debug, clap::Args)]
pub struct MethodArgs {
    /// How trials are compared (default: embedding, or the one whose options are given)
    #[arg(long, value_enum, value_name = "METHOD")]
    method: Option<MethodName>,
    /// With `reference`: how sample positions are drawn (default: shared)
    #[arg(long, value_enum)]
    positions: Option<PositionMode>,
    /// With `reference`: samples drawn from a source, n (default: 400)
    #[arg(long, value_name = "N", value_parser = at_least_one)]
    n: Option<usize>,
    /// With `reference`: repetitions whose scores are averaged, R (default: 10)
    #[arg(long, value_name = "R", value_parser = at_least_one)]
    repetitions: Option<usize>,
    /// With `reference`: nearest library trials that vote, k (default: 1)
    #[arg(long, value_name = "K", value_parser = at_least_one)]
    neighbours: Option<usize>,
    /// Seed of everything that is drawn at random
    #[arg(long, default_value_t = 1, value_name = "SEED")]
    seed: u64,
    /// With `reference`: sum kernels in f64 throughout: slower, and equal to within 1e-4 of a score
    #[arg(long)]
    exact: bool,
    /// With `reference`: compare all trials by one repetition, the best 64 by two, the best 16 by all
    #[arg(long)]
    halving: bool,
    /// With `reference`: do not tabulate library sums: quicker to prepare, slower to compare
    #[arg(long)]
    no_tables: bool,
    /// Neither read nor write the cache of prepared trials beside the library
    #[arg(long)]
    no_cache: bool,
}

/// Parses a count.
pub fn at_least_one(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(number) if (1..=MOST_COUNT).contains(&number) => Ok(number),
        _ => Err(format!("expected a whole number, 1 or more, at most {MOST_COUNT}")),
    }
}

impl MethodArgs {
    /// The method that was asked for, by name or by options that it alone has.
    fn name(&self) -> Result<MethodName, Failure> {
        let counts = [self.n, self.repetitions, self.neighbours];
        let of_reference = counts.iter().any(Option::is_some)
            || self.positions.is_some()
            || self.exact
            || self.halving
            || self.no_tables;
        match self.method {
            None if of_reference => Ok(MethodName::Reference),
            None => Ok(MethodName::Embedding),
            Some(other) if of_reference && other != MethodName::Reference => {
                Err(Failure::Usage(format!(
                    "an option was given that goes with --method reference alone, not with {}; \
                     see --help",
                    other.as_str()
                )))
            }
            Some(name) => Ok(name),
        }
    }

    /// The method that was asked for.
    ///
    /// # Errors
    /// Wrong usage, if options of different methods are given.
    pub fn spec(&self) -> Result<MethodSpec, Failure> {
        let trees = TreeOptions { seed: self.seed };
        Ok(match self.name()? {
            MethodName::Reference => MethodSpec::Reference(self.reference_options()),
            MethodName::Embedding => MethodSpec::Embedding(EmbeddingOptions { seed: self.seed }),
            MethodName::Adaboost => MethodSpec::Adaboost(trees),
            MethodName::RandomForest => MethodSpec::RandomForest(trees),
            other => other.into(),
        })
    }

    /// The method of a plan; settings that a plan leaves open are taken from these arguments.
    pub fn planned(&self, plan: &MethodSpec) -> MethodSpec {
        match plan {
            MethodSpec::Reference(ReferenceOptions { samples, repetitions, .. }) => {
                let (samples, repetitions) = (*samples, *repetitions);
                let open = self.reference_options();
                MethodSpec::Reference(ReferenceOptions { samples, repetitions, ..open })
            }
            other => other.clone(),
        }
    }

    /// Whether no method was chosen.
    pub fn is_default(&self) -> bool {
        self.method.is_none() && self.name().is_ok_and(|name| name == MethodName::Embedding)
    }

    /// Whether prepared trials are kept beside their library.
    pub fn uses_cache(&self) -> bool {
        !self.no_cache
    }

    /// The settings of `reference`.
    pub fn reference_options(&self) -> ReferenceOptions {
        let usual = ReferenceOptions::default();
        ReferenceOptions {
            samples: self.n.unwrap_or(usual.samples),
            repetitions: self.repetitions.unwrap_or(usual.repetitions),
            neighbours: self.neighbours.unwrap_or(usual.neighbours),
            positions: self.positions.unwrap_or(usual.positions),
            seed: self.seed,
            precision: if self.exact { SumPrecision::Oracle } else { SumPrecision::Fast },
            tabulate: !self.no_tables,
            halving: if self.halving { STAGES.to_vec() } else { Vec::new() },
        }
    }
}

/// The options that select a method, with the settings by which charts distinguish methods.
pub fn options_of(method: &MethodSpec) -> String {
    let mut options = format!("--method {}", method.name().as_str());
    if let MethodSpec::Reference(ReferenceOptions { samples, repetitions, halving, .. }) = method {
        options += &format!(" --n {samples} --repetitions {repetitions}");
        if !halving.is_empty() {
            options += " --halving";
        }
    }
    options
}

/// How trials are compared, by options or by a plan, in commands that name scans.
#[derive(clap::Args)]
pub struct ComparingArgs {
    #[command(flatten)]
    sources: SourceArgs,
    #[command(flatten)]
    method: MethodArgs,
    /// Compare with the method, sources and scan time of this plan, a file by `surfaced plan`
    #[arg(long, value_name = "FILE", conflicts_with_all = [
        "sources", "method", "n", "repetitions", "positions", "neighbours",
        "halving"
    ])]
    plan: Option<PathBuf>,
}

impl ComparingArgs {
    /// Reads the plan, if one is given, and says so; otherwise takes the other arguments.
    ///
    /// # Errors
    /// Wrong usage, if the plan cannot be read.
    pub fn resolve(&self, query_seconds: Option<f64>) -> Result<Comparing, Failure> {
        let (sources, cache) = (self.sources.clone(), self.method.uses_cache());
        let Some(path) = &self.plan else {
            let method = self.method.spec()?;
            return Ok(Comparing { plan: None, sources, method, cache, query_seconds });
        };
        let plan = Plan::read(path).map_err(|error| Failure::Usage(error.to_string()))?;
        let names: Vec<&str> = plan.sources.iter().map(|id| id.as_str()).collect();
        let used = plan.scan_s.map(|s| format!(", first {s} s of the drag")).unwrap_or_default();
        say!(
            "plan for {}: {} by {}{used}",
            plan.library,
            names.join(" + "),
            plan.method.name().as_str()
        );
        let (method, query_seconds) = (self.method.planned(&plan.method), plan.scan_s);
        Ok(Comparing { plan: Some(plan), sources, method, cache, query_seconds })
    }
}

/// The way scans are compared.
#[derive(Clone)]
pub struct Comparing {
    /// The plan, if one is given.
    pub plan: Option<Plan>,
    sources: SourceArgs,
    /// The method.
    pub method: MethodSpec,
    /// Whether prepared trials are kept beside the library.
    cache: bool,
    /// Seconds of each drag that are used, if not all.
    pub query_seconds: Option<f64>,
}

impl Comparing {
    /// `folder`, where prepared trials are cached beside the library; `None` with `--no-cache`.
    pub fn cache_in(&self, folder: &Path) -> Option<PathBuf> {
        self.cache.then(|| folder.to_path_buf())
    }

    /// How long scans must last, in seconds, and the reason in a line: by the plan if it says so,
    /// else by the model of the library.
    ///
    /// # Errors
    /// If the library cannot reach the accuracy that was asked for.
    pub fn lasting(
        &self,
        accuracy: &AccuracyArgs,
        model: &Arc<dyn Model>,
    ) -> Result<(Option<f64>, Option<String>), Failure> {
        if let Some(scan_s) = self.plan.as_ref().and_then(|plan| plan.scan_s) {
            return Ok((Some(scan_s), Some(format!("drag for {scan_s:.1} s, as the plan says"))));
        }
        let found = accuracy.scan_time(model)?;
        Ok((found.as_ref().and_then(ScanTime::scan_s), found.map(|answer| answer.line())))
    }

    /// The scene with the sources that are compared.
    ///
    /// # Errors
    /// Wrong usage, if the scene lacks one.
    pub fn narrow(&self, scene: Scene) -> Result<Scene, Failure> {
        match &self.plan {
            Some(plan) => plan.narrow(scene).map_err(|error| Failure::Usage(error.to_string())),
            None => self.sources.narrow(scene),
        }
    }
}
