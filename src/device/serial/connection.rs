//! One connection with the stylus, from opening the line to losing it.

use std::time::{Duration, Instant};

use surfaced_wire::{Command, DecodeError, MAX_ENCODED, Message, Status, encode};

use super::{Intake, IntakeEvent, Light, Port};
use crate::device::{Control, DeviceState};
use crate::ring::Sink;

/// No samples for so long is a stall, and the stylus is asked to start.
const STALLED: Duration = Duration::from_millis(500);
/// No samples for so long, and the line is opened anew: it may have another path by now.
const GIVE_UP: Duration = Duration::from_secs(5);
/// A command without an answer is sent again after this.
const REPEAT: Duration = Duration::from_millis(100);
/// How long the stylus is given to stop in the end.
const STOP_TIMEOUT: Duration = Duration::from_millis(300);
/// What goes wrong in between is summed up at most so often.
const TELL: Duration = Duration::from_secs(1);
/// Bytes taken at a time: 0.4 s of the line.
const BUFFER: usize = 64 * 1024;

/// How a connection ends.
pub(super) enum End {
    Stop,
    Lost(String),
}

/// One connection with the stylus, from opening the line to losing it.
pub(super) struct Connection<'a> {
    pub port: Box<dyn Port>,
    pub path: String,
    pub intake: &'a mut Intake,
    pub sinks: &'a mut [Sink],
    pub control: &'a Control,
    pub light: &'a Light,
    pub begin: Instant,
    /// When samples last came.
    pub heard_at: Instant,
    pub asked_at: Option<Instant>,
    pub light_asked_at: Option<Instant>,
    pub status: Option<Status>,
    pub refused: Option<String>,
    pub errors: LinkErrors,
}

impl Connection<'_> {
    pub fn run(&mut self) -> End {
        let mut buffer = vec![0; BUFFER];
        loop {
            if self.control.stopped() {
                self.stop_stylus(&mut buffer);
                return End::Stop;
            }
            if let Err(why) = self.read(&mut buffer) {
                return End::Lost(format!("{}: {why}; waiting for it to come back", self.path));
            }
            let now = Instant::now();
            let silent = now - self.heard_at;
            if (silent >= STALLED || !self.intake.introduced())
                && self.asked_at.is_none_or(|at| now - at >= STALLED.min(2 * REPEAT))
            {
                // A start while it samples only brings a hello, so this can do no harm.
                self.asked_at = Some(now);
                self.send(Command::Start);
            }
            if silent >= STALLED {
                self.control.state(DeviceState::Stalled, self.why_silent());
            }
            if silent >= GIVE_UP {
                return End::Lost(format!("{}; opening the line anew", self.why_silent()));
            }
            self.see_to_light(now);
            if now - self.errors.since >= TELL {
                self.errors.tell(self.control);
            }
        }
    }

    /// Reads what is there, or waits for a moment.
    fn read(&mut self, buffer: &mut [u8]) -> Result<(), String> {
        use std::io::ErrorKind::{Interrupted, TimedOut, WouldBlock};
        let n = match self.port.read(buffer) {
            Ok(0) => return Err("the line was hung up".into()),
            Ok(n) => n,
            Err(error) if matches!(error.kind(), TimedOut | WouldBlock | Interrupted) => {
                return Ok(());
            }
            Err(error) => return Err(format!("the line was lost ({error})")),
        };
        let now = Instant::now();
        let now_s = (now - self.begin).as_secs_f64();
        let Self { intake, sinks, control, light, status, refused, errors, .. } = self;
        let any = intake.feed(&buffer[..n], now_s, |heard| match heard {
            IntakeEvent::Frames { stream, samples } => {
                if let Some(sink) = sinks.get_mut(stream).and_then(Sink::series) {
                    errors.overflowed += sink.push(samples);
                }
            }
            IntakeEvent::Missing { stream, frames } => {
                if let Some(sink) = sinks.get_mut(stream).and_then(Sink::series) {
                    sink.skip(frames);
                }
                errors.missing = errors.missing.max(frames);
                errors.gaps += u64::from(stream == 0);
            }
            IntakeEvent::Hello { who, lacking, changed } => {
                *refused = None;
                if changed {
                    control.warn(format!("its channels have changed ({who})"));
                }
                for id in lacking {
                    control.warn(format!("{who} has no channels for {id}, which is left out"));
                }
            }
            IntakeEvent::Refused(why) => *refused = Some(why),
            IntakeEvent::Restarted => errors.restarts += 1,
            IntakeEvent::Status(new) => {
                light.told(new.light);
                if new.crystal_failed && !status.is_some_and(|old| old.crystal_failed) {
                    control.warn("its crystal has failed: its rate is good to 1 % only");
                }
                errors.stylus(status.as_ref(), &new);
                *status = Some(new);
            }
            IntakeEvent::Damaged(DecodeError::Version(version)) => {
                *refused = Some(format!(
                    "it speaks version {version} of the wire format, this program version {}; \
                     install the firmware that belongs to this program",
                    surfaced_wire::VERSION
                ));
            }
            IntakeEvent::Damaged(_) => errors.damaged += 1,
        });
        if any {
            self.heard_at = now;
            self.control.state(DeviceState::Streaming, "");
        }
        Ok(())
    }

    fn why_silent(&self) -> String {
        let unused = self.intake.unused();
        match &self.refused {
            Some(why) => why.clone(),
            None if !self.intake.introduced() && unused.damaged > 0 => {
                format!("what comes from {} is no stylus's hello; check port and wiring", self.path)
            }
            None => format!("no samples come from {}; check that the stylus has power", self.path),
        }
    }

    fn see_to_light(&mut self, now: Instant) {
        let wanted = self.light.wanted();
        // A stylus that was reset has its light off, and says so in its next status.
        let differs = self.status.is_some_and(|status| status.light != wanted);
        if differs && self.light_asked_at.is_none_or(|at| now - at >= REPEAT) {
            self.light_asked_at = Some(now);
            self.send(if wanted { Command::LightOn } else { Command::LightOff });
        }
    }

    /// Stops the stylus, as far as it listens.
    fn stop_stylus(&mut self, buffer: &mut [u8]) {
        let until = Instant::now() + STOP_TIMEOUT;
        let mut asked: Option<Instant> = None;
        self.status = None;
        while Instant::now() < until && self.status.is_none_or(|status| status.sampling) {
            if asked.is_none_or(|at| at.elapsed() >= REPEAT) {
                asked = Some(Instant::now());
                self.send(Command::Stop);
            }
            if self.read(buffer).is_err() {
                return;
            }
        }
    }

    /// Sends a command. One that does not get out is repeated as one that is not answered.
    fn send(&mut self, command: Command) {
        let mut out = [0; MAX_ENCODED + 1];
        // The delimiter before it ends whatever noise the line holds.
        if let Ok(n) = encode(&Message::Command(command), &mut out[1..]) {
            let _ = self.port.write(&out[..=n]);
        }
    }
}

/// What went wrong and is yet to be told.
pub(super) struct LinkErrors {
    since: Instant,
    damaged: u64,
    gaps: u64,
    /// Frames of the longest gap.
    missing: u64,
    restarts: u64,
    overflowed: u64,
    overruns: u32,
    dropped: u32,
}

impl LinkErrors {
    pub fn new(since: Instant) -> Self {
        Self {
            since,
            damaged: 0,
            gaps: 0,
            missing: 0,
            restarts: 0,
            overflowed: 0,
            overruns: 0,
            dropped: 0,
        }
    }

    /// What the stylus says it lost itself since its last status; its counts begin at its start.
    fn stylus(&mut self, old: Option<&Status>, new: &Status) {
        let (overruns, dropped) = old.map_or((0, 0), |old| (old.overruns, old.dropped));
        self.overruns += new.overruns.checked_sub(overruns).unwrap_or(new.overruns);
        self.dropped += new.dropped.checked_sub(dropped).unwrap_or(new.dropped);
    }

    pub fn tell(&mut self, control: &Control) {
        let mut parts = Vec::new();
        let mut add = |count: u64, what: &str| {
            if count > 0 {
                parts.push(format!("{count} {what}"));
            }
        };
        add(self.damaged, "damaged frame(s) on the line");
        add(self.gaps, "gap(s) in the samples");
        add(self.missing, "sample(s) missing in the longest");
        add(self.restarts, "restart(s) of its sample counter");
        add(self.overflowed, "value(s) that found no room in a ring");
        add(self.overruns.into(), "sample(s) that it took too late");
        add(self.dropped.into(), "sample(s) that found no room in it");
        if !parts.is_empty() {
            control.warn(parts.join(", "));
        }
        *self = Self::new(Instant::now());
    }
}
