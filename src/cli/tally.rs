//! What came of a replay, scan by scan and in all: for people on stderr, as JSON on stdout.

use std::collections::BTreeMap;
use std::time::Instant;

use super::need::Needs;
use super::{Done, Failure, show};
use crate::evaluate::wilson_interval;
use crate::recognise::{RankedSurface, Ranking};
use crate::scan::Scan;
use crate::scene::SourceId;
use crate::trial::{Signal, TrialKey, flaws};

/// One line of JSON: a scan and its answer.
#[derive(serde::Serialize)]
struct Line<'a> {
    scan: u32,
    surface: &'a str,
    truth: Option<&'a str>,
    user: Option<&'a str>,
    trial: Option<u32>,
    synthetic: bool,
    ranked: &'a [RankedSurface],
    margin: f64,
    latency_ms: f64,
    scan_s: f64,
    lost_samples: u64,
    sources: &'a [SourceId],
    spoiled: &'a [String],
    /// Scan duration that 400 samples T* apart need on the named surface.
    needed_s: Option<f64>,
}

/// What has been named so far.
pub struct Tally {
    json: bool,
    total: usize,
    needs: Needs,
    /// Warnings about a sensor are said once, and counted.
    said: BTreeMap<String, usize>,
    answers: usize,
    with_truth: usize,
    right: usize,
    latencies_ms: Vec<f64>,
    damages: usize,
    spoiled: usize,
}

impl Tally {
    /// Nothing yet, of `total` scans.
    pub fn new(json: bool, total: usize, needs: Needs) -> Self {
        Self {
            json,
            total,
            needs,
            said: BTreeMap::new(),
            answers: 0,
            with_truth: 0,
            right: 0,
            latencies_ms: Vec::new(),
            damages: 0,
            spoiled: 0,
        }
    }

    /// A scan was named; its answer took since `from`.
    pub fn answer(&mut self, scan: &Scan, ranking: &Ranking, from: Instant) {
        let latency_ms = from.elapsed().as_secs_f64() * 1e3;
        self.answers += 1;
        self.latencies_ms.push(latency_ms);
        self.spoiled += usize::from(!scan.spoiled.is_empty());
        let truth = scan.truth.as_ref();
        let right = truth.map(|key| key.surface == ranking.surface());
        self.with_truth += usize::from(right.is_some());
        self.right += usize::from(right == Some(true));
        let needed_s = self.look_closer(scan, ranking);
        if self.json {
            show::json(&Line {
                scan: scan.number,
                surface: ranking.surface(),
                truth: truth.map(|key| key.surface.as_str()),
                user: truth.map(|key| key.user.as_str()),
                trial: truth.map(|key| key.number),
                synthetic: scan.synthetic,
                ranked: &ranking.ranked,
                margin: ranking.margin,
                latency_ms,
                scan_s: scan.scan_s,
                lost_samples: scan.lost_samples,
                sources: &ranking.sources,
                spoiled: &scan.spoiled,
                needed_s,
            });
        } else {
            let more_s = needed_s.map(|needed| needed - scan.scan_s).filter(|s| *s > 0.0);
            self.tell(ranking, right, truth, latency_ms, more_s);
        }
    }

    fn tell(
        &self,
        ranking: &Ranking,
        right: Option<bool>,
        truth: Option<&TrialKey>,
        ms: f64,
        more_s: Option<f64>,
    ) {
        let verdict = match (right, truth) {
            (Some(true), _) => "right".to_string(),
            (Some(false), Some(key)) => format!("wrong, it was {}", key.surface),
            _ => String::new(),
        };
        let longer = more_s.map(|s| format!("  (T*: drag {s:.1} s more)")).unwrap_or_default();
        eprintln!(
            "{:>4}/{}  {:<28} margin {:<6.2} {:>7.1} ms  {verdict}{longer}",
            self.answers,
            self.total,
            ranking.surface(),
            ranking.margin,
            ms
        );
    }

    /// Flaws of the scan's channels, what spoiled it, samples closer than T*; gives the scan
    /// duration that the named surface asks for.
    fn look_closer(&mut self, scan: &Scan, ranking: &Ranking) -> Option<f64> {
        for (id, signal) in &scan.trial.signals {
            let Signal::Series(series) = signal else { continue };
            // A source with a fixed length scale is a switch, and rests most of the time.
            if self.needs.is_switch(id) {
                continue;
            }
            let left_out =
                if ranking.sources.contains(id) { "" } else { "; the source is left out" };
            for flaw in flaws(series) {
                self.say(format!("{id}: {flaw}{left_out}"), scan.number);
            }
        }
        for reason in &scan.spoiled {
            eprintln!("warning: scan {}: {reason}", scan.number);
        }
        for warning in self.needs.warnings(ranking, scan.scan_s) {
            self.say(warning, scan.number);
        }
        self.needs.scan_s(ranking)
    }

    fn say(&mut self, text: String, scan: u32) {
        // The same flaw with other numbers is the same flaw.
        let kind: String = text.chars().filter(|c| !c.is_ascii_digit() && *c != '.').collect();
        let count = self.said.entry(kind).or_insert(0);
        *count += 1;
        if *count == 1 {
            eprintln!("warning: scan {scan}: {text}");
        }
    }

    /// Something in use was lost or damaged.
    pub fn damage(&mut self, text: &str) {
        self.damages += 1;
        eprintln!("warning: {text}");
    }

    /// Tells people what it came to.
    pub fn sum_up(&mut self, synthetic: bool) {
        let again: usize = self.said.values().map(|count| count - 1).sum();
        if again > 0 {
            eprintln!("({again} more warning(s) of these kinds)");
        }
        if self.answers == 0 {
            return;
        }
        let mark = if synthetic { " (synthetic scene)" } else { "" };
        let (low, high) = wilson_interval(self.right, self.with_truth);
        self.latencies_ms.sort_by(f64::total_cmp);
        let median = self.latencies_ms[self.latencies_ms.len() / 2];
        eprintln!();
        if self.with_truth > 0 {
            eprintln!(
                "accuracy {} of {} scans (95 % interval {} to {}){mark}",
                show::percent(self.right as f64 / self.with_truth as f64),
                self.with_truth,
                show::percent(low),
                show::percent(high)
            );
        }
        eprintln!("latency  {median:.1} ms from the end of a scan to its name (median)");
    }

    /// How the command ends, after `lost` samples were lost.
    pub fn verdict(&self, lost: u64) -> Done {
        if self.answers == 0 {
            return Err(Failure::Failed("no scan was named; see the warnings above".into()));
        }
        if self.damages + self.spoiled > 0 || lost > 0 {
            return Err(Failure::Damaged(format!(
                "{} of {} scans named; {} warning(s), {} scan(s) spoiled, {lost} sample(s) lost",
                self.answers, self.total, self.damages, self.spoiled
            )));
        }
        Ok(())
    }
}
