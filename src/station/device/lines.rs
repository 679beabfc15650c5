//! Drivers for sensors that print lines of numbers: on a serial port, TCP, UDP or standard input.
//!
//! `LineParser` parses bytes into rows, and `LinesIntake` turns rows into frames, both without I/O.
//! A [`Survey`] finds rate, scale and columns from the data. [`LinesAddress`] says where the bytes
//! come from. [`Lines`] is the device made of these parts.

mod address;
mod cells;
mod clocks;
mod commas;
mod form;
mod intake;
mod lateness;
mod layout;
mod numbers;
mod pace;
mod parser;
mod survey;
mod swaps;

use std::io::Read;
use std::time::{Duration, Instant};

use serialport::ClearBuffer;

use super::serial::{BUFFER, OVERFLOWED, REPORT_EVERY, STALLED, Selector, lost, read_some};
use super::system;
use super::{
    Device, DeviceError, DeviceLink, DeviceReportKind, DeviceState, Disconnected, OpenError, RETRY,
    StreamSpec, WarningKind, keep_connected,
};
use crate::ring::Sink;

use address::{Drops, Mixed, OpenLine, put_back};

pub use address::LinesAddress;
pub use intake::{LinesEvent, LinesIntake};
pub use layout::{Column, Count, LinesStream};
pub use survey::{ColumnSurvey, SURVEY_S, Survey};

use intake::GARBAGE;
use pace::Pace;

/// Pause after a read that did not fill half of the buffer, so that one read takes many lines, even if
/// each line is sent by itself.
const GATHER: Duration = Duration::from_millis(4);
/// Rate in Hz for which a device's ring is sized while the device's rate is not known.
const UNKNOWN_HZ: f64 = 20_000.0;
/// Time between two looks at what the system has dropped.
const LOOK_EVERY: Duration = Duration::from_millis(50);
const DROPPED: &str = "datagrams were dropped by the system, since they came too fast";

/// A sensor that prints lines of numbers. A rate or scale of `None` is measured in the first
/// seconds, whose lines are then dropped, except those of a file.
#[derive(Clone, Debug, PartialEq)]
pub struct LinesConfig {
    pub address: LinesAddress,
    pub rate_hz: Option<f64>,
    pub count: Option<Count>,
    /// Whether commas are decimal commas; `None` to find out.
    pub decimal_comma: Option<bool>,
    pub streams: Vec<LinesStream>,
}

pub struct Lines {
    name: String,
    config: LinesConfig,
}

struct Work<'a> {
    config: &'a LinesConfig,
    /// `None` until the values that the configuration leaves open are measured.
    intake: Option<LinesIntake>,
    sinks: &'a mut [Sink],
    link: &'a DeviceLink,
    begin: Instant,
    pace: Pace,
    drops: Option<Drops>,
    mixed: Mixed,
    /// Whether it was said that two senders are mixed.
    is_mixed: bool,
}

impl Lines {
    pub fn new(config: LinesConfig) -> Self {
        let name = match &config.address {
            LinesAddress::Stdin => "lines from standard input".into(),
            other => format!("lines from {other}"),
        };
        Self { name, config }
    }
}

impl Device for Lines {
    fn name(&self) -> &str {
        &self.name
    }

    fn streams(&self) -> Vec<StreamSpec> {
        let rate_hz = self.config.rate_hz.unwrap_or(UNKNOWN_HZ);
        let spec = |s: &LinesStream| StreamSpec::series(&s.id, s.columns.len(), rate_hz);
        self.config.streams.iter().map(spec).collect()
    }

    fn waits(&self) -> bool {
        // A file waits until its lines are read. A pipe may come from a live sensor.
        self.config.address == LinesAddress::Stdin && system::stdin_is_a_file()
    }

    fn run(&mut self, sinks: &mut [Sink], link: &DeviceLink) -> Result<(), DeviceError> {
        let (config, begin) = (&self.config, Instant::now());
        let LinesConfig { address, rate_hz, count, decimal_comma, streams } = config;
        let scaled = streams.iter().all(|stream| stream.scale.is_some());
        let intake = |rate_hz| {
            let intake = LinesIntake::new(streams.clone(), count.clone(), rate_hz);
            intake.decimal_comma(*decimal_comma)
        };
        let intake = rate_hz.filter(|_| scaled).map(intake);
        let pace = Pace::default();
        let (drops, mixed, is_mixed) = (None, Mixed::default(), false);
        let mut work = Work { config, intake, sinks, link, begin, pace, drops, mixed, is_mixed };
        keep_connected(link, RETRY, || {
            let OpenLine { mut line, path, drops, mixed } = address.open()?;
            (work.drops, work.mixed) = (drops, mixed);
            link.state(DeviceState::Opening, path.clone());
            match work.follow(&mut line) {
                // The device ends with its pipe, which cannot be reopened.
                Err(Disconnected::Lost(_)) if *address == LinesAddress::Stdin => Ok(()),
                Err(Disconnected::Lost(why)) => Err(lost(&path, &why)),
                end => end,
            }
        })
    }
}

/// Surveys a line until the survey is complete or `stopped` is true; returns survey and bytes read.
/// `half`: the bytes may begin within a row. An error says why the line is lost.
fn survey(
    line: &mut dyn Read,
    (half, decimal_comma): (bool, Option<bool>),
    mut stopped: impl FnMut(&Survey) -> bool,
) -> Result<(Survey, Vec<u8>), String> {
    let (begin, mut all) = (Instant::now(), Vec::new());
    let mut survey = Survey::new(half, decimal_comma);
    let mut buffer = vec![0; BUFFER + 1];
    while !survey.is_complete() && !stopped(&survey) {
        let n = match read_some(line, &mut buffer) {
            // The end of a file is no error if enough was read, and completes the survey.
            Err(_) if survey.rate_hz().is_ok() || !all.is_empty() && !half => break,
            read => read?,
        };
        survey.feed(&buffer[..n], begin.elapsed().as_secs_f64());
        // Memory is bounded, since a survey is complete after a number of bytes, too.
        all.extend_from_slice(&buffer[..n]);
        gather(n);
    }
    Ok((survey, all))
}

fn gather(read: usize) {
    if read < BUFFER / 2 {
        std::thread::sleep(GATHER);
    }
}

/// Usual speeds of serial ports in baud, the commonest first.
const SPEEDS: [u32; 10] =
    [115_200, 9600, 57_600, 921_600, 38_400, 19_200, 230_400, 250_000, 460_800, 1_000_000];
/// Time of noise alone after which other speeds are tried, and the time that each is tried.
const NOISE: Duration = Duration::from_secs(4);
const TRIAL: Duration = Duration::from_millis(700);

/// The usual speed other than `baud` at which text comes; `None` if at none.
fn speed_of(port: &Selector, baud: u32) -> Result<Option<u32>, OpenError> {
    let (mut line, _) = port.open_at(baud)?;
    for speed in SPEEDS.into_iter().filter(|speed| *speed != baud) {
        // The port stays open, since many boards restart when it is opened.
        if line.set_baud_rate(speed).is_err() || line.clear(ClearBuffer::Input).is_err() {
            continue;
        }
        let until = Instant::now() + TRIAL;
        let stopped = |_: &Survey| Instant::now() >= until;
        let found = survey(&mut line, (true, None), stopped);
        if found.is_ok_and(|(survey, _)| survey.is_text()) {
            return Ok(Some(speed));
        }
    }
    Ok(None)
}

/// Opens `address` and surveys its lines; gives up if no row comes within `patience`. The bytes
/// read from standard input can be read again afterwards. An error says what to do.
pub fn survey_of(address: &LinesAddress, patience: Duration) -> Result<Survey, String> {
    let OpenLine { mut line, path, .. } = address.open().map_err(|error| error.to_string())?;
    let until = Instant::now() + patience;
    let noisy = Instant::now() + NOISE;
    // Gives up only before the first row; later, this waits until the survey is complete.
    let stopped = |survey: &Survey| {
        let (now, serial) = (Instant::now(), matches!(address, LinesAddress::Serial(..)));
        !survey.has_rows() && now >= until || serial && survey.is_noise() && now >= noisy
    };
    let (survey, bytes) =
        survey(&mut line, (address.begins_half(), None), stopped).map_err(|why| match address {
            LinesAddress::Stdin => "standard input is empty; pipe lines of numbers into it".into(),
            _ => format!("{path}: {why}"),
        })?;
    if *address == LinesAddress::Stdin {
        put_back(bytes);
    }
    if survey.is_empty() {
        return Err(format!("{path}: nothing comes; check that the device sends by itself"));
    }
    if let LinesAddress::Serial(port, baud) = address
        && survey.is_noise()
    {
        drop(line);
        let found = speed_of(port, *baud).map_err(|error| error.to_string())?;
        let speeds = SPEEDS.map(|speed| speed.to_string()).join(", ");
        return Err(match found {
            Some(speed) => format!(
                "{path}: at {baud} baud comes noise, and at {speed} baud comes text; name \
                 the port {}",
                LinesAddress::Serial(port.clone(), speed)
            ),
            None => format!(
                "{path}: only noise comes, at {baud} baud and at {speeds}; check what the device \
                 prints, and its ground wire"
            ),
        });
    }
    Ok(survey)
}

impl Work<'_> {
    /// Takes rows from a line that was just opened, until a stop is requested.
    fn follow(&mut self, line: &mut dyn Read) -> Result<(), Disconnected> {
        match &mut self.intake {
            Some(intake) => intake.reopened(self.config.address.begins_half()),
            None => {
                let (begin, address) = (Instant::now(), &self.config.address);
                let half = (address.begins_half(), self.config.decimal_comma);
                let stopped = |survey: &Survey| {
                    if !survey.is_empty() && !survey.has_rows() && begin.elapsed() >= STALLED * 4 {
                        let why = survey.problem().filter(|_| survey.is_text());
                        let why = why.unwrap_or_else(|| address.no_numbers());
                        self.link.state(DeviceState::Stalled, why);
                    }
                    self.link.stopped()
                };
                let (survey, bytes) = survey(line, half, stopped).map_err(Disconnected::Lost)?;
                if self.link.stopped() {
                    return Ok(());
                }
                // A file waits to be read, and a pipe that has ended brings no newer lines.
                let waits = system::stdin_is_a_file() || !survey.is_complete();
                if *address == LinesAddress::Stdin && waits {
                    put_back(bytes);
                }
                let intake = self.measured(&survey).map_err(OpenError::Unfit)?;
                self.link.send(DeviceReportKind::Rate(intake.rate_hz));
                self.intake = Some(intake);
            }
        }
        let end = self.take_all(line);
        self.report();
        end.map_err(Disconnected::Lost)
    }

    /// The intake, with measured values where the configuration gives none, or why that fails.
    fn measured(&self, survey: &Survey) -> Result<LinesIntake, String> {
        let LinesConfig { rate_hz, count, streams, .. } = self.config;
        let rate_hz = rate_hz.map_or_else(|| survey.rate_hz(), Ok)?;
        let intake = LinesIntake::new(survey.scaled(streams), count.clone(), rate_hz);
        let mut intake = intake.decimal_comma(self.config.decimal_comma);
        intake.names = survey.names().to_vec();
        Ok(intake)
    }

    /// Takes rows until a stop. An error says why the line was lost.
    fn take_all(&mut self, line: &mut dyn Read) -> Result<(), String> {
        let mut buffer = vec![0; BUFFER + 1];
        let waits = self.config.address == LinesAddress::Stdin;
        // A file is read as fast as its rows are taken.
        let is_paced = !(waits && system::stdin_is_a_file());
        let (mut rows_at, mut reported_at) = (Instant::now(), Instant::now());
        let mut looked_at = rows_at;
        self.pace.restart(self.seconds(rows_at));
        while !self.link.stopped() {
            let n = read_some(line, &mut buffer)?;
            let now = Instant::now();
            if now - looked_at >= LOOK_EVERY {
                looked_at = now;
                self.look_at_drops();
            }
            if self.take(&buffer[..n], self.seconds(now), waits) {
                rows_at = now;
                if is_paced {
                    self.look_at_pace(self.seconds(now));
                }
                self.link.state(DeviceState::Streaming, "");
            } else if now - rows_at >= STALLED {
                self.pace.restart(self.seconds(now));
                self.link.state(DeviceState::Stalled, self.why_silent());
            }
            if now - reported_at >= REPORT_EVERY {
                self.report();
                reported_at = now;
            }
            if !waits {
                gather(n);
            }
        }
        Ok(())
    }

    /// Takes bytes. Returns whether they completed any frames.
    fn take(&mut self, bytes: &[u8], now_s: f64, waits: bool) -> bool {
        let Self { intake: Some(intake), sinks, link, .. } = self else { return false };
        let mut overflowed = 0;
        let rows = intake.feed(bytes, now_s, |event| match event {
            LinesEvent::Frames { stream, samples } => {
                let Some(sink) = sinks.get_mut(stream).and_then(Sink::series) else { return };
                match waits {
                    // Pushing fails only after a stop, when data no longer count.
                    true => drop(sink.push_waiting(samples, &link.stop)),
                    false => overflowed += sink.push(samples),
                }
            }
            LinesEvent::Missing(frames) => {
                sinks.iter_mut().filter_map(Sink::series).for_each(|sink| sink.skip(frames));
            }
        });
        intake.errors.add(OVERFLOWED, overflowed);
        rows > 0
    }

    /// Counts what the system dropped. Each datagram holds at least a line.
    fn look_at_drops(&mut self) {
        let Self { intake: Some(intake), sinks, drops: Some(drops), .. } = self else { return };
        let dropped = drops.fresh();
        intake.errors.add(DROPPED, dropped);
        intake.dropped(dropped, |event| {
            let LinesEvent::Missing(frames) = event else { return };
            sinks.iter_mut().filter_map(Sink::series).for_each(|sink| sink.skip(frames));
        });
    }

    fn seconds(&self, now: Instant) -> f64 {
        (now - self.begin).as_secs_f64()
    }

    fn why_silent(&self) -> String {
        let (address, intake) = (&self.config.address, self.intake.as_ref());
        intake.and_then(LinesIntake::why_silent).unwrap_or_else(|| match intake {
            Some(intake) if intake.errors.0.contains_key(GARBAGE) => address.no_numbers(),
            _ => format!("no lines come from {address}; check that the device sends by itself"),
        })
    }

    /// Warns if the rate of the lines differs from the configured or first measured one. Small
    /// differences are clock drift, which the scan's clock follows, and need no warning.
    fn look_at_pace(&mut self, now_s: f64) {
        let Some(intake) = &self.intake else { return };
        let (frames, rate_hz, unsettled) = (intake.frames, intake.rate_hz, intake.is_unsettled());
        if !self.pace.rows(now_s, frames, rate_hz, unsettled, intake.clock_hz()) {
            return;
        }
        let seen_hz = self.pace.off_hz.map(|seen_hz| clocks::rounded(seen_hz, 3));
        self.link.send(DeviceReportKind::OffPace(seen_hz));
        if let Some(seen_hz) = seen_hz {
            let text = format!(
                "its rate is {seen_hz} Hz, but {rate_hz} Hz are expected, so scans have a wrong \
                 rate, and their answers are unsure; say rate_hz = {seen_hz} in its [[lines]] of the configuration"
            );
            self.link.warn(WarningKind::OffPace, text);
        }
    }

    fn report(&mut self) {
        if let Some(intake) = &mut self.intake {
            intake.errors.report(self.link);
            let warn = |example| self.link.warn(WarningKind::Damaged, example);
            intake.examples.next.drain(..).for_each(warn);
            if let Some(swapped) = intake.swapped() {
                self.link.warn(WarningKind::Swapped, swapped);
            }
        }
        if let (Some([one, other]), false) = (self.mixed.take(), self.is_mixed) {
            self.is_mixed = true;
            let text = format!(
                "{one} and {other} both send to it, and their lines are mixed; give each a port of its own"
            );
            self.link.warn(WarningKind::Damaged, text);
        }
    }
}
