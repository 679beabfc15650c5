//! The real sound system: ALSA, through the crate cpal.

use std::any::Any;
use std::time::Duration;

use cpal::traits::{DeviceTrait, HostTrait, StreamTrait};
use cpal::{
    BufferSize, Data, Device, ErrorKind, I24, Sample, SampleFormat, StreamConfig,
    SupportedBufferSize, SupportedStreamConfigRange, U24,
};
use crossbeam_channel::Sender;

use super::{CallbackSink, RATE_HZ, Sound, StreamError};
use crate::device::OpenError;
use crate::device::list::ListedDevice;

/// Preferred number of frames per callback; 512 frames are 12 ms.
const PERIOD: u32 = 512;
/// Time between two checks of a stream's thread whether the device is still there.
const POLL: Duration = Duration::from_millis(500);

#[derive(Clone, Debug)]
pub struct Alsa {
    id: String,
}

impl Alsa {
    /// The microphone with this ALSA name from `surfaced devices`; `default` is the system's
    /// choice. A name with a card's number (`hw:0,0`) may mean another device once more devices are
    /// connected. Refuses ALSA's null device.
    pub fn new(id: impl Into<String>) -> Result<Self, OpenError> {
        let id = id.into();
        match id.split(':').next() {
            Some("null") => Err(OpenError::Unfit(format!(
                "`{id}` is ALSA's null device, which delivers silence as fast as it is read; \
                 choose a microphone from `surfaced devices`"
            ))),
            _ => Ok(Self { id }),
        }
    }
}

impl Sound for Alsa {
    fn open(
        &mut self,
        sink: CallbackSink,
        errors: Sender<StreamError>,
    ) -> Result<Box<dyn Any>, OpenError> {
        let said = |error: cpal::Error| explain(&self.id, &error);
        hush();
        let device = find(&self.id)?;
        let offers: Vec<_> = device.supported_input_configs().map_err(said)?.collect();
        let offer = choose(&offers).ok_or_else(|| unfit(&self.id, &offers))?;
        let format = offer.sample_format();
        let config = StreamConfig {
            channels: offer.channels(),
            sample_rate: RATE_HZ,
            buffer_size: match *offer.buffer_size() {
                SupportedBufferSize::Range { min, max } if min <= max => {
                    BufferSize::Fixed(PERIOD.clamp(min, max))
                }
                _ => BufferSize::Default,
            },
        };
        let stream = device
            .build_input_stream_raw(
                config,
                format,
                callback(format, usize::from(config.channels), sink),
                move |error| {
                    // Some errors repeat endlessly, so one that does not fit is dropped.
                    let _ = match error.kind() {
                        ErrorKind::Xrun => errors.try_send(StreamError::Overrun),
                        ErrorKind::RealtimeDenied | ErrorKind::DeviceChanged => Ok(()),
                        _ => errors.try_send(StreamError::Gone(error.to_string())),
                    };
                },
                Some(POLL),
            )
            .map_err(said)?;
        stream.play().map_err(said)?;
        Ok(Box::new(stream))
    }
}

/// Makes a callback that passes each block of the stream to `sink`, converted from `format`.
fn callback(
    format: SampleFormat,
    channels: usize,
    mut sink: CallbackSink,
) -> impl FnMut(&Data, &cpal::InputCallbackInfo) + Send + 'static {
    macro_rules! take {
        ($data:ident as $($format:ident: $type:ty),*) => {
            match format {
                $(SampleFormat::$format => {
                    if let Some(samples) = $data.as_slice::<$type>() {
                        sink.take(samples, channels, f32::from_sample);
                    }
                })*
                // `choose` accepts none of the other formats.
                _ => {}
            }
        };
    }
    move |data, _| {
        take!(data as I8: i8, I16: i16, I24: I24, I32: i32, U8: u8, U16: u16, U24: U24, U32: u32,
            F32: f32, F64: f64);
    }
}

/// Rank of a sample format, higher for better ones; `None` if it is not supported.
fn rank(format: SampleFormat) -> Option<u32> {
    use SampleFormat::{F32, F64, I8, I16, I24, I32, U8, U16, U24, U32};
    let order = [U8, I8, U16, I16, U24, I24, U32, F64, I32, F32];
    order.iter().position(|known| *known == format).map(|at| at as u32)
}

/// The best offer at 44.1 kHz: the one with fewest channels and, among those, the best format.
fn choose(offers: &[SupportedStreamConfigRange]) -> Option<SupportedStreamConfigRange> {
    let fits = |offer: &&SupportedStreamConfigRange| {
        (offer.min_sample_rate()..=offer.max_sample_rate()).contains(&RATE_HZ)
            && rank(offer.sample_format()).is_some()
    };
    let best = |offer: &&SupportedStreamConfigRange| {
        (std::cmp::Reverse(offer.channels()), rank(offer.sample_format()))
    };
    offers.iter().filter(fits).max_by_key(best).copied()
}

fn unfit(id: &str, offers: &[SupportedStreamConfigRange]) -> OpenError {
    let mut rates: Vec<_> =
        offers.iter().flat_map(|o| [o.min_sample_rate(), o.max_sample_rate()]).collect();
    rates.sort_unstable();
    rates.dedup();
    let rates = rates.iter().map(|rate| format!("{rate} Hz")).collect::<Vec<_>>().join(", ");
    OpenError::Unfit(format!(
        "microphone {id} does not support {RATE_HZ} Hz (it supports {rates}); put `plughw:` \
         before its name, or take `default`: then ALSA converts"
    ))
}

/// Keeps ALSA on this thread from writing to stderr: a search for an absent device writes many
/// lines, and the returned error is enough.
fn hush() {
    // From now on, ALSA writes to a buffer, which the next call replaces.
    let _ = alsa::Output::local_error_handler();
}

fn find(id: &str) -> Result<Device, OpenError> {
    let host = cpal::default_host();
    let absent = || OpenError::Absent(format!("microphone {id}"));
    if id == "default" {
        return host.default_input_device().ok_or_else(absent);
    }
    host.device_by_id(&cpal::DeviceId::new(host.id(), id)).ok_or_else(absent)
}

fn explain(id: &str, error: &cpal::Error) -> OpenError {
    let device = format!("microphone {id}");
    match error.kind() {
        ErrorKind::DeviceNotAvailable | ErrorKind::HostUnavailable => OpenError::Absent(device),
        ErrorKind::DeviceBusy => OpenError::Busy(device),
        ErrorKind::PermissionDenied => OpenError::Denied {
            device,
            hint: "add yourself to the group that may: sudo usermod -aG audio $USER, then log in \
                   again"
                .into(),
        },
        ErrorKind::UnsupportedOperation => {
            OpenError::Unfit(format!("{device} is for playing only; choose another one"))
        }
        _ => OpenError::Failed(format!("{device}: {error}")),
    }
}

/// Lists the microphones of this machine, with their permanent names and their problems.
pub fn microphones() -> Result<Vec<ListedDevice>, OpenError> {
    hush();
    let host = cpal::default_host();
    let devices = host.devices().map_err(|error| OpenError::Failed(error.to_string()))?;
    let listed = devices.filter(DeviceTrait::supports_input).filter_map(|device| {
        let id = device.id().ok()?.id().to_string();
        if !worth_listing(&id) {
            return None;
        }
        let problem = match device.supported_input_configs() {
            Err(error) => Some(explain(&id, &error).to_string()),
            Ok(offers) => {
                let offers: Vec<_> = offers.collect();
                choose(&offers).is_none().then(|| unfit(&id, &offers).to_string())
            }
        };
        Some(ListedDevice { name: device.to_string(), problem, node: None, id })
    });
    Ok(listed.collect())
}

/// Whether to list the name `id`, since ALSA has many names for one device. Of a card's names, only
/// the one is listed that converts rates (`plughw`) and holds the card's name instead of its
/// number. Most names without a card are listed, too.
fn worth_listing(id: &str) -> bool {
    const OTHERS: [&str; 8] =
        ["null", "lavrate", "samplerate", "speexrate", "speex", "upmix", "vdownmix", "oss"];
    match id.split_once(':') {
        None => !OTHERS.contains(&id),
        Some(("plughw", rest)) => {
            let card = rest.strip_prefix("CARD=").and_then(|rest| rest.split(',').next());
            card.is_some_and(|card| card.parse::<u32>().is_err())
        }
        Some(_) => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn offer(channels: u16, rates: (u32, u32), format: SampleFormat) -> SupportedStreamConfigRange {
        let buffer = SupportedBufferSize::Unknown;
        SupportedStreamConfigRange::new(channels, rates.0, rates.1, buffer, format)
    }

    #[test]
    fn the_null_device_is_refused_by_name() {
        for id in ["null", "null:CARD=0"] {
            assert!(Alsa::new(id).unwrap_err().to_string().contains("null device"));
        }
        assert!(Alsa::new("default").is_ok());
    }

    #[test]
    fn one_channel_at_44100_is_chosen_in_the_best_format() {
        let offers = [
            offer(2, (8_000, 96_000), SampleFormat::F32),
            offer(1, (48_000, 48_000), SampleFormat::F32),
            offer(1, (44_100, 44_100), SampleFormat::I16),
            offer(1, (8_000, 48_000), SampleFormat::I32),
            offer(1, (44_100, 44_100), SampleFormat::DsdU8),
        ];
        assert_eq!(choose(&offers), Some(offers[3]));
        assert_eq!(choose(&offers[1..2]), None);
        let said = unfit("hw:CARD=mic", &offers[1..2]).to_string();
        assert!(said.contains("48000 Hz") && said.contains("plughw:"), "{said}");
    }

    #[test]
    fn of_each_card_one_name_is_listed_that_stays() {
        let listed = ["default", "pulse", "plughw:CARD=Device,DEV=0"];
        let not = ["null", "hw:CARD=Device,DEV=0", "plughw:CARD=0,DEV=0", "front:CARD=Device"];
        assert!(listed.into_iter().all(worth_listing));
        assert!(!not.into_iter().any(worth_listing));
    }

    #[test]
    fn every_format_has_silence_at_0_and_full_scale_at_1() {
        assert_eq!([i8::MIN, 0, 64].map(f32::from_sample), [-1.0, 0.0, 0.5]);
        assert_eq!([i16::MIN, 0, 16_384].map(f32::from_sample), [-1.0, 0.0, 0.5]);
        assert_eq!([i32::MIN, 0, 1 << 30].map(f32::from_sample), [-1.0, 0.0, 0.5]);
        assert_eq!([0_u8, 128, 192].map(f32::from_sample), [-1.0, 0.0, 0.5]);
        assert_eq!([0_u16, 32_768, 49_152].map(f32::from_sample), [-1.0, 0.0, 0.5]);
        assert_eq!([0_u32, 1 << 31, 3 << 30].map(f32::from_sample), [-1.0, 0.0, 0.5]);
        assert_eq!([-1.0_f32, 0.0, 0.5].map(f32::from_sample), [-1.0, 0.0, 0.5]);
        assert_eq!([-1.0_f64, 0.0, 0.5].map(f32::from_sample), [-1.0, 0.0, 0.5]);
        assert_eq!(I24::new(-8_388_608).map(f32::from_sample), Some(-1.0));
        assert_eq!(U24::new(0).map(f32::from_sample), Some(-1.0));
        assert_eq!(U24::new(8_388_608).map(f32::from_sample), Some(0.0));
    }
}
