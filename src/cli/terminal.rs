//! The terminal of a station: lines that scroll, and a status line at the bottom.
//!
//! Without a terminal there is no status line, and lines go to the log. Answers go to stdout.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use console::{Term, truncate_str};

use super::system::has_status_line;
use super::{say, show};
use crate::device::DeviceState;
use crate::ring::Counts;
use crate::scene::{Phase, SourceId};
use crate::station::{
    Answer, Change, Enrolled, EnrolledOutcome, FoundSurface, Guess, LibraryState, Listener,
    StationEvent, told,
};
use crate::trial::Doubt;

/// Shows a station to people. Answers go to stdout, everything else to stderr.
pub(super) struct Terminal {
    /// Whether answers are printed on stdout as JSON, not as text.
    json: bool,
    draws: bool,
    hint: String,
    scanning: Arc<AtomicBool>,
    devices: BTreeMap<String, DeviceState>,
    /// The phase of the scan in progress, and its last guess.
    scan: Option<(Phase, Option<Guess>)>,
    last: Option<String>,
}

impl Terminal {
    /// A terminal that shows `hint`, an instruction for the operator, until a scan begins.
    pub(super) fn new(json: bool, hint: String) -> Self {
        let draws = has_status_line();
        say::never_wait();
        say::keep_status_line(draws);
        if !draws {
            tracing::info!("{hint}");
        }
        let (scanning, devices) = (Arc::default(), BTreeMap::new());
        Self { json, draws, hint, scanning, devices, scan: None, last: None }
    }

    /// Whether a scan is in progress; the space bar starts or stops a scan accordingly.
    pub(super) fn scanning(&self) -> Arc<AtomicBool> {
        self.scanning.clone()
    }

    fn draw(&self) {
        if !self.draws {
            return;
        }
        let now = match (&self.scan, &self.last) {
            (Some((Phase::Drag, Some(guess))), _) => so_far(guess),
            (Some(_), _) => "scan begins".into(),
            (None, Some(last)) => format!("last: {last}"),
            (None, None) => self.hint.clone(),
        };
        let devices = self.devices.iter().map(|(name, state)| format!("{name} {state}"));
        let line = format!("{now} │ {}", show::listed(devices));
        let columns = Term::stderr().size_checked().map_or(80, |(_, columns)| columns);
        say::status(&truncate_str(&line, usize::from(columns.max(20)) - 1, ""));
    }

    fn answer(&mut self, answer: &Answer) {
        let name = show::named(answer);
        if !self.json {
            result!(
                "scan {:<4} {name:<28} {:<12} {:.1} s of drag{}",
                answer.scan,
                show::certainty(answer),
                answer.scan_s,
                show::longer(answer)
            );
        }
        answer.spoiled().for_each(|why| tracing::warn!("scan {}: {why}", answer.scan));
        if !self.json {
            let others = told(&answer.doubts).filter(|doubt| !doubt.spoils());
            // The library may have sources that this station never has, so they are not repeated.
            let news = others.filter(|doubt| !matches!(doubt, Doubt::SourceMissing { .. }));
            news.for_each(|why| tracing::info!("  {why}"));
        }
        self.last = Some(name);
    }

    fn change(&self, change: &Change) {
        if self.json {
            return;
        }
        let name = |found: &FoundSurface| found.surface.clone().unwrap_or_else(|| "unknown".into());
        let from =
            change.from.as_ref().map(|found| format!("{} → ", name(found))).unwrap_or_default();
        let Change { scan, at_s, since_s, to, .. } = change;
        result!("scan {scan:<4} at {at_s:.1} s: {from}{}, since {since_s:.1} s", name(to));
    }

    fn enrolled(&mut self, enrolled: &Enrolled) {
        let Enrolled { scan, surface, outcome, trial, folder, doubts, wanted, .. } = enrolled;
        match (outcome, trial, folder) {
            (_, Some(trial), Some(folder)) => {
                tracing::info!("kept: trial {trial} of {surface} in {}", folder.display());
            }
            (EnrolledOutcome::Refused, ..) => tracing::warn!("scan {scan} refused; repeat it"),
            // Other outcomes come with a warning, so nothing is printed here.
            _ => return,
        }
        for doubt in told(doubts) {
            match doubt {
                Doubt::NearSurface { .. } => tracing::warn!("{doubt}"),
                _ => tracing::info!("  {doubt}"),
            }
        }
        self.last = Some(match wanted {
            Some(0) => format!("{surface} is complete"),
            None => format!("{surface} kept"),
            Some(wanted) => format!("{surface}, {wanted} to go; tap, then drag"),
        });
    }

    fn library(&self, library: &LibraryState) {
        let LibraryState { name, surfaces, synthetic, problem, remarks, .. } = library;
        if problem.is_some() {
            // A warning reports the problem, so nothing is printed here.
            return;
        }
        let trials: usize = surfaces.iter().map(|(_, trials)| trials).sum();
        tracing::info!("{}", show::summary(name, *synthetic, trials, surfaces.len()));
        remarks.iter().for_each(|remark| tracing::info!("{remark}"));
    }
}

impl Listener for Terminal {
    fn on_event(&mut self, event: &StationEvent) {
        match event {
            StationEvent::Device { device, state, detail } => {
                let why = if detail.is_empty() { String::new() } else { format!(": {detail}") };
                tracing::info!("{device} is {state}{why}");
                self.devices.insert(device.clone(), *state);
            }
            StationEvent::Phase { phase, .. } => {
                self.scan = phase.map(|phase| (phase, None));
                self.scanning.store(phase.is_some(), Ordering::Release);
            }
            StationEvent::Guess(guess) => {
                if let Some((_, so_far)) = &mut self.scan {
                    *so_far = Some(guess.clone());
                }
            }
            StationEvent::Change(change) => self.change(change),
            StationEvent::Answer(answer) => self.answer(answer),
            StationEvent::Enrolled(enrolled) => self.enrolled(enrolled),
            StationEvent::Library(library) => self.library(library),
            StationEvent::Warning(text) => tracing::warn!("{text}"),
            StationEvent::Unnamed(answer) => {
                tracing::warn!("{}", answer.not_named());
                self.last = Some("not named".into());
            }
            StationEvent::Finished(totals) => {
                let stream = |(id, counts): (&SourceId, &Counts)| {
                    format!("{id} {} ({} lost)", counts.pushed - counts.lost, counts.lost)
                };
                say::keep_status_line(false);
                let streams = totals.streams.iter().map(stream);
                return tracing::info!("received: {}", show::listed(streams));
            }
            _ => return,
        }
        self.draw();
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        say::keep_status_line(false);
    }
}

fn so_far(guess: &Guess) -> String {
    let best = guess.named.first().map(|best| {
        let settled = if guess.settled { ", settled" } else { "" };
        format!(": {} {:.0} %{settled}", best.surface, best.probability * 100.0)
    });
    let more = match guess.more_s() {
        _ if guess.enough => " (lift)".into(),
        Some(s) => format!(" ({s:.1} s more)"),
        None => String::new(),
    };
    format!("dragging {:.1} s{}{more}", guess.scan_s, best.unwrap_or_default())
}
