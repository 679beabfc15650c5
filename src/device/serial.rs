//! The stylus on its serial line: finds it, starts it, and keeps track of it through resets and
//! replugs.
//!
//! [`Intake`] turns bytes into frames, without I/O; [`OpenPort`] is where the bytes come from, a
//! real port or a pseudo-terminal; [`Stylus`] is the device that joins them. Commands are repeated
//! until the stylus answers, since it does not answer a damaged command.
//!
//! Values are fractions of the converter's full scale (see `intake::Value`) except for metal, which
//! is 0 or 1.

mod connection;
mod intake;
mod port;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use self::connection::{Connection, LinkErrors};
use super::camera::FlashLine;
use super::open::{RETRY, Retry};
use super::{Device, DeviceError, DeviceLink, DeviceState, StreamKind, StreamSpec};
use crate::ring::Sink;
use crate::scene::SourceId;

pub use intake::{Intake, IntakeEvent};
pub use port::{OpenPort, Selector};

pub(super) use connection::{BUFFER, ConnectionEnd, REPORT_EVERY, STALLED, read_some, warn_of};
pub(super) use intake::gap;
pub(super) use port::WAIT;

pub(crate) use intake::{Value, Wanted};
pub(crate) use port::Port;

/// Rate of the stylus's sampling clock in Hz.
pub const RATE_HZ: u32 = 10_000;

/// The streams of a scene that the stylus's channels make: acceleration (`ac`), forces (`fr`),
/// infrared (`ir`) and metal (`me`).
pub fn default_streams() -> Vec<Wanted> {
    let stream = |id: &str, channels: &[&str], value| Wanted {
        // These four are letters only.
        id: SourceId::new(id).expect("letters name a source"),
        channels: channels.iter().map(|name| (*name).to_string()).collect(),
        value,
    };
    vec![
        stream("ac", &["acc_x", "acc_y", "acc_z"], Value::FullScale),
        stream("fr", &["fsr_1", "fsr_2"], Value::FullScale),
        stream("ir", &["ir"], Value::FullScale),
        stream("me", &["metal"], Value::Unit),
    ]
}

/// The stylus, as one stream for each of its sources.
pub struct Stylus {
    name: String,
    port: Box<dyn OpenPort>,
    wanted: Vec<Wanted>,
    rate_hz: u32,
    light: Light,
}

impl Stylus {
    /// The stylus behind `port`, with [`default_streams`] at [`RATE_HZ`].
    pub fn new(port: impl OpenPort + 'static) -> Self {
        Self {
            name: port.name(),
            port: Box::new(port),
            wanted: default_streams(),
            rate_hz: RATE_HZ,
            light: Light::default(),
        }
    }

    /// Sets the streams, each of at least one channel.
    pub fn streams_of(mut self, wanted: Vec<Wanted>) -> Self {
        self.wanted = wanted;
        self.wanted.retain(|wanted| !wanted.channels.is_empty());
        self
    }

    /// Sets the rate that the stylus must have, in Hz.
    pub fn rate_hz(mut self, rate_hz: u32) -> Self {
        self.rate_hz = rate_hz.max(1);
        self
    }

    /// The switch of the camera's light.
    pub fn light(&self) -> Light {
        self.light.clone()
    }
}

impl Device for Stylus {
    fn name(&self) -> &str {
        &self.name
    }

    fn streams(&self) -> Vec<StreamSpec> {
        let kind = |wanted: &Wanted| StreamKind::Series {
            channels: wanted.channels.len(),
            rate_hz: f64::from(self.rate_hz),
        };
        let spec = |wanted: &Wanted| StreamSpec { id: wanted.id.clone(), kind: kind(wanted) };
        self.wanted.iter().map(spec).collect()
    }

    fn run(&mut self, sinks: &mut [Sink], link: &DeviceLink) -> Result<(), DeviceError> {
        let mut intake = Intake::new(self.wanted.clone(), self.rate_hz);
        let begin = Instant::now();
        keep_open(self.port.as_mut(), link, |port, path| {
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

/// Opens a line, passes it to `talk`, and opens it again whenever that lost it, until a stop.
///
/// # Errors
/// If trying again is useless.
pub(super) fn keep_open(
    line: &mut dyn OpenPort,
    link: &DeviceLink,
    mut talk: impl FnMut(Box<dyn Port>, String) -> ConnectionEnd,
) -> Result<(), DeviceError> {
    let (mut was_there, mut retry) = (false, Retry::new(RETRY));
    while !link.stopped() {
        match line.open() {
            Ok((port, path)) => {
                retry.opened();
                link.state(DeviceState::Opening, path.clone());
                match talk(port, path) {
                    ConnectionEnd::Stop => return Ok(()),
                    ConnectionEnd::Lost(why) => {
                        was_there = true;
                        link.state(DeviceState::Lost, why);
                    }
                }
            }
            Err(error) => {
                retry.failed(error, was_there, link)?;
                continue;
            }
        }
        link.sleep_until(Instant::now() + RETRY);
    }
    Ok(())
}

/// The time that the stylus has to confirm a switch of the light.
const CONFIRM: Duration = Duration::from_millis(500);

/// Switches the camera's light on the stylus; clones switch the same one.
#[derive(Clone, Debug, Default)]
pub struct Light(Arc<[AtomicBool; 2]>);

impl Light {
    /// Requests the light on or off; the driver repeats the command until the stylus confirms it.
    pub fn set(&self, on: bool) {
        self.0[0].store(on, Ordering::Release);
    }

    /// Whether the stylus last said that the light is on.
    pub fn is_on(&self) -> bool {
        self.0[1].load(Ordering::Acquire)
    }

    fn wanted(&self) -> bool {
        self.0[0].load(Ordering::Acquire)
    }

    /// Notes the state of the light that the stylus reports.
    fn confirm(&self, on: bool) {
        self.0[1].store(on, Ordering::Release);
    }
}

impl FlashLine for Light {
    fn switch(&mut self, on: bool) -> Result<(), String> {
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
