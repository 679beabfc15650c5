//! The messages between stylus and daemon, and their parsing.

use crate::{DecodeError, Hello, Samples, VERSION};

/// Codes of the kinds of messages; the code is the second byte of a frame.
pub(crate) mod kind {
    pub const HELLO: u8 = 0x01;
    pub const SAMPLES: u8 = 0x02;
    pub const STATUS: u8 = 0x03;
    pub const COMMAND: u8 = 0x10;
}

/// A message: the content of one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Message<'a> {
    /// The stylus introduces itself to the daemon.
    Hello(Hello<'a>),
    /// Measured values of the stylus.
    Samples(Samples<'a>),
    /// The state of the stylus.
    Status(Status),
    /// A command of the daemon to the stylus.
    Command(Command),
}

/// The state of the stylus.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Status {
    /// Number of samples sent since the start.
    pub samples_sent: u64,
    /// Number of ticks since the start at which no sample was taken.
    pub overruns: u32,
    /// Number of samples since the start that were taken, but lost for lack of buffer space.
    pub dropped: u32,
    /// Temperature of the microcontroller in 1/100 °C, above −327.68 °C; `None` if not measured.
    pub temperature_centi_c: Option<i16>,
    /// Whether the stylus is sampling.
    pub sampling: bool,
    /// Whether the camera's light is on.
    pub light: bool,
    /// Whether the crystal oscillator failed, so that the sample rate is accurate to 1 % only.
    pub crystal_failed: bool,
}

/// A command of the daemon to the stylus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Command {
    /// Send a hello, then samples; their indexes start from 0.
    Start = 1,
    /// Send the samples taken so far, then stop sending samples.
    Stop = 2,
    /// Send a hello.
    Identify = 3,
    /// Switch the camera's light off.
    LightOff = 4,
    /// Switch the camera's light on.
    LightOn = 5,
}

/// The value that is sent as the temperature if none was measured.
const NO_TEMPERATURE: i16 = i16::MIN;

impl Status {
    /// Length of a status message's body in bytes.
    pub(crate) const LEN: usize = 19;

    pub(crate) fn to_bytes(self) -> [u8; Self::LEN] {
        let mut body = [0; Self::LEN];
        body[..8].copy_from_slice(&self.samples_sent.to_le_bytes());
        body[8..12].copy_from_slice(&self.overruns.to_le_bytes());
        body[12..16].copy_from_slice(&self.dropped.to_le_bytes());
        let temperature = self.temperature_centi_c.unwrap_or(NO_TEMPERATURE);
        body[16..18].copy_from_slice(&temperature.to_le_bytes());
        body[18] = u8::from(self.sampling)
            | u8::from(self.light) << 1
            | u8::from(self.crystal_failed) << 2;
        body
    }

    fn parse(body: &[u8]) -> Result<Self, &'static str> {
        const WRONG_LENGTH: &str = "a status has 19 bytes";
        let (sent, rest) = body.split_first_chunk::<8>().ok_or(WRONG_LENGTH)?;
        let (overruns, rest) = rest.split_first_chunk::<4>().ok_or(WRONG_LENGTH)?;
        let (dropped, rest) = rest.split_first_chunk::<4>().ok_or(WRONG_LENGTH)?;
        let (temperature, rest) = rest.split_first_chunk::<2>().ok_or(WRONG_LENGTH)?;
        let &[flags] = rest else { return Err(WRONG_LENGTH) };
        if flags > 7 {
            return Err("a status has flags 0 to 2 only");
        }
        let temperature = i16::from_le_bytes(*temperature);
        Ok(Self {
            samples_sent: u64::from_le_bytes(*sent),
            overruns: u32::from_le_bytes(*overruns),
            dropped: u32::from_le_bytes(*dropped),
            temperature_centi_c: (temperature != NO_TEMPERATURE).then_some(temperature),
            sampling: flags & 1 != 0,
            light: flags & 2 != 0,
            crystal_failed: flags & 4 != 0,
        })
    }
}

impl Command {
    /// All commands.
    pub const ALL: [Self; 5] =
        [Self::Start, Self::Stop, Self::Identify, Self::LightOff, Self::LightOn];

    fn parse(body: &[u8]) -> Result<Self, &'static str> {
        let &[code] = body else { return Err("a command has one byte") };
        Self::ALL.into_iter().find(|c| *c as u8 == code).ok_or("an unknown command")
    }
}

impl<'a> Message<'a> {
    /// Parses a frame whose checksum has been checked and removed.
    pub(crate) fn parse(frame: &'a [u8]) -> Result<Self, DecodeError> {
        let (&[version, kind], body) = frame
            .split_first_chunk::<2>()
            .ok_or(DecodeError::TooShort { bytes: frame.len() + crate::crc::LEN })?;
        if version != VERSION {
            return Err(DecodeError::Version(version));
        }
        match kind {
            kind::SAMPLES => Samples::parse(body).map(Message::Samples),
            kind::HELLO => Hello::parse(body).map(Message::Hello),
            kind::STATUS => Status::parse(body).map(Message::Status),
            kind::COMMAND => Command::parse(body).map(Message::Command),
            _ => return Err(DecodeError::Kind(kind)),
        }
        .map_err(DecodeError::Body)
    }
}
