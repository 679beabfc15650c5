//! Any sensor that prints lines of numbers: on a serial port, by TCP or UDP, or on standard input.
//!
//! [`LineParser`] turns bytes into rows and [`LinesIntake`] rows into frames, without I/O;
//! [`Survey`] learns rate, scale and columns from what comes; [`LinesAddress`] is where the bytes
//! come from, and [`Lines`] the device that joins them.

mod address;
mod intake;
mod parser;
mod survey;

use std::time::{Duration, Instant};

use super::serial::{
    BUFFER, ConnectionEnd, OpenPort, Port, REPORT_EVERY, STALLED, keep_open, read_some, warn_of,
};
use super::{Device, DeviceError, DeviceLink, DeviceState, OpenError, StreamKind, StreamSpec};
use crate::ring::Sink;

use address::StandardInput;

pub use address::LinesAddress;
pub use intake::{Column, Count, LineCounts, LinesEvent, LinesIntake, LinesStream};
pub use parser::{LONGEST_LINE, Line, LineParser};
pub use survey::{ColumnSurvey, SURVEY_S, Survey};

/// A pause after each read, so that a program that sends each line by itself costs one read for
/// many of them.
const GATHER: Duration = Duration::from_millis(4);
/// The ring of a device whose rate is yet to be measured is as long as for this one, in Hz.
const UNKNOWN_HZ: f64 = 20_000.0;
/// The time from one look at the rate to the next, in seconds, and the least change that is said.
const PACE_S: f64 = 10.0;
const PACE: f64 = 0.02;

/// A sensor that prints lines of numbers.
pub struct Lines {
    name: String,
    address: LinesAddress,
    streams: Vec<LinesStream>,
    count: Option<Count>,
    rate_hz: Option<f64>,
}

/// The lines at work.
struct Work<'a> {
    intake: Option<LinesIntake>,
    sinks: &'a mut [Sink],
    link: &'a DeviceLink,
    rate_hz: f64,
    counts: Counted,
    /// Rows since the rate was last looked at, and when that was.
    pace: (u64, Instant),
    off_pace: bool,
}

#[derive(Default)]
struct Counted {
    lines: LineCounts,
    overflowed: u64,
}

impl Lines {
    /// Lines from `address` as these streams, at least one; rate and scales that are not given are
    /// measured over the first seconds, which are not passed on.
    pub fn new(
        address: LinesAddress,
        streams: Vec<LinesStream>,
        count: Option<Count>,
        rate_hz: Option<f64>,
    ) -> Self {
        Self { name: address.name(), address, streams, count, rate_hz }
    }

    /// Whether rate or a scale is to be measured.
    fn measures(&self) -> bool {
        self.rate_hz.is_none() || self.streams.iter().any(|stream| stream.scale.is_none())
    }
}

impl Device for Lines {
    fn name(&self) -> &str {
        &self.name
    }

    fn streams(&self) -> Vec<StreamSpec> {
        let kind = |stream: &LinesStream| StreamKind::Series {
            channels: stream.columns.len(),
            rate_hz: self.rate_hz.unwrap_or(UNKNOWN_HZ),
        };
        let spec = |stream: &LinesStream| StreamSpec { id: stream.id.clone(), kind: kind(stream) };
        self.streams.iter().map(spec).collect()
    }

    fn waits(&self) -> bool {
        // The program at the other end of a pipe waits for its reader.
        self.address == LinesAddress::Stdin
    }

    fn run(&mut self, sinks: &mut [Sink], link: &DeviceLink) -> Result<(), DeviceError> {
        let begin = Instant::now();
        let intake = (!self.measures())
            .then(|| self.intake(&self.streams, self.rate_hz.unwrap_or(UNKNOWN_HZ)));
        let mut work = Work {
            intake,
            sinks,
            link,
            rate_hz: self.rate_hz.unwrap_or(UNKNOWN_HZ),
            counts: Counted::default(),
            pace: (0, begin),
            off_pace: false,
        };
        let mut address = self.address.clone();
        let mut failed = Ok(());
        keep_open(&mut address, link, |mut port, path| {
            if work.intake.is_none() {
                match self.measure(port.as_mut(), link) {
                    Ok(Some((intake, rate_hz))) => {
                        link.rate(rate_hz);
                        (work.intake, work.rate_hz) = (Some(intake), rate_hz);
                    }
                    Ok(None) => return ConnectionEnd::Stop,
                    Err(SurveyError::Unfit(why)) => {
                        failed = Err(DeviceError::Failed(why));
                        return ConnectionEnd::Stop;
                    }
                    Err(SurveyError::Lost(why)) => {
                        return self.lost(&path, &why);
                    }
                }
            } else if let Some(intake) = &mut work.intake {
                intake.reopened(self.address.begins_half());
            }
            let end = work.follow(port.as_mut(), begin, &self.address);
            work.report();
            end.map_or(ConnectionEnd::Stop, |why| self.lost(&path, &why))
        })?;
        failed
    }
}

/// Why nothing was learnt of a device.
pub enum SurveyError {
    /// It is lost.
    Lost(String),
    /// What comes cannot be used.
    Unfit(String),
}

/// Learns what comes from a line that was opened within a line if `half`, until enough came or
/// `stopped` says so; gives the bytes, too.
///
/// # Errors
/// If the line is lost.
pub fn survey(
    port: &mut dyn Port,
    half: bool,
    mut stopped: impl FnMut(&Survey) -> bool,
) -> Result<(Survey, Vec<u8>), String> {
    let (begin, mut survey, mut all) = (Instant::now(), Survey::new(half), Vec::new());
    let mut buffer = vec![0; BUFFER + 1];
    while !survey.is_complete() && !stopped(&survey) {
        let n = match read_some(port, &mut buffer) {
            // A file that ends is a survey, too.
            Err(_) if survey.rate_hz().is_ok() || !all.is_empty() && !half => break,
            read => read?,
        };
        survey.feed(&buffer[..n], begin.elapsed().as_secs_f64());
        all.extend_from_slice(&buffer[..n]);
        std::thread::sleep(GATHER);
    }
    Ok((survey, all))
}

/// Opens `address` for a survey, and waits until enough came, for at most `patience`. What was read
/// from standard input is there to be read again.
///
/// # Errors
/// If it cannot be opened, is lost, or no lines of numbers come: what to do.
pub fn survey_of(address: &LinesAddress, patience: Duration) -> Result<Survey, String> {
    let (mut port, path) = address.clone().open().map_err(|error: OpenError| error.to_string())?;
    let until = Instant::now() + patience;
    // Once rows come, their survey is waited for.
    let stopped = |survey: &Survey| !survey.has_rows() && Instant::now() >= until;
    let (survey, bytes) = survey(port.as_mut(), address.begins_half(), stopped)
        .map_err(|why| format!("{path}: {why}"))?;
    if *address == LinesAddress::Stdin {
        StandardInput::put_back(bytes);
    }
    if !survey.has_rows() {
        return Err(match survey.is_garbage() {
            true => {
                format!("{path}: bytes come, but no lines of numbers; {}", address.garbage_hint())
            }
            false => format!("{path}: nothing comes; check that the device sends by itself"),
        });
    }
    Ok(survey)
}

impl Lines {
    fn intake(&self, streams: &[LinesStream], rate_hz: f64) -> LinesIntake {
        LinesIntake::new(streams.to_vec(), self.count.clone(), rate_hz)
    }

    fn lost(&self, path: &str, why: &str) -> ConnectionEnd {
        // A pipe that has ended does not come back.
        match self.address {
            LinesAddress::Stdin => ConnectionEnd::Stop,
            _ => ConnectionEnd::Lost(format!("{path}: {why}; waiting for it to come back")),
        }
    }

    /// Measures what is not given; `None` at a stop.
    fn measure(
        &self,
        port: &mut dyn Port,
        link: &DeviceLink,
    ) -> Result<Option<(LinesIntake, f64)>, SurveyError> {
        let mut silent = Some(Instant::now());
        let stopped = |survey: &Survey| {
            if survey.is_garbage() && silent.is_some_and(|since| since.elapsed() >= STALLED * 4) {
                let hint = self.address.garbage_hint();
                link.state(DeviceState::Stalled, format!("no lines of numbers come; {hint}"));
                silent = None;
            }
            link.stopped()
        };
        let half = self.address.begins_half();
        let (survey, _) = survey(port, half, stopped).map_err(SurveyError::Lost)?;
        if link.stopped() {
            return Ok(None);
        }
        let rate_hz = match self.rate_hz {
            Some(rate_hz) => rate_hz,
            None => survey.rate_hz().map_err(SurveyError::Unfit)?,
        };
        let mut intake = self.intake(&survey.scaled(&self.streams), rate_hz);
        intake.set_names(survey.names());
        Ok(Some((intake, rate_hz)))
    }
}

impl Work<'_> {
    /// Takes lines until a stop, or until the line is lost: then why.
    fn follow(
        &mut self,
        port: &mut dyn Port,
        begin: Instant,
        address: &LinesAddress,
    ) -> Option<String> {
        let mut buffer = vec![0; BUFFER + 1];
        let waits = *address == LinesAddress::Stdin;
        let (mut rows_at, mut reported_at) = (Instant::now(), Instant::now());
        self.pace = (0, rows_at);
        while !self.link.stopped() {
            let n = match read_some(port, &mut buffer) {
                Ok(n) => n,
                Err(why) => return Some(why),
            };
            let now = Instant::now();
            if self.take(&buffer[..n], (now - begin).as_secs_f64(), waits) {
                rows_at = now;
                self.link.state(DeviceState::Streaming, "");
            } else if now - rows_at >= STALLED {
                self.pace = (0, now);
                self.link.state(DeviceState::Stalled, self.why_silent(address));
            }
            self.look_at_pace(now);
            if now - reported_at >= REPORT_EVERY {
                self.report();
                reported_at = now;
            }
            if !waits {
                std::thread::sleep(GATHER);
            }
        }
        None
    }

    /// Takes bytes; whether there were frames.
    fn take(&mut self, bytes: &[u8], now_s: f64, waits: bool) -> bool {
        let Self { intake: Some(intake), sinks, counts, link, pace, .. } = self else {
            return false;
        };
        let any = intake.feed(bytes, now_s, |event| match event {
            LinesEvent::Frames { stream, samples } => {
                let Some(sink) = sinks.get_mut(stream).and_then(Sink::series) else { return };
                match waits {
                    // Fails at a stop alone, after which nothing counts.
                    true => drop(sink.push_waiting(samples, link.stop())),
                    false => counts.overflowed += sink.push(samples),
                }
            }
            LinesEvent::Missing(frames) => {
                sinks.iter_mut().filter_map(Sink::series).for_each(|sink| sink.skip(frames));
            }
        });
        let new = intake.take_counts();
        pace.0 += new.rows;
        counts.lines.add(&new);
        any
    }

    fn why_silent(&self, address: &LinesAddress) -> String {
        let refused = self.intake.as_ref().and_then(LinesIntake::refused);
        match refused {
            Some(why) => why.to_string(),
            None if self.counts.lines.garbage > 0 => {
                format!("no lines of numbers come; {}", address.garbage_hint())
            }
            None => format!("no lines come from {address}; check that the device sends by itself"),
        }
    }

    /// Says where the lines come at another rate than the one that is held; smaller differences
    /// are drift, which the scans' clock follows.
    fn look_at_pace(&mut self, now: Instant) {
        let (rows, since) = self.pace;
        let passed_s = (now - since).as_secs_f64();
        if passed_s < PACE_S {
            return;
        }
        self.pace = (0, now);
        let seen_hz = rows as f64 / passed_s;
        let off = (seen_hz / self.rate_hz - 1.0).abs() > PACE;
        if off && !self.off_pace {
            self.link.warn(format!(
                "{seen_hz:.0} lines come a second, but {} are expected; correct rate_hz of its \
                 [[lines]] in the configuration",
                self.rate_hz
            ));
        }
        self.off_pace = off;
    }

    fn report(&mut self) {
        let Counted { lines, overflowed } = std::mem::take(&mut self.counts);
        let counts = [
            (lines.garbage, "lines held no numbers"),
            (lines.too_long, "lines were too long"),
            (lines.other_width, "lines had another number of columns"),
            (lines.not_numbers, "lines had a value that is no number"),
            (lines.changes, "changes of the columns"),
            (lines.gaps, "gaps in the lines"),
            (lines.missing, "lines are missing in the longest gap"),
            (lines.restarts, "restarts of the device"),
            (overflowed, "frames did not fit into a ring"),
        ];
        warn_of(&counts, self.link);
    }
}
