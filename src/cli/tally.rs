//! Prints the results of a replay, for each scan and in total.

use std::collections::{BTreeMap, BTreeSet};

use super::{Done, Failure, say, show};
use crate::evaluate::Share;
use crate::scene::SourceId;
use crate::station::{Answer, AnswerState, Listener, Remark, RemarkKind, StationEvent};

/// Counts of the answers so far.
#[derive(Default)]
pub struct Tally {
    /// Whether to print each answer.
    each: bool,
    total: usize,
    /// Number of remarks by kind and source. Only the first remark of a kind and source is printed.
    remarks: BTreeMap<(RemarkKind, Option<SourceId>), usize>,
    answers: usize,
    /// Share of answers that are right, among those whose truth is known.
    right: Share,
    latencies_ms: Vec<f64>,
    /// The surface named when the answer was settled, by the number of its scan.
    settled: BTreeMap<u32, String>,
    /// Number of scans settled before their end; `right_by_then` takes these as they were settled.
    settled_early: usize,
    right_by_then: Share,
    /// Total seconds of scan until the answers were settled, and total seconds of whole scans.
    used_s: f64,
    whole_s: f64,
    /// Number of confusions by true surface and named surface.
    confused: BTreeMap<(String, String), usize>,
    /// Number of scans of known surfaces that were called unknown.
    rejected: usize,
    /// Share of scans called unknown, among scans of surfaces that the library lacks.
    lacking: Share,
    /// Number of scans from which each source was left out.
    left_out: BTreeMap<SourceId, usize>,
    damages: usize,
    /// Number of scans with too little data to be named.
    too_little: usize,
    spoiled: usize,
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
    /// An empty tally of `total` scans; `each` tells whether each answer is printed.
    pub fn new(each: bool, total: usize) -> Self {
        Self { each, total, ..Self::default() }
    }

    fn answer(&mut self, answer: &Answer) {
        self.answers += 1;
        self.latencies_ms.push(answer.latency_ms);
        self.spoiled += usize::from(!answer.spoiled.is_empty());
        let settled = self.settled.remove(&answer.scan);
        self.settled_early += usize::from(settled.is_some());
        self.used_s += answer.settled_s.unwrap_or(answer.scan_s);
        self.whole_s += answer.scan_s;
        let right = answer.truth.as_ref().map(|truth| is_right(answer, truth, None));
        if let (Some(truth), Some(right)) = (&answer.truth, right) {
            self.right.add(right);
            self.right_by_then.add(is_right(answer, truth, settled.as_ref()));
            self.mistake(answer, truth);
        }
        let flawed = answer.remarks.iter().filter(|remark| remark.kind == RemarkKind::Flaw);
        // A source with a flawed channel may still have been used, so `sources` decides.
        let left_out: BTreeSet<&SourceId> = flawed
            .filter_map(|remark| remark.source.as_ref())
            .filter(|source| !answer.sources.contains(source))
            .collect();
        for source in left_out {
            *self.left_out.entry(source.clone()).or_default() += 1;
        }
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

    fn mistake(&mut self, answer: &Answer, truth: &String) {
        let lacks = answer.ranked.iter().all(|ranked| ranked.surface != *truth);
        match &answer.surface {
            surface if lacks => self.lacking.add(surface.is_none()),
            None => self.rejected += 1,
            Some(surface) if surface != truth => {
                *self.confused.entry((truth.clone(), surface.clone())).or_default() += 1;
            }
            Some(_) => {}
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
            show::longer(answer)
        );
        // Prints the reasons for doubt that no warning has printed. Other states explain themselves.
        let is_known = |why: &&String| {
            answer.spoiled.contains(why) || answer.remarks.iter().any(|remark| remark.text == **why)
        };
        if answer.state == AnswerState::Unsure {
            let news = answer.reasons.iter().filter(|why| !is_known(why));
            news.for_each(|why| say!("        {why}"));
        }
    }

    fn remark(&mut self, remark: &Remark, scan: u32) {
        let count = self.remarks.entry((remark.kind, remark.source.clone())).or_insert(0);
        *count += 1;
        if *count == 1 {
            say!("warning: scan {scan}: {}", remark.text);
        }
    }

    /// Prints and counts a warning that something in use was lost or damaged.
    fn damage(&mut self, text: &str) {
        self.damages += 1;
        say!("warning: {text}");
    }

    pub fn sum_up(&mut self, synthetic: bool) {
        let again: usize = self.remarks.values().map(|count| count - 1).sum();
        if again > 0 {
            say!("({} of these kinds not shown)", show::counted(again, "more warning"));
        }
        if self.answers == 0 {
            return;
        }
        let mark = if synthetic { " (synthetic scene)" } else { "" };
        self.latencies_ms.sort_by(f64::total_cmp);
        let median = self.latencies_ms[self.latencies_ms.len() / 2];
        result!();
        if self.right.of > 0 {
            result!(
                "accuracy {} of {} scans (95 % interval {}){mark}",
                show::percent(self.right.value()),
                self.right.of,
                show::interval(self.right)
            );
        }
        if say::is_verbose() {
            result!(
                "latency  {median:.1} ms from the end of a scan to its answer (median; most is done \
                 during the drag)"
            );
        }
        if self.settled_early > 0 && say::is_verbose() {
            let n = self.answers as f64;
            result!(
                "settled  {} of {} scans before their end; on average {:.2} s of {:.2} s of scan \
                 used{}",
                self.settled_early,
                self.answers,
                self.used_s / n,
                self.whole_s / n,
                match self.right_by_then {
                    Share { of: 0, .. } => String::new(),
                    share => format!("; {} correct by then", show::percent(share.value())),
                }
            );
        }
        for ((truth, surface), count) in &self.confused {
            result!("confused {truth} taken for {surface} in {}", show::counted(*count, "scan"));
        }
        if self.lacking.of > 0 {
            let scans = show::counted(self.lacking.of, "scan");
            result!(
                "unknown  {} of {scans} of new surfaces were called unknown",
                self.lacking.right
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

    /// The result of the command, given that `lost` samples were lost.
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

/// Whether an answer is right; `settled` is the surface named when it settled, and takes
/// precedence. An answer without a surface (unknown) is right if the library lacks the true one.
fn is_right(answer: &Answer, truth: &String, settled: Option<&String>) -> bool {
    match settled.or(answer.surface.as_ref()) {
        Some(surface) => surface == truth,
        None => answer.ranked.iter().all(|ranked| ranked.surface != *truth),
    }
}
