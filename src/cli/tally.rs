//! Prints the results of a replay, for each scan and in total.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use super::{Done, Failure, say, show};
use crate::evaluate::{Share, percentile};
use crate::scene::SourceId;
use crate::station::{Answer, AnswerState, Listener, StationEvent, told};
use crate::trial::Doubt;

/// The answers of a replay so far, and its warnings.
#[derive(Default)]
pub(super) struct Tally {
    each: bool,
    total: usize,
    answers: Vec<Arc<Answer>>,
    /// Number of scans with doubts about a source, or about the scan. Only the first is printed.
    doubted: BTreeMap<Option<SourceId>, usize>,
    damages: usize,
    /// Number of scans with too little data to be named.
    too_little: usize,
}

impl Listener for Tally {
    fn on_event(&mut self, event: &StationEvent) {
        match event {
            StationEvent::Answer(answer) => self.answer(answer),
            StationEvent::Warning(warning) => self.damage(&warning.text),
            StationEvent::Unnamed(answer) => {
                self.too_little += usize::from(answer.doubts.contains(&Doubt::TooLittle));
                self.damage(&answer.not_named());
            }
            _ => {}
        }
    }
}

impl Tally {
    /// An empty tally of `total` scans; `each` tells whether each answer is printed.
    pub(super) fn new(each: bool, total: usize) -> Self {
        Self { each, total, ..Self::default() }
    }

    fn answer(&mut self, answer: &Arc<Answer>) {
        self.answers.push(answer.clone());
        answer.spoiled().for_each(|why| say!("warning: scan {}: {why}", answer.scan));
        told(&answer.doubts).filter(|doubt| doubt.is_remark()).for_each(|doubt| {
            let count = self.doubted.entry(doubt.source().cloned()).or_insert(0);
            *count += 1;
            if *count == 1 {
                say!("warning: scan {}: {doubt}", answer.scan);
            }
        });
        if self.each {
            self.show(answer);
        }
    }

    fn show(&self, answer: &Answer) {
        let right = answer.truth.as_ref().map(|truth| is_right(answer, truth));
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
        let which = match answer.begin_s {
            Some(begin_s) => format!("{begin_s:>7.1} s to {:>7.1} s", begin_s + answer.scan_s),
            None => format!("{:>4}/{}", self.answers.len(), self.total),
        };
        result!(
            "{which}  {:<28} {:<12} {verdict}{}{took}",
            show::named(answer),
            show::certainty(answer),
            show::longer(answer)
        );
        // Prints the reasons for doubt that no warning has printed. Other states explain themselves.
        if answer.state == AnswerState::Unsure {
            let news = answer.reasons().into_iter().filter(|why| !why.spoils() && !why.is_remark());
            news.for_each(|why| say!("        {why}"));
        }
    }

    /// Prints and counts a warning that something in use was lost or damaged.
    fn damage(&mut self, text: &str) {
        self.damages += 1;
        say!("warning: {text}");
    }

    pub(super) fn sum_up(&self, synthetic: bool) {
        let again: usize = self.doubted.values().map(|count| count - 1).sum();
        if again > 0 {
            say!("({} of these kinds not shown)", show::counted(again, "more warning"));
        }
        if self.answers.is_empty() {
            return;
        }
        let mark = if synthetic { " (synthetic scene)" } else { "" };
        let known =
            || self.answers.iter().filter_map(|answer| Some((answer, answer.truth.as_ref()?)));
        let right = Share::count(known().map(|(answer, truth)| is_right(answer, truth)));
        let is_continuous = self.answers.iter().any(|answer| answer.begin_s.is_some());
        let what = if is_continuous { "stretches of one surface" } else { "scans" };
        result!();
        if right.of > 0 {
            // Scans of one person or session are alike, so over several the interval would be too narrow.
            let sittings: BTreeSet<_> =
                known().map(|(answer, _)| (&answer.user, &answer.session)).collect();
            let interval = match sittings.len() {
                1 => format!(" (95 % interval {})", show::ends(right.interval())),
                _ => String::new(),
            };
            let accuracy = show::percent(right.value());
            result!("accuracy {accuracy} of {} {what}{interval}{mark}", right.of);
        }
        if say::is_verbose() {
            let median = percentile(self.answers.iter().map(|a| a.latency_ms).collect(), 0.5);
            result!(
                "latency  {median:.1} ms from the end of a scan to its answer (median; most is done \
                 during the drag)"
            );
        }
        let (mut confused, mut rejected, mut lacking) = (BTreeMap::new(), 0, Share::default());
        for (answer, truth) in known() {
            let lacks = answer.ranked.iter().all(|ranked| ranked.surface != *truth);
            match &answer.surface {
                surface if lacks => lacking.add(surface.is_none()),
                None => rejected += 1,
                Some(surface) if surface != truth => {
                    *confused.entry((truth, surface)).or_insert(0) += 1;
                }
                Some(_) => {}
            }
        }
        for ((truth, surface), count) in confused {
            result!("confused {truth} taken for {surface} in {}", show::counted(count, "scan"));
        }
        if lacking.of > 0 {
            let scans = show::counted(lacking.of, "scan");
            result!("unknown  {} of {scans} of new surfaces were called unknown", lacking.right);
        }
        if rejected > 0 {
            let scans = show::counted(rejected, "scan");
            result!("unknown  {scans} of known surfaces, by mistake: unknown counts as wrong here");
        }
        let mut left_out: BTreeMap<&SourceId, usize> = BTreeMap::new();
        for answer in &self.answers {
            let faults = answer.doubts.iter().filter(|doubt| doubt.is_sensor_fault());
            let sources: BTreeSet<&SourceId> = faults.filter_map(Doubt::source).collect();
            // A source with a flawed channel may still have been used, so `sources` decides.
            for source in sources.into_iter().filter(|source| !answer.sources.contains(source)) {
                *left_out.entry(source).or_default() += 1;
            }
        }
        for (source, count) in left_out {
            let scans = show::counted(count, "scan");
            result!("left out {source} in {scans}: its sensor was dead");
        }
    }

    /// The result of the command, given that `lost` samples were lost.
    pub(super) fn verdict(&self, lost: u64) -> Done {
        let (named, total, damages) = (self.answers.len(), self.total, self.damages);
        if named == 0 && self.too_little == 0 {
            return Err(Failure::Failed("no scan was named; see the warnings above".into()));
        }
        let spoiled = |answer: &&Arc<Answer>| answer.spoiled().next().is_some();
        let spoiled = self.answers.iter().filter(spoiled).count();
        if damages + spoiled > 0 || lost > 0 {
            return Err(Failure::Damaged(format!(
                "{named} of {total} scans named; warnings: {damages}, spoiled scans: {spoiled}, \
                 lost samples: {lost}"
            )));
        }
        Ok(())
    }
}

/// Whether an answer is right. An answer without a surface (unknown) is right if the library lacks the
/// true surface.
fn is_right(answer: &Answer, truth: &String) -> bool {
    match &answer.surface {
        Some(surface) => surface == truth,
        None => answer.ranked.iter().all(|ranked| ranked.surface != *truth),
    }
}
