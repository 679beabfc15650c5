//! Shows the results of a replay, scan by scan and in total.

use std::collections::{BTreeMap, BTreeSet};

use super::{Done, Failure, say, show};
use crate::evaluate::wilson_interval;
use crate::scene::SourceId;
use crate::station::{Answer, AnswerState, Listener, Remark, RemarkKind, StationEvent};

/// Counts of the answers so far.
pub struct Tally {
    /// Whether each answer is shown.
    each: bool,
    total: usize,
    /// Counts of remarks by kind and source; only the first of each is shown.
    remarks: BTreeMap<(RemarkKind, Option<SourceId>), usize>,
    answers: usize,
    with_truth: usize,
    right: usize,
    latencies_ms: Vec<f64>,
    /// The surface named when the answer was settled, by the number of the scan.
    settled: BTreeMap<u32, String>,
    by_then: ByThen,
    notable: Notable,
    damages: usize,
    /// Scans that hold too little to be named.
    too_little: usize,
    spoiled: usize,
}

/// Confusions, unknown surfaces and dead sources, for the summary.
#[derive(Default)]
struct Notable {
    /// Counts of confusions: the true surface, and the one named.
    confused: BTreeMap<(String, String), usize>,
    /// Scans of known surfaces that were called unknown.
    rejected: usize,
    /// Scans of surfaces that the library lacks, and how many of them were called unknown.
    lacking: usize,
    called_unknown: usize,
    /// The number of scans from which each source was left out.
    left_out: BTreeMap<SourceId, usize>,
}

impl Notable {
    fn add(&mut self, answer: &Answer) {
        let flawed = answer.remarks.iter().filter(|remark| remark.kind == RemarkKind::Flaw);
        // A source with a flawed channel may still be used.
        let left_out: BTreeSet<&SourceId> = flawed
            .filter_map(|remark| remark.source.as_ref())
            .filter(|source| !answer.sources.contains(source))
            .collect();
        for source in left_out {
            *self.left_out.entry(source.clone()).or_default() += 1;
        }
        let Some(truth) = &answer.truth else { return };
        let lacks = answer.ranked.iter().all(|ranked| ranked.surface != *truth);
        self.lacking += usize::from(lacks);
        match &answer.surface {
            None if lacks => self.called_unknown += 1,
            None => self.rejected += 1,
            Some(surface) if surface != truth && !lacks => {
                *self.confused.entry((truth.clone(), surface.clone())).or_default() += 1;
            }
            Some(_) => {}
        }
    }

    fn show(&self) {
        for ((truth, surface), count) in &self.confused {
            result!("confused {truth} taken for {surface} in {}", show::counted(*count, "scan"));
        }
        if self.lacking > 0 {
            result!(
                "unknown  {} of {} of new surfaces were called unknown",
                self.called_unknown,
                show::counted(self.lacking, "scan")
            );
        }
        if self.rejected > 0 {
            let scans = show::counted(self.rejected, "scan");
            result!("unknown  {scans} of known surfaces, by mistake");
        }
        for (source, count) in &self.left_out {
            let scans = show::counted(*count, "scan");
            result!("left out {source} in {scans}: its sensor was dead");
        }
    }
}

/// Counts of answers at the time when they were settled, or at the end of their scan.
#[derive(Default)]
struct ByThen {
    settled: usize,
    with_truth: usize,
    right: usize,
    used_s: f64,
    whole_s: f64,
}

impl Listener for Tally {
    fn on_event(&mut self, event: &StationEvent) {
        match event {
            StationEvent::Guess(guess) if guess.settled => {
                if let Some(first) = guess.named.first() {
                    self.settled.entry(guess.scan).or_insert_with(|| first.surface.clone());
                }
            }
            StationEvent::Answer(answer) => self.answer(answer),
            StationEvent::Warning(text) => self.damage(text),
            StationEvent::Unnamed(unnamed) => {
                self.too_little += usize::from(unnamed.too_little);
                self.damage(&unnamed.text);
            }
            _ => {}
        }
    }
}

impl Tally {
    /// An empty tally of `total` scans; `each` says whether each answer is shown.
    pub fn new(each: bool, total: usize) -> Self {
        Self {
            each,
            total,
            remarks: BTreeMap::new(),
            answers: 0,
            with_truth: 0,
            right: 0,
            latencies_ms: Vec::new(),
            settled: BTreeMap::new(),
            by_then: ByThen::default(),
            notable: Notable::default(),
            damages: 0,
            too_little: 0,
            spoiled: 0,
        }
    }

    fn answer(&mut self, answer: &Answer) {
        self.answers += 1;
        self.latencies_ms.push(answer.latency_ms);
        self.spoiled += usize::from(!answer.spoiled.is_empty());
        let right = answer.truth.as_ref().map(|truth| is_right(answer, truth, None));
        self.with_truth += usize::from(right.is_some());
        self.right += usize::from(right == Some(true));
        self.settled_answer(answer);
        self.notable.add(answer);
        for reason in &answer.spoiled {
            say!("warning: scan {}: {reason}", answer.scan);
        }
        for remark in &answer.remarks {
            self.remark(remark, answer.scan);
        }
        if self.each {
            self.show(answer, right);
        }
    }

    fn settled_answer(&mut self, answer: &Answer) {
        let settled = self.settled.remove(&answer.scan);
        let then = &mut self.by_then;
        then.settled += usize::from(settled.is_some());
        then.used_s += answer.settled_s.unwrap_or(answer.scan_s);
        then.whole_s += answer.scan_s;
        if let Some(truth) = &answer.truth {
            then.with_truth += 1;
            then.right += usize::from(is_right(answer, truth, settled.as_ref()));
        }
    }

    fn show(&self, answer: &Answer, right: Option<bool>) {
        let verdict = match (right, &answer.truth) {
            (Some(true), Some(truth)) if answer.surface.is_none() => {
                format!("correct: the library lacks {truth}")
            }
            (Some(true), _) => "correct".to_string(),
            (Some(false), Some(truth)) => format!("wrong, it was {truth}"),
            _ => answer.trial.map_or_else(String::new, |number| format!("(trial {number})")),
        };
        let longer = answer.more_s().map(|s| format!("  (drag {s:.1} s longer)"));
        let took = match say::is_verbose() {
            true => format!("  (answered in {:.1} ms)", answer.latency_ms),
            false => String::new(),
        };
        result!(
            "{:>4}/{}  {:<28} {:<12} {verdict}{}{took}",
            self.answers,
            self.total,
            show::named(answer),
            show::certainty(answer),
            longer.unwrap_or_default()
        );
        // Reasons for doubt that no warning has given; other states explain themselves.
        let is_known = |why: &&String| {
            answer.spoiled.contains(why) || answer.remarks.iter().any(|remark| remark.text == **why)
        };
        if answer.state == AnswerState::Unsure {
            answer
                .reasons
                .iter()
                .filter(|why| !is_known(why))
                .for_each(|why| say!("        {why}"));
        }
    }

    fn remark(&mut self, remark: &Remark, scan: u32) {
        let count = self.remarks.entry((remark.kind, remark.source.clone())).or_insert(0);
        *count += 1;
        if *count == 1 {
            say!("warning: scan {scan}: {}", remark.text);
        }
    }

    /// Shows and counts a warning that something in use was lost or damaged.
    fn damage(&mut self, text: &str) {
        self.damages += 1;
        say!("warning: {text}");
    }

    /// Shows the totals.
    pub fn sum_up(&mut self, synthetic: bool) {
        let again: usize = self.remarks.values().map(|count| count - 1).sum();
        if again > 0 {
            say!("({} of these kinds not shown)", show::counted(again, "more warning"));
        }
        if self.answers == 0 {
            return;
        }
        let mark = if synthetic { " (synthetic scene)" } else { "" };
        let (low, high) = wilson_interval(self.right, self.with_truth);
        self.latencies_ms.sort_by(f64::total_cmp);
        let median = self.latencies_ms[self.latencies_ms.len() / 2];
        result!();
        if self.with_truth > 0 {
            result!(
                "accuracy {} of {} scans (95 % interval {} to {}){mark}",
                show::percent(self.right as f64 / self.with_truth as f64),
                self.with_truth,
                show::percent(low),
                show::percent(high)
            );
        }
        if say::is_verbose() {
            result!(
                "latency  {median:.1} ms from the end of a scan to its answer (median; most is done \
                 during the drag)"
            );
        }
        let then = &self.by_then;
        if then.settled > 0 && say::is_verbose() {
            let n = self.answers as f64;
            result!(
                "settled  {} of {} scans before their end; on average {:.2} s of {:.2} s of scan \
                 used{}",
                then.settled,
                self.answers,
                then.used_s / n,
                then.whole_s / n,
                if then.with_truth > 0 {
                    let share = then.right as f64 / then.with_truth as f64;
                    format!("; {} correct by then", show::percent(share))
                } else {
                    String::new()
                }
            );
        }
        self.notable.show();
    }

    /// The result of the command, after `lost` samples were lost.
    pub fn verdict(&self, lost: u64) -> Done {
        if self.answers == 0 && self.too_little == 0 {
            return Err(Failure::Failed("no scan was named; see the warnings above".into()));
        }
        if self.damages + self.spoiled > 0 || lost > 0 {
            return Err(Failure::Damaged(format!(
                "{} of {} scans named; warnings: {}, spoiled scans: {}, lost samples: {lost}",
                self.answers, self.total, self.damages, self.spoiled
            )));
        }
        Ok(())
    }
}

/// Whether an answer, or the surface that it had settled on, is right. `None` (unknown) is right if
/// the library lacks the true surface.
fn is_right(answer: &Answer, truth: &String, settled: Option<&String>) -> bool {
    match settled.or(answer.surface.as_ref()) {
        Some(surface) => surface == truth,
        None => answer.ranked.iter().all(|ranked| ranked.surface != *truth),
    }
}
