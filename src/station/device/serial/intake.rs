//! Decodes bytes of the serial line into frames of the streams, without I/O and without a clock.
//!
//! Indexes count ticks of the stylus's sampling clock, so a jump of the index is a gap of that
//! length. After a restart (reset or replug), the index begins again, and arrival times give the
//! length of the gap: at least [`LEAST_RESTART_S`], so that it is always reported.

use surfaced_wire::{DecodeError, Decoder, Hello, Message, Samples, Status};

use crate::scene::SourceId;

/// Least length of the gap at a restart, in seconds: too long for a scan to go on across it.
pub(in crate::device) const LEAST_RESTART_S: f64 = 2e-3;
/// Seconds by which a jump of the index may be longer than the silence before it, since data that
/// the system had buffered arrive late. A longer jump counts as a restart.
const LATEST_S: f64 = 10.0;
/// Most seconds by which index and arrival time may differ after the line was reopened.
const ANEW_S: f64 = 1.0;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Value {
    /// A fraction of the converter's full scale, `v / 32768`. A 16-bit WAV file gives the same
    /// fractions, so live data agree with datasets like LMT108.
    #[default]
    FullScale,
    /// A value in the unit from the stylus's hello: `v × scale`.
    Unit,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Wanted {
    pub id: SourceId,
    /// The stream's channels, in order, by their names in the stylus's hello; at least one.
    pub channels: Vec<String>,
    pub value: Value,
}

#[derive(Debug)]
pub enum IntakeEvent<'a> {
    /// Interleaved frames of a stream; `stream` is its index among the wanted streams.
    Frames {
        stream: usize,
        samples: &'a [f32],
    },
    Missing {
        stream: usize,
        frames: u64,
    },
    /// A usable stylus has introduced itself. `who` is its serial number and firmware, `lacking`
    /// the streams whose channels it lacks, `changed` whether its channels have changed.
    Hello {
        who: String,
        lacking: Vec<SourceId>,
        changed: bool,
    },
    /// The device that introduced itself cannot be used; the text gives the reason.
    Refused(String),
    /// The index began again: the stylus was reset, or the line was lost for a long time.
    Restarted,
    Status(Status),
    /// A frame of the serial line was damaged, or its format is unknown.
    Damaged(DecodeError),
}

/// For each channel of a stream: the index of its value in a sample, and the value's factor.
type StreamPlace = Vec<(usize, f32)>;

/// The part of a stylus's accepted introduction (hello) that is needed to decode samples.
#[derive(Clone, Debug, PartialEq)]
struct Table {
    channels: usize,
    /// The places of each wanted stream; `None` if the stylus lacks one of the stream's channels.
    places: Vec<Option<StreamPlace>>,
}

#[derive(Debug, Default)]
pub struct Intake {
    wanted: Vec<Wanted>,
    rate_hz: u32,
    decoder: Decoder,
    table: Option<Table>,
    /// Whether samples can be decoded: the last hello was accepted, and samples fit its table.
    pub(super) introduced: bool,
    /// Expected index of the next sample; `None` before the first sample.
    next: Option<u64>,
    last_s: f64,
    reopened: bool,
    /// Number of frames that each stream lacks so far while the stylus has no channels for it.
    lag: Vec<u64>,
    block: Vec<f32>,
    /// Number of frames of the line that were damaged or of an unknown format.
    pub(super) damaged: u64,
}

impl Intake {
    /// Decodes the `wanted` streams from samples taken at `rate_hz`.
    pub fn new(wanted: Vec<Wanted>, rate_hz: u32) -> Self {
        Self { lag: vec![0; wanted.len()], wanted, rate_hz, ..Self::default() }
    }

    /// To be called when the line was reopened: the stylus must then introduce itself again.
    pub fn reopened(&mut self) {
        self.decoder.reset();
        self.introduced = false;
        self.reopened = true;
    }

    /// Decodes bytes that arrived at `now_s` (seconds of any clock that never goes back), and
    /// passes the events in them to `on`, in order. Returns whether samples could be decoded.
    pub fn feed(&mut self, bytes: &[u8], now_s: f64, mut on: impl FnMut(IntakeEvent<'_>)) -> bool {
        let mut any = false;
        let mut input = bytes;
        // Messages borrow from the decoder, so it is taken out while `self` is used.
        let mut decoder = std::mem::take(&mut self.decoder);
        while let Some(result) = decoder.next(&mut input) {
            match result {
                Ok(Message::Samples(samples)) => any |= self.samples(&samples, now_s, &mut on),
                Ok(Message::Hello(hello)) => self.hello(&hello, &mut on),
                Ok(Message::Status(status)) => on(IntakeEvent::Status(status)),
                // Ignores commands: they are echoes, since the stylus sends none.
                Ok(Message::Command(_)) => {}
                Err(error) => {
                    self.damaged += 1;
                    on(IntakeEvent::Damaged(error));
                }
            }
        }
        self.decoder = decoder;
        any
    }

    fn hello(&mut self, hello: &Hello<'_>, on: &mut impl FnMut(IntakeEvent<'_>)) {
        let table = match self.table_of(hello) {
            Ok(table) => table,
            Err(why) => {
                self.introduced = false;
                return on(IntakeEvent::Refused(why));
            }
        };
        let changed = self.table.as_ref().is_some_and(|last| *last != table);
        if changed || !self.introduced {
            let lacking = self.wanted.iter().zip(&table.places).filter(|(_, p)| p.is_none());
            let lacking = lacking.map(|(wanted, _)| wanted.id.clone()).collect();
            let [major, minor, patch] = hello.firmware;
            let who = format!("{}, firmware {major}.{minor}.{patch}", hello.serial);
            on(IntakeEvent::Hello { who, lacking, changed });
        }
        (self.table, self.introduced) = (Some(table), true);
    }

    /// The table for a hello. An error says why its device cannot be used.
    fn table_of(&self, hello: &Hello<'_>) -> Result<Table, String> {
        if hello.sample_rate_hz != self.rate_hz {
            return Err(format!(
                "it samples at {} Hz, but {} Hz is expected; change rate_hz of the stylus in the \
                 configuration, or its firmware",
                hello.sample_rate_hz, self.rate_hz
            ));
        }
        let unusable = |scale: f32| !(scale * f32::from(i16::MIN)).is_finite();
        if let Some(channel) = hello.channels.iter().find(|channel| unusable(channel.scale)) {
            return Err(format!(
                "its channel {} has a scale of {}, which makes infinite values; mend its firmware",
                channel.name, channel.scale
            ));
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
            wanted.channels.iter().map(|name| find(name, wanted.value)).collect::<Option<_>>()
        };
        let places: Vec<Option<StreamPlace>> = self.wanted.iter().map(place).collect();
        if places.iter().all(Option::is_none) {
            let names: Vec<_> = hello.channels.iter().map(|c| c.name).collect();
            return Err(format!(
                "it has the channels {}, and none of the streams can be made of them; see \
                 [stylus.sources] in the configuration",
                names.join(", ")
            ));
        }
        Ok(Table { channels: hello.channels.len(), places })
    }

    fn samples(
        &mut self,
        samples: &Samples<'_>,
        now_s: f64,
        on: &mut impl FnMut(IntakeEvent<'_>),
    ) -> bool {
        // Samples of another width belong to another table, so decoding waits for the next hello.
        let fits = |table: &&Table| self.introduced && table.channels == samples.channels();
        let Some(table) = self.table.as_ref().filter(fits) else {
            self.introduced = false;
            return false;
        };
        let count = samples.count() as u64;
        let (silent_s, rate_hz) = (now_s - self.last_s, f64::from(self.rate_hz));
        let (missing, restarted) =
            gap(self.next, samples.first_index(), count, silent_s, rate_hz, self.reopened);
        if restarted {
            on(IntakeEvent::Restarted);
        }
        self.next = Some(samples.next_index());
        self.last_s = now_s;
        self.reopened = false;
        for (stream, place) in table.places.iter().enumerate() {
            let Some(picks) = place else {
                self.lag[stream] += missing + count;
                continue;
            };
            let frames = missing + std::mem::take(&mut self.lag[stream]);
            if frames > 0 {
                on(IntakeEvent::Missing { stream, frames });
            }
            self.block.clear();
            for sample in samples.bytes().chunks_exact(2 * table.channels) {
                // Indexing is safe: `at` is a channel of the table, which is as wide as a sample.
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

/// The number of samples lost before `count` samples whose first index is `first`, and whether the
/// index restarted. `next` is the index expected.
pub(in crate::device) fn gap(
    next: Option<u64>,
    first: u64,
    count: u64,
    silent_s: f64,
    rate_hz: f64,
    reopened: bool,
) -> (u64, bool) {
    let Some(next) = next else { return (0, false) };
    // The casts saturate; a negative silence, from a clock that went back, counts as 0.
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
