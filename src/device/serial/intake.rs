//! From bytes on the line to frames of the streams: no I/O, no clock.
//!
//! Indexes count the stylus's sampling clock, so a jump in them is the length of a gap. Where they
//! start again (a reset, a replug) the length is taken from the arrival times instead, and is never
//! less than [`LEAST_RESTART_S`], so that such a gap is always reported.

use surfaced_wire::{DecodeError, Decoder, Hello, Message, Samples, Status};

use crate::scene::SourceId;

/// A restart counts as a gap of at least this many seconds: more than a scan bridges.
pub const LEAST_RESTART_S: f64 = 2e-3;
/// A jump of the index may be longer than the silence before it by this much, in seconds, since
/// what the system had buffered arrives late. Beyond, the index is not believed.
const LATEST_S: f64 = 10.0;
/// After the line was reopened, index and arrival times may differ by this much, in seconds.
const ANEW_S: f64 = 1.0;

/// The unit of a stream's values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Value {
    /// A fraction of the converter's full scale, `v / 32768`: what a 16-bit WAV file of the same
    /// values reads as, so that live data and LMT108-like libraries agree.
    #[default]
    FullScale,
    /// The unit that hello gives: `v × scale`.
    Unit,
}

/// A stream to be made of the stylus's channels.
#[derive(Clone, Debug, PartialEq)]
pub struct Wanted {
    pub id: SourceId,
    /// Names of its channels in the stylus's table, in the stream's order; at least one.
    pub channels: Vec<String>,
    pub value: Value,
}

/// Events from the line.
#[derive(Debug)]
pub enum IntakeEvent<'a> {
    /// Frames of a stream, interleaved.
    Frames {
        /// number of the stream among those wanted
        stream: usize,
        samples: &'a [f32],
    },
    /// Frames of a stream that never arrived.
    Missing {
        /// number of the stream among those wanted
        stream: usize,
        frames: u64,
    },
    /// A stylus that can be used has introduced itself.
    Hello {
        /// serial number and firmware
        who: String,
        /// streams that it has no channels for
        lacking: Vec<SourceId>,
        /// whether its channels differ from those of its last hello
        changed: bool,
    },
    /// The device that introduced itself cannot be used: the reason.
    Refused(String),
    /// The index restarted: the stylus was reset, or the line lost it for long.
    Restarted,
    Status(Status),
    /// A frame was damaged, or has an unknown format.
    Damaged(DecodeError),
}

/// One stream's place in a sample of the stylus.
#[derive(Clone, Debug, PartialEq)]
struct StreamPlace {
    /// For each channel of the stream: channel of the sample, and its factor.
    picks: Vec<(usize, f32)>,
}

/// The accepted part of a hello.
#[derive(Clone, Debug, PartialEq)]
struct Table {
    channels: usize,
    /// For each stream wanted; none where the stylus lacks a channel of it.
    places: Vec<Option<StreamPlace>>,
}

/// Counts of unused input.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Unused {
    /// Frames of the wire that were damaged or not understood.
    pub damaged: u64,
    /// Samples that came before a hello that describes them.
    pub unknown: u64,
    pub restarts: u64,
}

/// Turns bytes into frames.
#[derive(Debug)]
pub struct Intake {
    wanted: Vec<Wanted>,
    rate_hz: u32,
    decoder: Decoder,
    table: Option<Table>,
    /// The table of the last hello, to see whether the next one differs.
    last_table: Option<Table>,
    /// Index of the next sample; none before the first.
    next: Option<u64>,
    /// When the last samples came, in seconds.
    last_s: f64,
    reopened: bool,
    /// Frames by which a stream without channels lags behind the others.
    lag: Vec<u64>,
    block: Vec<f32>,
    unused: Unused,
}

impl Intake {
    /// Makes the streams `wanted` from input sampled at `rate_hz`.
    pub fn new(wanted: Vec<Wanted>, rate_hz: u32) -> Self {
        Self {
            lag: vec![0; wanted.len()],
            wanted,
            rate_hz,
            decoder: Decoder::new(),
            table: None,
            last_table: None,
            next: None,
            last_s: 0.0,
            reopened: false,
            block: Vec::new(),
            unused: Unused::default(),
        }
    }

    pub fn unused(&self) -> Unused {
        self.unused
    }

    /// Whether samples are understood: a hello was accepted.
    pub fn introduced(&self) -> bool {
        self.table.is_some()
    }

    /// Notes that the line was reopened: the stylus must introduce itself again.
    pub fn reopened(&mut self) {
        self.decoder.reset();
        self.table = None;
        self.reopened = true;
    }

    /// Takes bytes that came at `now_s` (seconds of any clock that does not go back), and passes
    /// what they hold to `on`, in order. Returns whether there were samples that are understood.
    pub fn feed(&mut self, bytes: &[u8], now_s: f64, mut on: impl FnMut(IntakeEvent<'_>)) -> bool {
        let mut any = false;
        let mut input = bytes;
        // The decoder is taken out, so that a message that borrows from it leaves `self` usable.
        let mut decoder = std::mem::take(&mut self.decoder);
        while let Some(result) = decoder.next(&mut input) {
            match result {
                Ok(Message::Samples(samples)) => any |= self.samples(&samples, now_s, &mut on),
                Ok(Message::Hello(hello)) => self.hello(&hello, &mut on),
                Ok(Message::Status(status)) => on(IntakeEvent::Status(status)),
                // An echo; the stylus sends no commands.
                Ok(Message::Command(_)) => {}
                Err(error) => {
                    self.unused.damaged += 1;
                    on(IntakeEvent::Damaged(error));
                }
            }
        }
        self.decoder = decoder;
        any
    }

    fn hello(&mut self, hello: &Hello<'_>, on: &mut impl FnMut(IntakeEvent<'_>)) {
        if hello.sample_rate_hz != self.rate_hz {
            self.table = None;
            return on(IntakeEvent::Refused(format!(
                "it samples at {} Hz, but {} Hz is expected; change rate_hz of the stylus in the \
                 configuration, or its firmware",
                hello.sample_rate_hz, self.rate_hz
            )));
        }
        let unusable = |scale: f32| !(scale * f32::from(i16::MIN)).is_finite();
        if let Some(channel) = hello.channels.iter().find(|channel| unusable(channel.scale)) {
            self.table = None;
            return on(IntakeEvent::Refused(format!(
                "its channel {} has a scale of {}, which makes infinite values; mend its firmware",
                channel.name, channel.scale
            )));
        }
        let find = |name: &str, value| {
            let (at, channel) = hello.channels.iter().enumerate().find(|(_, c)| c.name == name)?;
            let factor = match value {
                Value::FullScale => 1.0 / 32_768.0,
                Value::Unit => channel.scale,
            };
            Some((at, factor))
        };
        let place = |wanted: &Wanted| {
            let picks: Option<Vec<_>> =
                wanted.channels.iter().map(|name| find(name, wanted.value)).collect();
            picks.filter(|picks| !picks.is_empty()).map(|picks| StreamPlace { picks })
        };
        let places: Vec<_> = self.wanted.iter().map(place).collect();
        if places.iter().all(Option::is_none) {
            let names: Vec<_> = hello.channels.iter().map(|c| c.name).collect();
            self.table = None;
            return on(IntakeEvent::Refused(format!(
                "it has the channels {}, and none of the streams can be made of them; see \
                 [stylus.sources] in the configuration",
                names.join(", ")
            )));
        }
        let lacking = self.wanted.iter().zip(&places).filter(|(_, place)| place.is_none());
        let lacking = lacking.map(|(wanted, _)| wanted.id.clone()).collect();
        let table = Table { channels: hello.channels.len(), places };
        let known = self.table.as_ref() == Some(&table);
        let changed = self.last_table.as_ref().is_some_and(|last| *last != table);
        self.last_table = Some(table.clone());
        self.table = Some(table);
        if !known {
            let [major, minor, patch] = hello.firmware;
            let who = format!("{}, firmware {major}.{minor}.{patch}", hello.serial);
            on(IntakeEvent::Hello { who, lacking, changed });
        }
    }

    fn samples(
        &mut self,
        samples: &Samples<'_>,
        now_s: f64,
        on: &mut impl FnMut(IntakeEvent<'_>),
    ) -> bool {
        // A frame of another width than the table's belongs to another table: wait for its hello.
        let fits = |table: &&Table| table.channels == samples.channels();
        let Some(table) = self.table.as_ref().filter(fits) else {
            self.unused.unknown += samples.count() as u64;
            self.table = None;
            return false;
        };
        let count = samples.count() as u64;
        let (silent_s, rate_hz) = (now_s - self.last_s, f64::from(self.rate_hz));
        let (missing, restarted) =
            gap(self.next, samples.first_index(), count, silent_s, rate_hz, self.reopened);
        if restarted {
            self.unused.restarts += 1;
            on(IntakeEvent::Restarted);
        }
        self.next = Some(samples.next_index());
        self.last_s = now_s;
        self.reopened = false;
        for (stream, place) in table.places.iter().enumerate() {
            let Some(StreamPlace { picks }) = place else {
                self.lag[stream] += missing + count;
                continue;
            };
            let frames = missing + std::mem::take(&mut self.lag[stream]);
            if frames > 0 {
                on(IntakeEvent::Missing { stream, frames });
            }
            self.block.clear();
            for sample in samples.bytes().chunks_exact(2 * table.channels) {
                // Every pick is a channel of the table, whose width is the sample's.
                let value = |&(at, factor): &(usize, f32)| {
                    f32::from(i16::from_le_bytes([sample[2 * at], sample[2 * at + 1]])) * factor
                };
                self.block.extend(picks.iter().map(value));
            }
            on(IntakeEvent::Frames { stream, samples: &self.block });
        }
        true
    }
}

/// The number of samples missing before `count` samples that begin with index `first`, and whether
/// their index restarted.
pub(in crate::device) fn gap(
    next: Option<u64>,
    first: u64,
    count: u64,
    silent_s: f64,
    rate_hz: f64,
    reopened: bool,
) -> (u64, bool) {
    let Some(next) = next else { return (0, false) };
    // Casts saturate; a clock that went back counts as no silence.
    let by_time = (silent_s * rate_hz).round().max(0.0) as u64;
    let by_time = by_time.saturating_sub(count);
    if let Some(by_index) = first.checked_sub(next) {
        let most = if reopened { ANEW_S } else { LATEST_S } * rate_hz;
        let believed = by_index <= by_time.saturating_add(most as u64)
            && !(reopened && by_time > by_index.saturating_add(most as u64));
        if by_index == 0 && !reopened || believed {
            return (by_index, false);
        }
    }
    (by_time.max((LEAST_RESTART_S * rate_hz).ceil() as u64), true)
}

#[cfg(test)]
mod tests;
