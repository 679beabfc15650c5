//! The stylus on a serial line: finds it, starts it, and finds it again after a reset or a replug.
//!
//! [`Intake`] decodes bytes into frames, without I/O. [`Selector`] chooses the port, real or a
//! pseudo-terminal. [`Stylus`] is the device made of both. The stylus does not answer a damaged
//! command, so each command is repeated until the stylus answers.
//!
//! Values are fractions of the converter's full scale (see `intake::Value`), except metal, which is
//! 0 or 1.

mod intake;
mod port;

use std::collections::BTreeMap;
use std::io::Read;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use serialport::SerialPort;
use surfaced_wire::{Command, DecodeError, MAX_ENCODED, Message, Status, encode};

use super::{
    Device, DeviceError, DeviceLink, DeviceState, Disconnected, RETRY, StreamSpec, WarningKind,
    keep_connected,
};
use crate::ring::Sink;

pub use intake::{Intake, IntakeEvent};
pub use port::Selector;

pub(super) use intake::{LEAST_RESTART_S, gap};
pub(super) use port::WAIT;

pub(crate) use intake::{Value, Wanted};

#[derive(Clone, Debug, PartialEq)]
pub struct StylusConfig {
    pub port: Selector,
    pub rate_hz: u32,
    /// The streams to cut from the stylus's samples; each is a source with at least one channel.
    pub streams: Vec<Wanted>,
}

/// The stylus as a device, with one stream for each of its sources.
pub struct Stylus {
    name: String,
    config: StylusConfig,
    pub light: Light,
}

impl Stylus {
    pub fn new(config: StylusConfig) -> Self {
        let name = match &config.port {
            Selector::Auto => "stylus".into(),
            port => format!("stylus {port}"),
        };
        Self { name, config, light: Light::default() }
    }
}

impl Device for Stylus {
    fn name(&self) -> &str {
        &self.name
    }

    fn streams(&self) -> Vec<StreamSpec> {
        let rate_hz = f64::from(self.config.rate_hz);
        let spec = |wanted: &Wanted| StreamSpec::series(&wanted.id, wanted.channels.len(), rate_hz);
        self.config.streams.iter().map(spec).collect()
    }

    fn run(&mut self, sinks: &mut [Sink], link: &DeviceLink) -> Result<(), DeviceError> {
        let StylusConfig { port, rate_hz, streams } = &self.config;
        let mut intake = Intake::new(streams.clone(), *rate_hz);
        let begin = Instant::now();
        keep_connected(link, RETRY, || {
            let (port, path) = port.open()?;
            link.state(DeviceState::Opening, path.clone());
            intake.reopened();
            let now = Instant::now();
            let mut connection = Connection {
                port,
                path,
                intake: &mut intake,
                sinks,
                link,
                light: &self.light,
                begin,
                samples_at: now,
                start_sent_at: None,
                light_sent_at: None,
                status: None,
                refused: None,
                errors: LinkErrors::default(),
                reported_at: now,
            };
            let end = connection.run();
            connection.errors.report(link);
            end
        })
    }
}

/// Longest time in which the stylus must confirm that it switched the light.
const CONFIRM: Duration = Duration::from_millis(500);

/// A switch for the camera's light on the stylus. All clones switch the same light.
#[derive(Clone, Debug, Default)]
pub struct Light {
    wanted: Arc<AtomicBool>,
    reported: Arc<AtomicBool>,
}

impl Light {
    /// Asks for the light on or off. The driver repeats the command until the stylus confirms it.
    pub fn set(&self, on: bool) {
        self.wanted.store(on, Ordering::Release);
    }

    /// Whether the light is on, according to the last report of the stylus.
    pub fn is_on(&self) -> bool {
        self.reported.load(Ordering::Acquire)
    }

    /// Switches the light, and waits until the stylus confirms it. Fails after 0.5 s.
    pub fn switch(&self, on: bool) -> Result<(), String> {
        self.set(on);
        let until = Instant::now() + CONFIRM;
        while self.is_on() != on {
            if Instant::now() >= until {
                self.set(false);
                return Err("the stylus, which switches the light, does not answer".into());
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        Ok(())
    }
}

/// Time without samples after which the state is "stalled" and a start command is sent.
pub(super) const STALLED: Duration = Duration::from_millis(500);
/// Time without samples after which the line is reopened; the port's path may have changed.
const GIVE_UP: Duration = Duration::from_secs(5);
/// Time without an answer after which a command is sent again.
const REPEAT: Duration = Duration::from_millis(100);
/// Longest time that a stop waits until the stylus has stopped sampling.
const STOP_TIMEOUT: Duration = Duration::from_millis(300);
/// Shortest time between two reports of errors.
pub(super) const REPORT_EVERY: Duration = Duration::from_secs(1);
pub(super) const BUFFER: usize = 64 * 1024;
pub(super) const OVERFLOWED: &str = "frames did not fit into a ring";

/// Reads the bytes that have arrived, or waits briefly for some. Returns their number, which may be
/// 0. An error says why the line is lost.
pub(super) fn read_some(line: &mut dyn Read, buffer: &mut [u8]) -> Result<usize, String> {
    use std::io::ErrorKind::{Interrupted, TimedOut, WouldBlock};
    match line.read(buffer) {
        Ok(0) => Err("the line was hung up".into()),
        Ok(n) => Ok(n),
        Err(error) if matches!(error.kind(), TimedOut | WouldBlock | Interrupted) => Ok(0),
        Err(error) => Err(format!("the line was lost ({error})")),
    }
}

pub(super) fn lost(path: &str, why: &str) -> Disconnected {
    Disconnected::Lost(format!("{path}: {why}; waiting for it to come back"))
}

/// Numbers of errors on a line since the last report, by the text that says what was counted.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct ErrorCounts(pub BTreeMap<&'static str, u64>);

impl ErrorCounts {
    pub(super) fn add(&mut self, text: &'static str, count: u64) {
        *self.0.entry(text).or_default() += count;
    }

    pub(super) fn highest(&mut self, text: &'static str, count: u64) {
        let highest = self.0.entry(text).or_default();
        *highest = count.max(*highest);
    }

    /// Sends one warning with all counts above 0, and resets the counts.
    pub(super) fn report(&mut self, link: &DeviceLink) {
        let counts = std::mem::take(&mut self.0).into_iter().filter(|(_, count)| *count > 0);
        let parts: Vec<String> = counts.map(|(text, count)| format!("{count} {text}")).collect();
        if !parts.is_empty() {
            link.warn(WarningKind::Damaged, parts.join(", "));
        }
    }
}

/// One connection to the stylus, from opening the line to losing it.
struct Connection<'a> {
    port: Box<dyn SerialPort>,
    path: String,
    intake: &'a mut Intake,
    sinks: &'a mut [Sink],
    link: &'a DeviceLink,
    light: &'a Light,
    begin: Instant,
    samples_at: Instant,
    start_sent_at: Option<Instant>,
    light_sent_at: Option<Instant>,
    status: Option<Status>,
    refused: Option<String>,
    errors: LinkErrors,
    reported_at: Instant,
}

impl Connection<'_> {
    fn run(&mut self) -> Result<(), Disconnected> {
        let mut buffer = vec![0; BUFFER];
        while !self.link.stopped() {
            self.read(&mut buffer).map_err(|why| lost(&self.path, &why))?;
            let now = Instant::now();
            let silent = now - self.samples_at;
            if (silent >= STALLED || !self.intake.introduced)
                && self.start_sent_at.is_none_or(|at| now - at >= 2 * REPEAT)
            {
                // A repeated start does no harm: a sampling stylus answers it only with a hello.
                self.start_sent_at = Some(now);
                self.send(Command::Start);
            }
            if silent >= STALLED {
                self.link.state(DeviceState::Stalled, self.why_silent());
            }
            if silent >= GIVE_UP {
                let why = format!("{}; reopening the line", self.why_silent());
                return Err(Disconnected::Lost(why));
            }
            self.update_light(now);
            if now - self.reported_at >= REPORT_EVERY {
                self.errors.report(self.link);
                self.reported_at = now;
            }
        }
        self.stop_stylus(&mut buffer);
        Ok(())
    }

    /// Reads the bytes that have arrived, or waits briefly for some, and handles their messages.
    fn read(&mut self, buffer: &mut [u8]) -> Result<(), String> {
        let n = read_some(&mut self.port, buffer)?;
        if n == 0 {
            return Ok(());
        }
        let now = Instant::now();
        let now_s = (now - self.begin).as_secs_f64();
        let Self { intake, sinks, link, light, status, refused, errors, .. } = self;
        let any = intake.feed(&buffer[..n], now_s, |event| match event {
            IntakeEvent::Frames { stream, samples } => {
                if let Some(sink) = sinks.get_mut(stream).and_then(Sink::series) {
                    errors.counts.add(OVERFLOWED, sink.push(samples));
                }
            }
            IntakeEvent::Missing { stream, frames } => {
                if let Some(sink) = sinks.get_mut(stream).and_then(Sink::series) {
                    sink.skip(frames);
                }
                errors.counts.add("gaps in the samples", u64::from(stream == 0));
                errors.counts.highest("samples are missing in the longest gap", frames);
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
            IntakeEvent::Restarted => errors.counts.add("restarts of its sample counter", 1),
            IntakeEvent::Status(new) => {
                light.reported.store(new.light, Ordering::Release);
                if new.crystal_failed && !status.is_some_and(|old| old.crystal_failed) {
                    let text = "its crystal has failed: its rate is accurate to 1 % only";
                    link.warn(WarningKind::Crystal, text);
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
            IntakeEvent::Damaged(_) => errors.counts.add("frames were damaged on the line", 1),
        });
        if any {
            self.samples_at = now;
            self.link.state(DeviceState::Streaming, "");
        }
        Ok(())
    }

    fn why_silent(&self) -> String {
        match &self.refused {
            Some(why) => why.clone(),
            None if !self.intake.introduced && self.intake.damaged > 0 => {
                format!("no stylus answers on {}; check port and wiring", self.path)
            }
            None => format!("no samples come from {}; check that the stylus has power", self.path),
        }
    }

    fn update_light(&mut self, now: Instant) {
        let wanted = self.light.wanted.load(Ordering::Acquire);
        // A reset switches the light off. The next status shows this, so it is switched on again.
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

    /// Sends a command. Errors are ignored, since an unanswered command is repeated.
    fn send(&mut self, command: Command) {
        let mut out = [0; MAX_ENCODED + 1];
        // Sends a zero byte first: it is a delimiter, which ends any noise on the line.
        if let Ok(n) = encode(&Message::Command(command), &mut out[1..]) {
            let _ = self.port.write(&out[..=n]);
        }
    }
}

#[derive(Default)]
struct LinkErrors {
    counts: ErrorCounts,
    /// The last warning about an introduction (hello) of the stylus, and the number of such warnings.
    hello: (String, u64),
}

impl LinkErrors {
    /// Adds the losses since the last status; the stylus counts from 0 after each start.
    fn stylus(&mut self, old: Option<&Status>, new: &Status) {
        let (overruns, dropped) = old.map_or((0, 0), |old| (old.overruns, old.dropped));
        for (text, old, new) in [
            ("samples were taken late", overruns, new.overruns),
            ("samples did not fit into its memory", dropped, new.dropped),
        ] {
            self.counts.add(text, u64::from(new.checked_sub(old).unwrap_or(new)));
        }
    }

    fn hello(&mut self, warning: String) {
        self.hello = (warning, self.hello.1 + 1);
    }

    fn report(&mut self, link: &DeviceLink) {
        match std::mem::take(&mut self.hello) {
            (_, 0) => {}
            (last, 1) => link.warn(WarningKind::Damaged, last),
            (last, n) => link.warn(WarningKind::Damaged, format!("{last} (and {} more)", n - 1)),
        }
        self.counts.report(link);
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
                DeviceReportKind::Warning(warning) => warning.text,
                other => panic!("{other:?}"),
            })
            .collect();
        assert_eq!(texts[0], "hello 199999 (and 199999 more)");
        assert_eq!(texts[1], format!("{} samples were taken late", 3 * u64::from(u32::MAX)));
        assert_eq!(texts.len(), 2);
    }
}
