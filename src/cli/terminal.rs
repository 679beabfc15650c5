//! The terminal of a station: a status line at the bottom, and above it lines that scroll.
//!
//! Without a terminal there is no status line, and the rest goes to the log. Answers go to stdout.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use console::Term;
use tracing::Level;

use super::{say, show, shown};
use crate::device::DeviceState;
use crate::ring::Counts;
use crate::scene::{Phase, SourceId};
use crate::station::{
    Answer, Enrolled, EnrolledOutcome, Guess, LibraryState, Listener, StationEvent,
};
use crate::system::has_status_line;

/// Shows a station to people: answers on stdout, all else on stderr.
pub struct Terminal {
    /// Whether answers go to stdout as JSON instead of text.
    json: bool,
    /// Whether stderr is a terminal.
    draws: bool,
    hint: String,
    scanning: Arc<AtomicBool>,
    devices: BTreeMap<String, DeviceState>,
    /// The scan in progress: its part, and the last guess of its surface.
    scan: Option<(Phase, Option<Guess>)>,
    last: Option<String>,
}

impl Terminal {
    /// A terminal that shows `hint`, which says what to do, until there is something else to show.
    pub fn new(json: bool, hint: String) -> Self {
        let draws = has_status_line();
        say::never_wait();
        say::keep_status_line(draws);
        if !draws {
            tracing::info!("{hint}");
        }
        Self {
            json,
            draws,
            hint,
            scanning: Arc::default(),
            devices: BTreeMap::new(),
            scan: None,
            last: None,
        }
    }

    /// Whether a scan is in progress, for the key that ends it.
    pub fn scanning(&self) -> Arc<AtomicBool> {
        self.scanning.clone()
    }

    /// Shows a line above the status line, or logs it.
    fn say(&self, level: Level, text: &str) {
        match level {
            _ if self.draws => say!("{}{text}", say::word(level)),
            Level::WARN => tracing::warn!("{text}"),
            _ => tracing::info!("{text}"),
        }
    }

    fn info(&self, text: &str) {
        self.say(Level::INFO, text);
    }

    fn warn(&self, text: &str) {
        self.say(Level::WARN, text);
    }

    /// Draws the status line.
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
        let devices: Vec<_> =
            self.devices.iter().map(|(name, state)| format!("{name} {state}")).collect();
        let line = format!("{now} │ {}", devices.join(", "));
        let columns = Term::stderr().size_checked().map_or(80, |(_, columns)| columns);
        let fits: String = line.chars().take(usize::from(columns.max(20)) - 1).collect();
        say::status(&fits);
    }

    fn answer(&mut self, answer: &Answer) {
        let name = show::named(answer);
        let longer = answer.more_s().map(|s| format!("  (drag {s:.1} s longer)"));
        if !self.json {
            result!(
                "scan {:<4} {name:<28} {:<12} {:.1} s of drag{}",
                answer.scan,
                show::certainty(answer),
                answer.scan_s,
                longer.unwrap_or_default()
            );
        }
        for why in &answer.spoiled {
            self.warn(&format!("scan {}: {why}", answer.scan));
        }
        if !self.json {
            let doubts = answer.reasons.iter().filter(|why| !answer.spoiled.contains(why));
            doubts.for_each(|why| self.info(&format!("  {why}")));
            let texts = answer.remarks.iter().map(|remark| &remark.text);
            let news = texts.filter(|text| !answer.reasons.contains(text));
            news.for_each(|text| self.info(&format!("  {text}")));
        }
        self.last = Some(name);
    }

    fn enrolled(&mut self, enrolled: &Enrolled) {
        let Enrolled { scan, surface, outcome, trial, folder, remarks, wanted, .. } = enrolled;
        match (outcome, trial, folder) {
            (_, Some(trial), Some(folder)) => {
                self.info(&format!("kept: trial {trial} of {surface} in {}", shown(folder)));
            }
            (EnrolledOutcome::Refused, ..) => self.warn(&format!("scan {scan} refused; repeat it")),
            // A warning tells of other outcomes.
            _ => return,
        }
        remarks.iter().for_each(|remark| self.info(&format!("  {remark}")));
        if let Some(nearest) = enrolled.nearest.as_ref().filter(|nearest| *nearest != surface) {
            self.warn(&format!("this looks like {nearest}, which the library has"));
        }
        self.last = Some(match wanted {
            0 => format!("{surface} is complete"),
            // Recording without an end is not counted down.
            wanted if *wanted > u32::MAX / 2 => format!("{surface} kept"),
            wanted => format!("{surface}, {wanted} to go; tap, then drag"),
        });
    }

    fn library(&self, library: &LibraryState) {
        let LibraryState { name, surfaces, synthetic, problem, remarks, .. } = library;
        if problem.is_some() {
            // A warning tells of the problem.
            return;
        }
        let trials: usize = surfaces.iter().map(|(_, trials)| trials).sum();
        let mark = if *synthetic { " (synthetic)" } else { "" };
        let surfaces = show::counted(surfaces.len(), "surface");
        self.info(&format!("{name}{mark}: {} of {surfaces}", show::counted(trials, "trial")));
        remarks.iter().for_each(|remark| self.info(remark));
    }
}

impl Listener for Terminal {
    fn on_event(&mut self, event: &StationEvent) {
        match event {
            StationEvent::Device { device, state, detail } => {
                let why = if detail.is_empty() { String::new() } else { format!(": {detail}") };
                self.info(&format!("{device} is {state}{why}"));
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
            StationEvent::Answer(answer) => self.answer(answer),
            StationEvent::Enrolled(enrolled) => self.enrolled(enrolled),
            StationEvent::Library(library) => self.library(library),
            StationEvent::Warning(text) => self.warn(text),
            StationEvent::Unnamed(unnamed) => {
                self.warn(&unnamed.text);
                self.last = Some("not named".into());
            }
            StationEvent::Trace(_)
            | StationEvent::Scan(_)
            | StationEvent::Streams(_)
            | StationEvent::Enrolling(_)
            | StationEvent::Reading
            | StationEvent::Ending(_)
            | StationEvent::Alive => return,
            StationEvent::Finished(totals) => {
                let stream = |(id, counts): (&SourceId, &Counts)| {
                    format!("{id} {} ({} lost)", counts.pushed - counts.lost, counts.lost)
                };
                let streams: Vec<_> = totals.streams.iter().map(stream).collect();
                say::keep_status_line(false);
                return self.info(&format!("received: {}", streams.join(", ")));
            }
        }
        self.draw();
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        say::keep_status_line(false);
    }
}

/// One line about a scan in progress.
fn so_far(guess: &Guess) -> String {
    let best = guess.named.first().map(|best| {
        let settled = if guess.settled { ", settled" } else { "" };
        format!(": {} {:.0} %{settled}", best.surface, best.probability * 100.0)
    });
    let more_s = guess.needed_s.map(|needed_s| needed_s - guess.scan_s).filter(|s| *s > 0.0);
    let more = match more_s {
        _ if guess.enough => " (lift)".into(),
        Some(s) => format!(" ({s:.1} s more)"),
        None => String::new(),
    };
    format!("dragging {:.1} s{}{more}", guess.scan_s, best.unwrap_or_default())
}
