//! A stylus on a pseudo-terminal, which obeys, and misbehaves on request.

use std::io::{Read, Write};
use std::path::Path;
use std::time::{Duration, Instant};

use serialport::{SerialPort, TTYPort};
use surfaced_wire::{
    Channel, Command, Decoder, Hello, MAX_ENCODED, Message, Samples, Status, encode,
};

pub const RATE_HZ: u64 = 10_000;
pub const NAMES: [&str; 7] = ["acc_x", "acc_y", "acc_z", "fsr_1", "fsr_2", "ir", "metal"];

/// The value of a sample by its index and channel.
pub type Values = Box<dyn Fn(u64, usize) -> i16 + Send>;

/// A value that shows index and channel.
pub fn value(index: u64, channel: usize) -> i16 {
    (index % 4000) as i16 * 7 + channel as i16
}

/// A stylus on the master's side; dropping it unplugs it.
pub struct Fake {
    line: TTYPort,
    _slave: TTYPort,
    decoder: Decoder,
    /// Names of its channels.
    pub names: Vec<&'static str>,
    /// Index of the next sample, while it samples.
    pub next: Option<u64>,
    /// Commands that it ignores from now on.
    pub deaf: usize,
    /// The commands that it received.
    pub commands: Vec<Command>,
    /// The value of one step of each channel of [`NAMES`].
    pub scales: [f32; 7],
    /// Samples as many times as fast.
    pub speed: f64,
    values: Values,
}

impl Fake {
    /// Plugs a stylus in, so that `link` leads to it; its samples are those of [`value`].
    pub fn plug(link: &Path) -> Self {
        Self::with(link, Box::new(value))
    }

    /// The same with other samples.
    pub fn with(link: &Path, values: Values) -> Self {
        let (mut line, slave) = TTYPort::pair().unwrap();
        line.set_timeout(Duration::from_millis(1)).unwrap();
        let _ = std::fs::remove_file(link);
        std::os::unix::fs::symlink(slave.name().unwrap(), link).unwrap();
        let names = NAMES.to_vec();
        let (decoder, commands) = (Decoder::new(), Vec::new());
        Self {
            line,
            _slave: slave,
            decoder,
            names,
            next: None,
            deaf: 0,
            commands,
            scales: [1.0; 7],
            speed: 1.0,
            values,
        }
    }

    pub fn put(&mut self, mut bytes: &[u8]) {
        let limit = Instant::now() + Duration::from_secs(120);
        while !bytes.is_empty() && Instant::now() < limit {
            bytes = &bytes[self.line.write(bytes).unwrap_or(0)..];
        }
        assert!(bytes.is_empty(), "nobody reads");
    }

    fn say(&mut self, message: &Message<'_>) {
        let mut out = [0; MAX_ENCODED];
        let n = encode(message, &mut out).unwrap();
        self.put(&out[..n]);
    }

    pub fn hello(&mut self) {
        let place = |name: &str| NAMES.iter().position(|other| *other == name).unwrap();
        let channel =
            |name: &&'static str| Channel { name, scale: self.scales[place(name)], unit: "" };
        let channels: Vec<_> = self.names.iter().map(channel).collect();
        let channels = channels[..].into();
        let hello =
            Hello { serial: "T1", firmware: [0, 1, 0], sample_rate_hz: RATE_HZ as u32, channels };
        self.say(&Message::Hello(hello));
    }

    pub fn samples(&mut self, count: u64) {
        let first = self.next.unwrap();
        let wide = self.names.len();
        let channel = |name: &str| NAMES.iter().position(|n| *n == name).unwrap();
        let places: Vec<_> = self.names.iter().map(|name| channel(name)).collect();
        let value = &self.values;
        let values: Vec<u8> = (first..first + count)
            .flat_map(|i| places.iter().flat_map(move |&c| value(i, c).to_le_bytes()))
            .collect();
        let samples = Samples::new(first, wide, &values).unwrap();
        self.say(&Message::Samples(samples));
        self.next = Some(first + count);
    }

    pub fn obey(&mut self) {
        let mut bytes = [0; 256];
        let Ok(n) = self.line.read(&mut bytes) else { return };
        let (mut input, mut received) = (&bytes[..n], Vec::new());
        while let Some(message) = self.decoder.next(&mut input) {
            match message {
                Ok(Message::Command(command)) => received.push(command),
                other => panic!("{other:?}"),
            }
        }
        for command in received {
            self.commands.push(command);
            if self.deaf > 0 {
                self.deaf -= 1;
                continue;
            }
            match command {
                Command::Start => {
                    self.hello();
                    self.next.get_or_insert(0);
                }
                Command::Identify => self.hello(),
                Command::Stop => self.next = None,
                Command::LightOff | Command::LightOn => {}
            }
            let light = command == Command::LightOn;
            let sampling = self.next.is_some();
            self.say(&Message::Status(Status { sampling, light, ..Status::default() }));
        }
    }

    /// Samples in real time, and obeys.
    pub fn serve(&mut self, seconds: f64) {
        let (begin, mut sent) = (Instant::now(), 0);
        let rate_hz = RATE_HZ as f64 * self.speed;
        while begin.elapsed().as_secs_f64() < seconds {
            self.obey();
            let due = (begin.elapsed().as_secs_f64() * rate_hz) as u64;
            if self.next.is_none() {
                sent = due;
            }
            while self.next.is_some() && sent < due {
                self.samples(32);
                sent += 32;
            }
        }
    }

    /// Serves until it is started.
    pub fn wait_for_start(&mut self) {
        let limit = Instant::now() + Duration::from_secs(120);
        while self.next.is_none() {
            assert!(Instant::now() < limit, "no start");
            self.obey();
        }
    }
}
