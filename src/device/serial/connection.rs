//! One connection to the stylus, from opening the line to losing it.

use std::time::{Duration, Instant};

use surfaced_wire::{Command, DecodeError, MAX_ENCODED, Message, Status, encode};

use super::{Intake, IntakeEvent, Light, Port};
use crate::device::{DeviceLink, DeviceState};
use crate::ring::Sink;

/// No samples for this long is a stall, and the stylus is commanded to start.
pub(in crate::device) const STALLED: Duration = Duration::from_millis(500);
/// No samples for this long, and the line is reopened: it may have another path by now.
const GIVE_UP: Duration = Duration::from_secs(5);
/// A command is sent again if no answer has come within this time.
const REPEAT: Duration = Duration::from_millis(100);
/// The time that the stylus has to stop at the end.
const STOP_TIMEOUT: Duration = Duration::from_millis(300);
/// Least time between two reports of errors.
pub(in crate::device) const REPORT_EVERY: Duration = Duration::from_secs(1);
/// Bytes taken at a time: 0.4 s of the line.
pub(in crate::device) const BUFFER: usize = 64 * 1024;

/// The end of a connection.
pub(in crate::device) enum ConnectionEnd {
    Stop,
    Lost(String),
}

/// Reads what is there, or waits for a moment: the number of bytes, 0 where none came.
///
/// # Errors
/// If the line is lost: why.
pub(in crate::device) fn read_some(
    port: &mut dyn Port,
    buffer: &mut [u8],
) -> Result<usize, String> {
    use std::io::ErrorKind::{Interrupted, TimedOut, WouldBlock};
    match port.read(buffer) {
        Ok(0) => Err("the line was hung up".into()),
        Ok(n) => Ok(n),
        Err(error) if matches!(error.kind(), TimedOut | WouldBlock | Interrupted) => Ok(0),
        Err(error) => Err(format!("the line was lost ({error})")),
    }
}

/// Warns of what was counted, if anything was.
pub(in crate::device) fn warn_of(counts: &[(u64, &str)], link: &DeviceLink) {
    let some = counts.iter().filter(|(count, _)| *count > 0);
    let parts: Vec<String> = some.map(|(count, text)| format!("{count} {text}")).collect();
    if !parts.is_empty() {
        link.warn(parts.join(", "));
    }
}

/// One connection to the stylus, from opening the line to losing it.
pub(super) struct Connection<'a> {
    pub port: Box<dyn Port>,
    pub path: String,
    pub intake: &'a mut Intake,
    pub sinks: &'a mut [Sink],
    pub link: &'a DeviceLink,
    pub light: &'a Light,
    pub begin: Instant,
    /// When samples last came.
    pub samples_at: Instant,
    /// When it was last commanded to start.
    pub start_sent_at: Option<Instant>,
    /// When it was last commanded to switch the light.
    pub light_sent_at: Option<Instant>,
    pub status: Option<Status>,
    pub refused: Option<String>,
    pub errors: LinkErrors,
    /// When `errors` were last reported.
    pub reported_at: Instant,
}

impl Connection<'_> {
    pub fn run(&mut self) -> ConnectionEnd {
        let mut buffer = vec![0; BUFFER];
        loop {
            if self.link.stopped() {
                self.stop_stylus(&mut buffer);
                return ConnectionEnd::Stop;
            }
            if let Err(why) = self.read(&mut buffer) {
                return ConnectionEnd::Lost(format!(
                    "{}: {why}; waiting for it to come back",
                    self.path
                ));
            }
            let now = Instant::now();
            let silent = now - self.samples_at;
            if (silent >= STALLED || !self.intake.introduced())
                && self.start_sent_at.is_none_or(|at| now - at >= STALLED.min(2 * REPEAT))
            {
                // A start while it samples only brings a hello, so this can do no harm.
                self.start_sent_at = Some(now);
                self.send(Command::Start);
            }
            if silent >= STALLED {
                self.link.state(DeviceState::Stalled, self.why_silent());
            }
            if silent >= GIVE_UP {
                return ConnectionEnd::Lost(format!("{}; reopening the line", self.why_silent()));
            }
            self.update_light(now);
            if now - self.reported_at >= REPORT_EVERY {
                self.errors.report(self.link);
                self.reported_at = now;
            }
        }
    }

    /// Reads what is there, or waits for a moment.
    fn read(&mut self, buffer: &mut [u8]) -> Result<(), String> {
        let n = read_some(self.port.as_mut(), buffer)?;
        if n == 0 {
            return Ok(());
        }
        let now = Instant::now();
        let now_s = (now - self.begin).as_secs_f64();
        let Self { intake, sinks, link, light, status, refused, errors, .. } = self;
        let any = intake.feed(&buffer[..n], now_s, |event| match event {
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
                    errors.hello(format!("its channels have changed ({who})"));
                }
                for id in lacking {
                    errors.hello(format!("{who} has no channels for {id}, which is left out"));
                }
            }
            IntakeEvent::Refused(why) => *refused = Some(why),
            IntakeEvent::Restarted => errors.restarts += 1,
            IntakeEvent::Status(new) => {
                light.confirm(new.light);
                if new.crystal_failed && !status.is_some_and(|old| old.crystal_failed) {
                    link.warn("its crystal has failed: its rate is accurate to 1 % only");
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
            self.samples_at = now;
            self.link.state(DeviceState::Streaming, "");
        }
        Ok(())
    }

    fn why_silent(&self) -> String {
        let unused = self.intake.unused();
        match &self.refused {
            Some(why) => why.clone(),
            None if !self.intake.introduced() && unused.damaged > 0 => {
                format!("no stylus answers on {}; check port and wiring", self.path)
            }
            None => format!("no samples come from {}; check that the stylus has power", self.path),
        }
    }

    fn update_light(&mut self, now: Instant) {
        let wanted = self.light.wanted();
        // A stylus that was reset has its light off, as its next status shows.
        let differs = self.status.is_some_and(|status| status.light != wanted);
        if differs && self.light_sent_at.is_none_or(|at| now - at >= REPEAT) {
            self.light_sent_at = Some(now);
            self.send(if wanted { Command::LightOn } else { Command::LightOff });
        }
    }

    fn stop_stylus(&mut self, buffer: &mut [u8]) {
        let until = Instant::now() + STOP_TIMEOUT;
        let mut sent_at: Option<Instant> = None;
        self.status = None;
        while Instant::now() < until && self.status.is_none_or(|status| status.sampling) {
            if sent_at.is_none_or(|at| at.elapsed() >= REPEAT) {
                sent_at = Some(Instant::now());
                self.send(Command::Stop);
            }
            if self.read(buffer).is_err() {
                return;
            }
        }
    }

    /// Sends a command. One that cannot be sent is repeated like one that is not answered.
    fn send(&mut self, command: Command) {
        let mut out = [0; MAX_ENCODED + 1];
        // The delimiter before it ends any noise on the line.
        if let Ok(n) = encode(&Message::Command(command), &mut out[1..]) {
            let _ = self.port.write(&out[..=n]);
        }
    }
}

/// Errors of the line that were not reported yet.
#[derive(Default)]
pub(super) struct LinkErrors {
    damaged: u64,
    gaps: u64,
    /// Frames of the longest gap.
    missing: u64,
    restarts: u64,
    overflowed: u64,
    overruns: u64,
    dropped: u64,
    /// Number of warnings about the stylus's hello messages, and the last of them.
    hellos: u64,
    last_hello: Option<String>,
}

impl LinkErrors {
    /// Adds the losses since the last status; the stylus counts them from 0 at each of its starts.
    fn stylus(&mut self, old: Option<&Status>, new: &Status) {
        let (overruns, dropped) = old.map_or((0, 0), |old| (old.overruns, old.dropped));
        self.overruns += u64::from(new.overruns.checked_sub(overruns).unwrap_or(new.overruns));
        self.dropped += u64::from(new.dropped.checked_sub(dropped).unwrap_or(new.dropped));
    }

    fn hello(&mut self, warning: String) {
        self.hellos += 1;
        self.last_hello = Some(warning);
    }

    /// Reports the errors so far, summed up, and forgets them.
    pub fn report(&mut self, link: &DeviceLink) {
        match (self.hellos, self.last_hello.take()) {
            (2.., Some(last)) => link.warn(format!("{last} (and {} more)", self.hellos - 1)),
            (_, last) => last.into_iter().for_each(|last| link.warn(last)),
        }
        let counts = [
            (self.damaged, "frames were damaged on the line"),
            (self.gaps, "gaps in the samples"),
            (self.missing, "samples are missing in the longest gap"),
            (self.restarts, "restarts of its sample counter"),
            (self.overflowed, "frames did not fit into a ring"),
            (self.overruns, "samples were taken late"),
            (self.dropped, "samples did not fit into its memory"),
        ];
        warn_of(&counts, link);
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::DeviceReportKind;
    use crate::ring::Stop;

    #[test]
    fn errors_of_the_line_are_summed_up_whatever_their_number() {
        let (send, reports) = crossbeam_channel::unbounded();
        let link = DeviceLink::new(0, Stop::default(), send);
        let mut errors = LinkErrors::default();
        (0..200_000).for_each(|n| errors.hello(format!("hello {n}")));
        let status = |overruns| Status { overruns, ..Status::default() };
        for _ in 0..3 {
            errors.stylus(None, &status(u32::MAX));
        }
        errors.report(&link);
        let texts: Vec<String> = reports
            .try_iter()
            .map(|report| match report.kind {
                DeviceReportKind::Warning(text) => text,
                other => panic!("{other:?}"),
            })
            .collect();
        assert_eq!(texts[0], "hello 199999 (and 199999 more)");
        assert_eq!(texts[1], format!("{} samples were taken late", 3 * u64::from(u32::MAX)));
        assert_eq!(texts.len(), 2);
    }
}
