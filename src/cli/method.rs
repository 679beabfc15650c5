//! How trials are compared: by a method and its settings, or by a plan. Also the options for early
//! answers, unknown surfaces and the scan time.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::show::joined;
use super::{Done, Failure, Named, SourceArgs, one_of, parsed, share, show};
use crate::evaluate::plan::Plan;
use crate::recognise::{
    FollowOptions, LeftOutBy, MOST_COUNT, MethodName, MethodSpec, Model, PositionMode,
    ReferenceOptions, Rejection, RejectionError, STAGES, ScanTime, Settling, SumPrecision,
};
use crate::scene::Scene;
use crate::station::Recogniser;

fn methods() -> [Named<MethodName>; MethodName::ALL.len()] {
    MethodName::ALL.map(|method| (method, method.as_str(), method.help()))
}

const POSITIONS: [Named<PositionMode>; 2] = [
    (PositionMode::Shared, "shared", "Once a repetition, the same for every trial; far cheaper"),
    (PositionMode::PerPair, "per-pair", "Anew for every pair of trials, like the authors' program"),
];

/// A method, or (`None`) all of them.
#[derive(Clone, Copy, Debug)]
pub(super) struct OneOrAll(Option<MethodName>);

impl OneOrAll {
    pub(super) fn each() -> impl Iterator<Item = Named<Self>> {
        let one = |(method, name, help)| (Self(Some(method)), name, help);
        methods().into_iter().map(one).chain([(Self(None), "all", "All of them")])
    }

    /// The methods of a list, each once.
    pub(super) fn list(of: &[Self]) -> Vec<MethodName> {
        let is_in = |name: &MethodName| of.iter().any(|one| one.0.is_none_or(|it| it == *name));
        MethodName::ALL.into_iter().filter(is_in).collect()
    }
}

#[derive(Clone, Debug, clap::Args)]
pub(super) struct MethodOptions {
    /// With `reference`: how sample positions are drawn (default: shared)
    #[arg(long, value_parser = one_of(POSITIONS))]
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
    /// Seed of all random draws
    #[arg(long, default_value_t = 1, value_name = "SEED")]
    pub seed: u64,
    /// With `reference`: sum kernels in f64 throughout, which is slower; scores agree to within 1e-4
    #[arg(long)]
    exact: bool,
    /// With `reference`: compare all trials by one repetition, the best 64 by two, the best 16 by all
    #[arg(long)]
    halving: bool,
    /// Neither read nor write the cache of prepared trials beside the library
    #[arg(long)]
    pub no_cache: bool,
}

pub(super) fn at_least_one(text: &str) -> Result<usize, String> {
    let expected = format!("a whole number, 1 or more, at most {MOST_COUNT}");
    parsed(text, |number| (1..=MOST_COUNT).contains(number), expected)
}

impl MethodOptions {
    /// The methods that the user named, or else the one that the given options belong to. Fails if an
    /// option was given that goes with none of them.
    pub(super) fn specs(&self, named: &[MethodName]) -> Done<Vec<MethodSpec>> {
        let counts = [self.n, self.repetitions, self.neighbours];
        let of_reference = counts.iter().any(Option::is_some)
            || self.positions.is_some()
            || self.exact
            || self.halving;
        let default = if of_reference { MethodName::Reference } else { MethodName::Embedding };
        let named = if named.is_empty() { &[default] } else { named };
        if of_reference && !named.contains(&MethodName::Reference) {
            return Err(Failure::Usage(format!(
                "an option was given that goes with --method reference alone, not with {}; see --help",
                show::listed(named.iter().map(|name| name.as_str()))
            )));
        }
        Ok(named.iter().map(|name| self.spec(*name)).collect())
    }

    fn spec(&self, name: MethodName) -> MethodSpec {
        match name {
            MethodName::Reference => MethodSpec::Reference(self.reference_options()),
            other => MethodSpec::from(other).seeded(self.seed).unwrap_or(other.into()),
        }
    }

    pub(super) fn reference_options(&self) -> ReferenceOptions {
        let usual = ReferenceOptions::default();
        ReferenceOptions {
            samples: self.n.unwrap_or(usual.samples),
            repetitions: self.repetitions.unwrap_or(usual.repetitions),
            neighbours: self.neighbours.unwrap_or(usual.neighbours),
            positions: self.positions.unwrap_or(usual.positions),
            seed: self.seed,
            precision: if self.exact { SumPrecision::Oracle } else { SumPrecision::Fast },
            halving: if self.halving { STAGES.to_vec() } else { Vec::new() },
            ..usual
        }
    }
}

/// The options that select a method, with those settings that distinguish methods in charts.
pub(super) fn options_of(method: &MethodSpec) -> String {
    let mut options = format!("--method {}", method.name().as_str());
    if let MethodSpec::Reference(ReferenceOptions { samples, repetitions, halving, .. }) = method {
        options += &format!(" --n {samples} --repetitions {repetitions}");
        if !halving.is_empty() {
            options += " --halving";
        }
    }
    options
}

/// The options that say how a library's trials are compared, and so do not go with a model.
pub(super) fn not_with_model() -> impl Iterator<Item = &'static str> {
    "library sources method n repetitions positions neighbours halving exact seed no_cache plan"
        .split(' ')
}

/// How trials are compared, in commands that name scans: by options or by a plan.
#[derive(clap::Args)]
pub(super) struct ComparingArgs {
    #[command(flatten)]
    sources: SourceArgs,
    /// How trials are compared (default: embedding, or the one whose options are given)
    #[arg(long, value_name = "METHOD", value_parser = one_of(methods()))]
    method: Option<MethodName>,
    #[command(flatten)]
    options: MethodOptions,
    /// Use the method, sources and scan time of this plan, a file written by `surfaced plan`
    #[arg(long, value_name = "FILE", conflicts_with_all = [
        "sources", "method", "n", "repetitions", "positions", "neighbours", "halving", "exact", "seed"
    ])]
    plan: Option<PathBuf>,
}

impl ComparingArgs {
    /// Reads the plan if one is given, and prints its settings; without a plan, uses the options.
    pub(super) fn resolve(&self, query_seconds: Option<f64>) -> Done<Comparing> {
        let MethodOptions { seed, no_cache, .. } = self.options;
        let (sources, cache) = (self.sources.clone(), !no_cache);
        let Some(path) = &self.plan else {
            let method = self.options.specs(self.method.as_slice())?.swap_remove(0);
            return Ok(Comparing { plan: None, sources, method, seed, cache, query_seconds });
        };
        let plan = Plan::read(path).map_err(Failure::usage)?;
        let used = plan.scan_s.map(|s| format!(", first {s} s of the drag")).unwrap_or_default();
        let (names, method) = (joined(&plan.sources, " + "), plan.method.name().as_str());
        say!("plan for {}: {names} by {method}{used}", plan.library);
        let (method, query_seconds) = (plan.method.clone(), plan.scan_s);
        Ok(Comparing { plan: Some(plan), sources, method, seed, cache, query_seconds })
    }
}

#[derive(Clone)]
pub(super) struct Comparing {
    pub plan: Option<Plan>,
    sources: SourceArgs,
    pub method: MethodSpec,
    /// Seed of all random draws.
    pub seed: u64,
    /// Whether prepared trials are cached beside the library.
    cache: bool,
    /// Seconds of each drag that are used; `None` for the whole drag.
    pub query_seconds: Option<f64>,
}

/// How long scans must last, in seconds, and a line with the reason.
pub(super) type Lasting = (Option<f64>, Option<String>);

impl Comparing {
    /// The folder in which prepared trials are cached, which is `folder`; `None` with `--no-cache`.
    pub(super) fn cache_in(&self, folder: &Path) -> Option<PathBuf> {
        self.cache.then(|| folder.to_path_buf())
    }

    /// How long scans must last: as the plan says, if it has a scan time, or else by the model.
    pub(super) fn lasting(&self, accuracy: &AccuracyArgs, model: &Arc<dyn Model>) -> Done<Lasting> {
        if let Some(scan_s) = self.plan.as_ref().and_then(|plan| plan.scan_s) {
            return Ok((Some(scan_s), Some(format!("drag for {scan_s:.1} s, as the plan says"))));
        }
        accuracy.lasting(model)
    }

    /// The scene with only the sources that are compared.
    pub(super) fn narrow(&self, scene: Scene) -> Done<Scene> {
        match &self.plan {
            Some(plan) => scene.only(&plan.sources).map_err(|error| {
                Failure::Usage(format!("the plan needs sources that the data do not have: {error}"))
            }),
            None => self.sources.narrow(scene),
        }
    }
}

#[derive(Clone, Debug, clap::Args)]
pub(super) struct AnswerArgs {
    /// Accuracy that may be lost by giving answers before their scans end (default: 0.01)
    #[arg(long, value_name = "SHARE", value_parser = share)]
    pub settle_loss: Option<f64>,
    /// Share of scans of known surfaces that may be called unknown; 0 calls none unknown (default:
    /// 0.01, or the lowest share that the library's trials support)
    #[arg(long, value_name = "SHARE", value_parser = share_or_none)]
    pub false_rejections: Option<f64>,
}

/// The accuracy that a scan should reach; the scan time follows from it.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct AccuracyArgs {
    /// Share of scans that must be named right by the scan time (default: the share for whole
    /// scans, minus 0.01)
    #[arg(long, value_name = "SHARE", value_parser = share, conflicts_with = "plan")]
    accuracy: Option<f64>,
}

impl AccuracyArgs {
    pub(super) fn is_given(&self) -> bool {
        self.accuracy.is_some()
    }

    /// How long scans must last with this model; nothing if its method cannot tell.
    pub(super) fn lasting(&self, model: &Arc<dyn Model>) -> Done<Lasting> {
        let Some(answer) = model.clone().scan_time(self.accuracy) else {
            let problem = "--accuracy goes with --method embedding, which follows scans";
            return if self.is_given() { Err(Failure::usage(problem)) } else { Ok((None, None)) };
        };
        if self.is_given() {
            honoured(&answer)?;
        }
        Ok((answer.scan_s(), Some(answer.line())))
    }
}

/// Fails if no scan time reaches the accuracy that was asked for.
pub(super) fn honoured(answer: &ScanTime) -> Done {
    answer.scan_s().map(drop).ok_or_else(|| Failure::Failed(answer.reason().unwrap_or_default()))
}

fn share_or_none(text: &str) -> Result<f64, String> {
    if text.parse() == Ok(0.0) { Ok(0.0) } else { share(text) }
}

impl AnswerArgs {
    pub(super) fn loss(&self) -> f64 {
        self.settle_loss.unwrap_or(FollowOptions::default().loss)
    }

    /// Applies these options to a recogniser, whose remarks then say what its answers are based on.
    /// Returns whether it also guesses while a scan is in progress.
    pub(super) fn apply(&self, by: &mut Recogniser) -> Result<bool, RejectionError> {
        if self.false_rejections != Some(0.0) {
            match by.reject_unknown(self.false_rejections) {
                Ok(rejections) => by.library.remarks.extend(on_unknown(&rejections)),
                Err(error) if self.false_rejections.is_some() => return Err(error),
                Err(error) => {
                    let why = format!("unknown surfaces are not detected: {error}");
                    by.library.remarks.push(why);
                }
            }
        }
        let settling = by.calibrate(self.loss());
        by.library.remarks.extend(on_settling(&settling));
        Ok(!settling.is_empty())
    }
}

fn on_unknown(rejections: &[Rejection]) -> Option<String> {
    let least = rejections.iter().min_by_key(|rejection| rejection.trials)?;
    let from = match (least.left_out, least.rate_low.zip(least.rate_high)) {
        (LeftOutBy::Trials, Some(ends)) => {
            let (ends, trials) = (show::ends(ends), least.trials);
            format!("95 % interval {ends}, from {trials} left-out trials; within one session")
        }
        (by, _) => {
            let group = if by == LeftOutBy::People { "person" } else { "session of its people" };
            format!("from {} trials, each {group} left out in turn", least.trials)
        }
    };
    Some(format!(
        "unknown surfaces are detected; on average, at most {} of scans of known surfaces are called \
         unknown by mistake ({from})",
        show::percent(least.rate)
    ))
}

fn on_settling(found: &[Settling]) -> Option<String> {
    let first = found.first()?;
    let ruled: Vec<&Settling> = found.iter().filter(|settling| settling.rule.is_some()).collect();
    if ruled.is_empty() {
        return Some(
            "answers come when scans end; this library has too few trials to answer earlier".into(),
        );
    }
    let mean_s = ruled.iter().map(|settling| settling.scan_s).sum::<f64>() / ruled.len() as f64;
    let unproven = if found.iter().all(|settling| settling.shown) {
        String::new()
    } else {
        format!("; with {} left-out trials, this limit is not proven", first.trials)
    };
    Some(format!(
        "answers settle after {mean_s:.2} s of scan on average, at a cost in accuracy of at most \
         {}{unproven}",
        show::percent(first.stated_loss)
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_of_unknown_is_an_average_and_has_an_interval_within_one_session_alone() {
        let said = |by| on_unknown(&[Rejection::usual(24, by).unwrap()]).unwrap();
        let of_trials = said(LeftOutBy::Trials);
        assert!(of_trials.contains("on average, at most 4.0 %"), "{of_trials}");
        assert!(of_trials.contains("0.0 % to 11.7 %, from 24 left-out trials"), "{of_trials}");
        let of_people = said(LeftOutBy::People);
        assert!(
            of_people.ends_with("(from 24 trials, each person left out in turn)"),
            "{of_people}"
        );
    }
}
