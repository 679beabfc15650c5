//! The results of `surfaced eval`: as JSON, as a table of all queries, and as text.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use super::show::{self, listed};
use super::{Done, Failure, say};
use crate::evaluate::{
    EnrolmentOutcome, Interval, Named, Outcome, Over, Paired, Prediction, SettledOutcome, Share,
    UnknownOutcome, paired,
};
use crate::record::replace_file;
use crate::trial::TrialKey;

/// The JSON document: the outcome, and the data and settings behind it.
#[derive(serde::Serialize)]
pub(super) struct EvalReport {
    #[serde(flatten)]
    pub(super) outcome: Outcome,
    pub(super) protocol: String,
    /// The trials that are left out, and what the accuracy therefore does not say.
    pub(super) left_out: String,
    /// The groups that folds leave out, if these are more than trials.
    #[serde(skip)]
    pub(super) over: Over,
    pub(super) data: String,
    pub(super) synthetic: bool,
    pub(super) query_seconds: Option<f64>,
    /// Present only with `--seeds`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) seeds: Option<Seeds>,
    /// Present only with `--settle`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) settled: Option<SettledOutcome>,
    /// Present only with `--leave-surfaces-out`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) unknown: Option<UnknownOutcome>,
    /// Present only with `--enrolled`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) enrolled: Option<EnrolmentOutcome>,
    /// How many trials of each surface were not asked, since no library without them has it.
    pub(super) not_asked: BTreeMap<String, usize>,
    pub(super) predictions: Vec<EvalAnswer>,
    /// Sources that were left out, and the reasons, a line each.
    pub(super) warnings: Vec<String>,
}

/// Accuracies with several seeds, from `first_seed` on.
#[derive(serde::Serialize)]
pub(super) struct Seeds {
    first_seed: u64,
    accuracies: Vec<f64>,
    mean: f64,
    /// The sample standard deviation (n − 1).
    std: f64,
}

impl Seeds {
    /// At least two accuracies.
    pub(super) fn new(first_seed: u64, accuracies: Vec<f64>) -> Self {
        let all = ndarray::aview1(&accuracies);
        let (mean, std) = (all.sum() / accuracies.len() as f64, all.std(1.0));
        Self { first_seed, accuracies, mean, std }
    }
}

#[derive(serde::Serialize)]
pub(super) struct EvalTable {
    data: String,
    synthetic: bool,
    protocol: String,
    left_out: String,
    methods: Vec<EvalReport>,
    paired: Vec<Paired>,
}

impl EvalTable {
    /// The reports, of which there are several, of methods that named the same queries.
    pub(super) fn new(methods: Vec<EvalReport>) -> Self {
        let all: Vec<_> = methods.iter().map(|one| (&*one.outcome.method, one.named())).collect();
        let first = &methods[0];
        Self {
            data: first.data.clone(),
            synthetic: first.synthetic,
            protocol: first.protocol.clone(),
            left_out: first.left_out.clone(),
            paired: paired(&all, first.over),
            methods,
        }
    }

    pub(super) fn print(&self) {
        let first = &self.methods[0];
        let mark = if self.synthetic { ", on synthetic data" } else { "" };
        let (of, folds) = (first.outcome.share.of, first.outcome.folds.len());
        result!();
        result!("{} · {}: {of} queries{mark}", self.data, self.protocol);
        result!("{}", self.left_out);
        first.print_not_asked();
        let best = self.methods.iter().rev().max_by_key(|one| one.outcome.share.right);
        let best = best.map_or("", |one| &*one.outcome.method);
        let against = |method: &str| {
            let pair = |p: &&Paired| {
                p.methods.iter().all(|name| name == best || name == method) && method != best
            };
            self.paired.iter().find(pair).map_or("-".into(), |p| p_value(p.p_value_holm))
        };
        let rows = self.methods.iter().map(|one| {
            let Outcome { method, share, interval, log_loss, .. } = &one.outcome;
            let interval = [interval.low, interval.high].map(show::percent).join(" to ");
            let loss = log_loss.map_or("-".into(), |loss| format!("{loss:.2}"));
            let accuracy = show::percent(share.value());
            vec![method.clone(), accuracy, interval, loss, against(method)]
        });
        let head = format!(">p against {best}");
        show::table(&["method", ">accuracy", "95 % interval", ">log loss", &head], rows);
        result!("intervals  {}", over_words(first.outcome.interval.over, folds));
        let pairs = show::counted(self.paired.len(), "pair");
        let test = match self.paired.first().map_or(Over::Queries, |pair| pair.test_over) {
            Over::Queries => "McNemar's exact test over queries".into(),
            over => {
                // Even if all of n groups favour one method, p is 2 / 2^n.
                let least = p_value(0.5f64.powi(folds as i32 - 1));
                format!("exact sign test over {folds} {}, at best {least}", over.plural())
            }
        };
        result!("p          {test}, with Holm's correction for {pairs}");
        self.methods.iter().for_each(EvalReport::print_seeds);
        if say::is_verbose() {
            let rows =
                self.paired.iter().map(|Paired { methods, only_right, p_value_holm, .. }| {
                    let [a, b] = only_right.map(|count| count.to_string());
                    vec![methods.join(" : "), a, b, p_value(*p_value_holm)]
                });
            result!();
            show::table(&["pair", ">only the first", ">only the second", ">p"], rows);
        }
    }
}

fn p_value(p: f64) -> String {
    if p < 1e-4 { "< 0.0001".into() } else { format!("{p:.4}") }
}

/// The scans that an interval is for, and how many groups it comes from.
fn over_words(over: Over, folds: usize) -> String {
    let by = if over == Over::Queries { String::new() } else { format!(", by {folds}") };
    format!("{}{by}", show::over(over))
}

/// Writes a row for each query, as CSV. Columns `p: SURFACE` hold the probabilities.
pub(super) fn write_predictions(reports: &[EvalReport], path: &Path) -> Done<()> {
    let labels = reports.iter().flat_map(|report| &report.outcome.confusion.labels);
    let surfaces: BTreeSet<&str> = labels.map(String::as_str).collect();
    let mut table = csv::Writer::from_writer(Vec::new());
    let head =
        "method path person trial session fold truth answer margin confidence p_value".split(' ');
    let head = head.map(String::from).chain(surfaces.iter().map(|name| format!("p: {name}")));
    let of = |report: &EvalReport| -> Vec<Vec<String>> {
        let method = &report.outcome.method;
        report.predictions.iter().map(|one| one.cells(method, &surfaces)).collect()
    };
    let written = std::iter::once(head.collect())
        .chain(reports.iter().flat_map(of))
        .try_for_each(|row: Vec<String>| table.write_record(row));
    let written = written.map_err(std::io::Error::from);
    let bytes = written.and_then(|()| table.into_inner().map_err(|error| error.into_error()));
    let bytes = bytes.map_err(|error| Failure::at(path, error))?;
    replace_file(path, &bytes)?;
    show::wrote(&[path]);
    Ok(())
}

#[derive(serde::Serialize)]
pub(super) struct EvalAnswer {
    /// Folder of the trial; `None` in feature tables.
    path: Option<String>,
    truth: String,
    user: String,
    trial: u32,
    session: Option<String>,
    /// Name of the person, session or trial that was left out.
    fold: String,
    answer: String,
    margin: f64,
    confidence: Option<f64>,
    p_value: Option<f64>,
    /// Of each surface of the library; empty if the method gives none.
    probabilities: BTreeMap<String, f64>,
}

impl EvalAnswer {
    pub(super) fn new(fold: String, of: Prediction) -> Self {
        let TrialKey { surface: truth, user, number: trial, session } = of.key;
        Self {
            path: None,
            truth,
            user,
            trial,
            session,
            fold,
            answer: of.surface,
            margin: of.margin,
            confidence: of.confidence,
            p_value: of.p_value,
            probabilities: of.probabilities.into_iter().collect(),
        }
    }

    fn cells(&self, method: &str, surfaces: &BTreeSet<&str>) -> Vec<String> {
        let number = |value: Option<f64>| value.map(|x| x.to_string()).unwrap_or_default();
        let text = |text: &Option<String>| text.clone().unwrap_or_default();
        let (trial, margin) = (self.trial.to_string(), self.margin.to_string());
        let known = [text(&self.path), self.user.clone(), trial, text(&self.session)];
        let named = [self.fold.clone(), self.truth.clone(), self.answer.clone(), margin];
        let stated = [number(self.confidence), number(self.p_value)];
        let of = surfaces.iter().map(|name| number(self.probabilities.get(*name).copied()));
        [method.into()].into_iter().chain(known).chain(named).chain(stated).chain(of).collect()
    }
}

impl EvalReport {
    pub(super) fn name_trials(&mut self, names: &BTreeMap<&TrialKey, String>) {
        for one in &mut self.predictions {
            let key = TrialKey::new(&one.truth, &one.user, one.trial);
            one.path = names.get(&key.with_session(one.session.clone())).cloned();
        }
    }

    pub(super) fn print(&self) {
        let Outcome { share, method, classes, library_trials, .. } = &self.outcome;
        let Outcome { query_ms_p50, query_ms_p99, confusion, never_queried, .. } = &self.outcome;
        let percent = show::percent;
        let mark = if self.synthetic { ", on synthetic data" } else { "" };
        result!();
        let (accuracy, right, of) = (percent(share.value()), share.right, share.of);
        let among = match self.outcome.candidates {
            [least, most] if least == most => most.to_string(),
            [least, most] => format!("{least} to {most}"),
        };
        result!("accuracy   {accuracy} ({right} of {of} queries, each among {among} surfaces)");
        let Interval { low, high, over } = self.outcome.interval;
        let folds = self.outcome.folds.len();
        let over = over_words(over, folds);
        result!("           95 % interval {} to {} {over}", percent(low), percent(high));
        let sources = listed(&self.outcome.sources);
        result!("           {} · {method} · {sources}{mark}", self.protocol);
        result!("           {}", self.left_out);
        if self.over == Over::People {
            let users = show::counted(self.outcome.folds.len(), "user");
            let std = self.outcome.accuracy_std.map(|std| format!(" ± {}", percent(std)));
            let mean = percent(self.outcome.accuracy_mean);
            result!("           mean over {users}: {mean}{}", std.unwrap_or_default());
        }
        self.print_seeds();
        self.print_stated();
        // Intervals over queries would contradict one over people.
        let is_over_queries = self.outcome.interval.over == Over::Queries;
        let interval = |share: Share| {
            Some(format!("95 % interval {}", show::ends(share.interval())))
                .filter(|_| is_over_queries)
        };
        self.enrolled.iter().for_each(|enrolled| print_enrolled(enrolled, interval));
        let surfaces = show::counted(*classes, "surface");
        let trials = show::counted(*library_trials, "library trial");
        result!("           {surfaces} against {trials}");
        if !never_queried.is_empty() {
            result!("           never queried: {}", never_queried.join(", "));
        }
        self.print_not_asked();
        if say::is_verbose() {
            self.print_surfaces();
            result!("precision  {}", percent(self.outcome.precision_mean));
            result!(
                "query      {query_ms_p50:.1} ms from raw samples to the answer (median), \
                 {query_ms_p99:.1} ms (p99)"
            );
        }
        for (truth, answer, count) in confusion.worst(5) {
            result!("           {count} × {truth} taken for {answer}");
        }
        self.settled.iter().for_each(print_settled);
        self.unknown.iter().for_each(|unknown| print_unknown(unknown, interval));
    }

    pub(super) fn names_any(&self) -> bool {
        self.predictions.iter().any(|one| !one.answer.is_empty())
    }

    fn named(&self) -> Named<'_> {
        let right = |one: &EvalAnswer| one.answer == one.truth;
        self.predictions.iter().map(|one| (&*one.fold, right(one))).collect()
    }

    fn print_not_asked(&self) {
        let of = listed(self.not_asked.iter().map(|(surface, n)| format!("{surface} ({n})")));
        if !of.is_empty() {
            result!("           not asked, since no library without them has their surface: {of}");
        }
    }

    fn print_seeds(&self) {
        if let Some(Seeds { first_seed, accuracies, mean, std }) = &self.seeds {
            let last = first_seed.wrapping_add(accuracies.len() as u64 - 1);
            let (mean, std) = (show::percent(*mean), show::percent(*std));
            let method = &self.outcome.method;
            result!("seeds      {first_seed} to {last}, {method}: {mean} ± {std}");
        }
    }

    /// Prints the mean confidence that the answers state, and their log loss.
    fn print_stated(&self) {
        let stated = self.predictions.iter().filter_map(|one| one.confidence);
        let (sum, count) = stated.fold((0.0, 0), |(sum, count), p| (sum + p, count + 1));
        if let (Some(loss), true) = (self.outcome.log_loss, count > 0) {
            let mean = show::percent(sum / f64::from(count));
            result!("           the answers state {mean} on average; log loss {loss:.2}");
        }
    }

    fn print_surfaces(&self) {
        let rows = self.outcome.surfaces.iter().map(|one| {
            let share = |share: Option<f64>| share.map_or("-".into(), show::percent);
            let [recall, precision, f1] = [one.recall, one.precision, one.f1].map(share);
            vec![one.surface.clone(), one.queries.to_string(), recall, precision, f1]
        });
        show::table(&["surface", ">queries", ">recall", ">precision", ">F1"], rows);
    }
}

fn print_enrolled(e: &EnrolmentOutcome, interval: impl Fn(Share) -> Option<String>) {
    let (trials, points) = (show::counted(e.trials, "trial"), 100.0 * e.gain);
    let (without, interval) = (show::percent(e.without.value()), in_brackets(interval(e.without)));
    result!(
        "enrolled   {trials} of each surface by the user: {points:+.1} points; without, {without} of \
         the same queries{interval}"
    );
}

fn print_settled(s: &SettledOutcome) {
    let SettledOutcome { lost, gained, scan_s_mean, scan_s_p50, whole_s_mean, .. } = s;
    let [share, whole, loss] =
        [s.share.value(), s.accuracy_whole, s.stated_loss].map(show::percent);
    let interval = show::ends((s.interval.low, s.interval.high));
    result!(
        "settled    {share} (95 % interval {interval}) against {whole} by whole scans: {lost} lost, \
         {gained} gained"
    );
    result!(
        "           after {scan_s_mean:.2} s on average ({scan_s_p50:.2} s in the median) of \
         {whole_s_mean:.2} s; {} of {} scans settled before they ended",
        s.settled,
        s.queries
    );
    let (shown, folds) = (s.rules.iter().filter(|rule| rule.shown).count(), s.rules.len());
    result!(
        "           stated loss {loss} at most, shown (at 90 %) by the libraries of {shown} of \
         {folds} folds"
    );
    if let Some(share) = s.core_share {
        result!("           following takes {} of one core", show::percent(share));
    }
}

fn print_unknown(u: &UnknownOutcome, interval: impl Fn(Share) -> Option<String>) {
    let [caught, rejected] = [u.unknown, u.known].map(|share| show::percent(share.value()));
    let [of_caught, of_rejected] = [u.unknown, u.known].map(|share| in_brackets(interval(share)));
    let (unknown, known, trials) = (u.unknown.of, u.known.of, u.stated.trials);
    result!("unknown    {caught} of {unknown} queries of left-out surfaces caught{of_caught}");
    let ends = u.stated.rate_low.zip(u.stated.rate_high);
    let ends = ends.map_or(String::new(), |ends| format!("{}, ", show::ends(ends)));
    result!(
        "           {rejected} of {known} queries of known ones rejected{of_rejected}; stated {} \
         ({ends}by {trials} left-out trials)",
        show::percent(u.stated.rate)
    );
    if let Some(as_stated) = u.folds_as_stated {
        result!(
            "           in {as_stated} of {} folds the share rejected lies in the interval stated there",
            u.folds
        );
    }
}

fn in_brackets(text: Option<String>) -> String {
    text.map_or(String::new(), |text| format!(" ({text})"))
}
