//! The terminal of a station: one calm line of what goes on, and above it what is to be kept.
//!
//! Without a terminal (a log file, a pipe) there is no such line, only what is to be kept.

use std::collections::BTreeMap;
use std::io::{IsTerminal, Read, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock, mpsc};

use crossbeam_channel::Sender;
use rustix::termios::{self, LocalModes, OptionalActions, Termios};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

use super::{Failure, show, shown};
use crate::device::DeviceState;
use crate::ring::Counts;
use crate::scene::{Phase, SourceId};
use crate::station::{Answer, Command, Enrolled, Guess, LibraryState, Listener, StationEvent};

/// Who is told on stderr.
pub struct Terminal {
    /// Answers are on stdout, as JSON.
    json: bool,
    /// Whether stderr is a terminal.
    draws: bool,
    hint: String,
    scanning: Arc<AtomicBool>,
    devices: BTreeMap<String, DeviceState>,
    /// The scan that goes on: its part, and how it looks so far.
    scan: Option<(Phase, Option<Guess>)>,
    last: Option<String>,
}

impl Terminal {
    /// Nothing told yet. `hint` stands where nothing else is to be said.
    pub fn new(json: bool, hint: String) -> Self {
        let draws = std::io::stderr().is_terminal();
        if !draws {
            eprintln!("{hint}");
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

    /// Whether a scan goes on, for the key that ends it.
    pub fn scanning(&self) -> Arc<AtomicBool> {
        self.scanning.clone()
    }

    /// Prints a line that stays.
    fn say(&self, text: &str) {
        let clear = if self.draws { "\r\x1b[2K" } else { "" };
        let priority = show::priority(text);
        eprintln!("{clear}{priority}{text}");
    }

    /// Draws the line that changes.
    fn draw(&self) {
        if !self.draws {
            return;
        }
        let now = match (&self.scan, &self.last) {
            (Some((Phase::Drag, Some(guess))), _) => so_far(guess),
            (Some(_), _) => "a scan begins".into(),
            (None, Some(last)) => format!("last: {last}"),
            (None, None) => self.hint.clone(),
        };
        let devices: Vec<_> =
            self.devices.iter().map(|(name, state)| format!("{name} {state}")).collect();
        let line = format!("{now} │ {}", devices.join(", "));
        let columns = termios::tcgetwinsize(std::io::stderr()).map_or(80, |size| size.ws_col);
        let fits: String = line.chars().take(usize::from(columns.max(20)) - 1).collect();
        let mut stderr = std::io::stderr();
        // A terminal that is gone needs no line.
        let _ = write!(stderr, "\r\x1b[2K{fits}").and_then(|()| stderr.flush());
    }

    fn answer(&mut self, answer: &Answer) {
        let name = answer.surface.as_deref().unwrap_or("unknown");
        let longer = answer.more_s().map(|s| format!("  (T*: drag {s:.1} s more)"));
        if !self.json {
            self.say(&format!(
                "scan {:<4} {name:<28} {:<12} {:.1} s of drag{}",
                answer.scan,
                show::sureness(answer),
                answer.scan_s,
                longer.unwrap_or_default()
            ));
        }
        for why in &answer.spoiled {
            self.say(&format!("warning: scan {}: {why}", answer.scan));
        }
        if !self.json {
            answer.remarks.iter().for_each(|remark| self.say(&format!("  {remark}")));
        }
        self.last = Some(name.to_string());
    }

    fn enrolled(&mut self, enrolled: &Enrolled) {
        let Enrolled { scan, surface, trial, folder, remarks, wanted } = enrolled;
        match (trial, folder) {
            (Some(trial), Some(folder)) => {
                self.say(&format!("kept: trial {trial} of {surface} in {}", shown(folder)));
            }
            _ => self.say(&format!("refused: scan {scan}; once more, please")),
        }
        remarks.iter().for_each(|remark| self.say(&format!("  {remark}")));
        self.last = Some(match wanted {
            0 => format!("{surface} is complete"),
            // Nobody counts down from all that there is.
            wanted if *wanted > u32::MAX / 2 => format!("{surface} kept"),
            wanted => format!("{surface}, {wanted} to go; tap, then drag"),
        });
    }

    fn library(&self, library: &LibraryState) {
        let LibraryState { name, surfaces, synthetic, problem, remarks, .. } = library;
        if let Some(problem) = problem {
            return self.say(&format!("warning: scans cannot be named: {problem}"));
        }
        let trials: usize = surfaces.iter().map(|(_, trials)| trials).sum();
        let mark = if *synthetic { " (synthetic)" } else { "" };
        self.say(&format!("{name}{mark}: {trials} trials of {} surfaces", surfaces.len()));
        remarks.iter().for_each(|remark| self.say(remark));
    }
}

impl Listener for Terminal {
    fn on_event(&mut self, event: &StationEvent) {
        match event {
            StationEvent::Device { device, state, detail } => {
                let why = if detail.is_empty() { String::new() } else { format!(": {detail}") };
                self.say(&format!("{device} is {state}{why}"));
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
            StationEvent::Warning(text) => self.say(&format!("warning: {text}")),
            StationEvent::Trace(_)
            | StationEvent::Streams(_)
            | StationEvent::Reading
            | StationEvent::Alive => return,
            StationEvent::Finished(totals) => {
                let stream = |(id, counts): (&SourceId, &Counts)| {
                    format!("{id} {} ({} lost)", counts.pushed - counts.lost, counts.lost)
                };
                let streams: Vec<_> = totals.streams.iter().map(stream).collect();
                return self.say(&format!("received: {}", streams.join(", ")));
            }
        }
        self.draw();
    }
}

/// How a scan that goes on looks.
fn so_far(guess: &Guess) -> String {
    let best = guess.named.first().map(|best| {
        let sure = if guess.settled { ", settled" } else { "" };
        format!(": {} {:.0} %{sure}", best.surface, best.probability * 100.0)
    });
    let more_s = guess.needed_s.map(|needed_s| needed_s - guess.scan_s).filter(|s| *s > 0.0);
    let more = more_s.map(|s| format!(" (T*: {s:.1} s more)"));
    format!(
        "dragging {:.1} s{}{}",
        guess.scan_s,
        best.unwrap_or_default(),
        more.unwrap_or_default()
    )
}

/// How the terminal was before keys were read one by one.
static BEFORE: OnceLock<Termios> = OnceLock::new();

/// Keys that are read one by one, until it is dropped.
pub struct Keys;

impl Keys {
    /// Reads keys where there is someone to press them: `space` begins or ends a scan, `q` quits.
    pub fn listen(orders: Sender<Command>, scanning: Arc<AtomicBool>) -> Option<Self> {
        let stdin = std::io::stdin();
        let in_front =
            termios::tcgetpgrp(&stdin).is_ok_and(|group| group == rustix::process::getpgrp());
        if !in_front || !std::io::stderr().is_terminal() {
            return None;
        }
        let before = termios::tcgetattr(&stdin).ok()?;
        let mut single = before.clone();
        // Signals stay: Ctrl-C is one of the ways to end.
        single.local_modes.remove(LocalModes::ICANON | LocalModes::ECHO);
        termios::tcsetattr(&stdin, OptionalActions::Now, &single).ok()?;
        let keys = Self;
        let _ = BEFORE.set(before);
        let read = move || {
            // One that has a lock and a buffer of its own.
            for key in std::io::stdin().lock().bytes() {
                let order = match key {
                    Ok(b' ') if scanning.load(Ordering::Acquire) => Command::Stop,
                    Ok(b' ') => Command::Start,
                    Ok(b'q' | b'Q') => Command::Quit,
                    Ok(_) => continue,
                    Err(_) => return,
                };
                if orders.send(order).is_err() {
                    return;
                }
            }
        };
        // It waits for a key for ever, and ends with the process.
        std::thread::Builder::new().name("keys".into()).spawn(read).ok()?;
        Some(keys)
    }
}

impl Drop for Keys {
    fn drop(&mut self) {
        restore();
    }
}

fn restore() {
    if let Some(before) = BEFORE.get() {
        // If this fails, the terminal is gone.
        let _ = termios::tcsetattr(std::io::stdin(), OptionalActions::Now, before);
    }
}

/// Tells when a signal has come.
pub struct Signalled(mpsc::Receiver<()>);

impl Signalled {
    /// Waits for the first signal, if it has not come yet.
    pub fn wait(self) {
        let _ = self.0.recv();
    }
}

/// Makes the first signal to end an order to quit; the second ends the process on the spot, as does
/// the first when nobody waits for either.
pub fn watch_signals(orders: Sender<Command>) -> Result<Signalled, Failure> {
    let mut signals = Signals::new([SIGINT, SIGTERM, SIGHUP])?;
    let (tell, told) = mpsc::channel();
    let watch = move || {
        for (count, signal) in signals.forever().enumerate() {
            let heard = [orders.send(Command::Quit).is_ok(), tell.send(()).is_ok()];
            if count > 0 || heard == [false; 2] {
                restore();
                std::process::exit(128 + signal);
            }
        }
    };
    std::thread::Builder::new().name("signals".into()).spawn(watch)?;
    Ok(Signalled(told))
}
