//! Properties of every stream, however it is cut and damaged.

use proptest::collection::vec;
use proptest::prelude::*;
use surfaced_wire::{
    Channel, Command, DecodeError, Decoder, Hello, MAX_ENCODED, Message, Samples, Status, cobs,
    encode,
};

/// A message that owns its data, so that strategies can make it.
#[derive(Debug, Clone)]
enum Sent {
    Samples { first_index: u64, channels: usize, bytes: Vec<u8> },
    Hello { serial: String, firmware: [u8; 3], rate: u32, channels: Vec<(String, f32, String)> },
    Status(Status),
    Command(Command),
}

fn sent() -> impl Strategy<Value = Sent> {
    // Small values hold zero bytes, large values hardly any: COBS must handle both.
    let byte = prop_oneof![Just(0u8), Just(0xFF), any::<u8>(), 1u8..=255];
    let samples = (0..u64::MAX / 2, 1usize..=16, 1usize..=30).prop_flat_map(move |(i, c, k)| {
        vec(byte.clone(), 2 * c * k).prop_map(move |bytes| Sent::Samples {
            first_index: i,
            channels: c,
            bytes,
        })
    });
    let channel = ("[a-zµ²]{0,8}", -1e6f32..1e6, "[A-Z/°]{0,5}");
    let hello = ("[0-9A-F]{0,32}", any::<[u8; 3]>(), 1u32.., vec(channel, 1..=16)).prop_map(
        |(serial, firmware, rate, channels)| Sent::Hello { serial, firmware, rate, channels },
    );
    let status = (
        any::<u64>(),
        any::<[u32; 2]>(),
        proptest::option::of(-32767i16..=32767),
        any::<[bool; 3]>(),
    )
        .prop_map(|(samples_sent, [overruns, dropped], temperature_centi_c, flags)| {
            let [sampling, light, crystal_failed] = flags;
            Sent::Status(Status {
                samples_sent,
                overruns,
                dropped,
                temperature_centi_c,
                sampling,
                light,
                crystal_failed,
            })
        });
    let command = proptest::sample::select(&Command::ALL[..]).prop_map(Sent::Command);
    prop_oneof![4 => samples, 1 => hello, 1 => status, 1 => command]
}

impl Sent {
    /// Calls `with` on the message; its parts live only during the call.
    fn message<T>(&self, with: impl FnOnce(&Message<'_>) -> T) -> T {
        match self {
            Sent::Samples { first_index, channels, bytes } => with(&Message::Samples(
                Samples::new(*first_index, *channels, bytes).expect("made valid"),
            )),
            Sent::Hello { serial, firmware, rate, channels } => {
                let table: Vec<Channel<'_>> = channels
                    .iter()
                    .map(|(name, scale, unit)| Channel { name, scale: *scale, unit })
                    .collect();
                with(&Message::Hello(Hello {
                    serial,
                    firmware: *firmware,
                    sample_rate_hz: *rate,
                    channels: table[..].into(),
                }))
            }
            Sent::Status(status) => with(&Message::Status(*status)),
            Sent::Command(command) => with(&Message::Command(*command)),
        }
    }

    fn on_the_line(&self) -> Vec<u8> {
        let mut out = [0; MAX_ENCODED];
        let n = self.message(|m| encode(m, &mut out)).expect("it fits");
        out[..n].to_vec()
    }
}

/// All results of a decoder that receives `stream` in parts, cut at `cuts`: messages encoded again,
/// and errors.
fn received(stream: &[u8], cuts: &[usize]) -> Vec<Result<Vec<u8>, DecodeError>> {
    let mut decoder = Decoder::new();
    let mut all = Vec::new();
    let mut from = 0;
    for &to in cuts.iter().chain([&stream.len()]) {
        let mut piece = &stream[from.min(to)..to];
        from = from.max(to);
        while let Some(result) = decoder.next(&mut piece) {
            all.push(result.map(|message| {
                let mut out = [0; MAX_ENCODED];
                let n = encode(&message, &mut out).expect("what was read can be written");
                out[..n].to_vec()
            }));
        }
        assert!(piece.is_empty());
    }
    all
}

fn cuts(len: usize, mut cuts: Vec<prop::sample::Index>) -> Vec<usize> {
    let mut at: Vec<usize> = cuts.drain(..).map(|i| i.index(len + 1)).collect();
    at.sort_unstable();
    at
}

#[derive(Debug, Clone)]
enum Damage {
    Change(prop::sample::Index, u8),
    Remove(prop::sample::Index, usize),
    Insert(prop::sample::Index, Vec<u8>),
}

fn damage() -> impl Strategy<Value = Damage> {
    let at = any::<prop::sample::Index>;
    prop_oneof![
        (at(), 1u8..).prop_map(|(i, x)| Damage::Change(i, x)),
        (at(), 1usize..600).prop_map(|(i, n)| Damage::Remove(i, n)),
        (at(), vec(any::<u8>(), 1..1500)).prop_map(|(i, b)| Damage::Insert(i, b)),
    ]
}

/// A byte on the line, with its place in the sent stream.
#[derive(Clone, Copy)]
struct Byte {
    value: u8,
    /// Its place in the stream, if it is undamaged.
    origin: Option<usize>,
}

fn damaged(stream: &[u8], damages: &[Damage]) -> Vec<Byte> {
    let mut line: Vec<Byte> =
        stream.iter().enumerate().map(|(i, &value)| Byte { value, origin: Some(i) }).collect();
    for damage in damages {
        let len = line.len();
        match damage {
            Damage::Change(at, xor) if len > 0 => {
                let byte = &mut line[at.index(len)];
                *byte = Byte { value: byte.value ^ xor, origin: None };
            }
            Damage::Remove(at, n) if len > 0 => {
                let at = at.index(len);
                line.drain(at..len.min(at + n));
            }
            Damage::Insert(at, bytes) => {
                let at = at.index(len + 1);
                let new = bytes.iter().map(|&value| Byte { value, origin: None });
                line.splice(at..at, new);
            }
            _ => {}
        }
    }
    line
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn every_message_comes_back_as_it_was(message in sent()) {
        let line = message.on_the_line();
        prop_assert_eq!(line.iter().position(|&b| b == 0), Some(line.len() - 1));
        let mut decoder = Decoder::new();
        let mut input = &line[..];
        let back = decoder.next(&mut input);
        message.message(|m| assert_eq!(back, Some(Ok(*m))));
        prop_assert!(input.is_empty());
    }

    #[test]
    fn the_cuts_between_pieces_do_not_matter(
        messages in vec(sent(), 1..8),
        noise in vec(any::<u8>(), 0..50),
        at in vec(any::<prop::sample::Index>(), 0..30),
    ) {
        let mut stream = noise;
        stream.extend(messages.iter().flat_map(Sent::on_the_line));
        let whole = received(&stream, &[]);
        prop_assert_eq!(&whole, &received(&stream, &cuts(stream.len(), at)));
        let singly: Vec<usize> = (0..stream.len()).collect();
        prop_assert_eq!(&whole, &received(&stream, &singly));
    }

    #[test]
    fn damage_loses_only_what_it_touches_and_makes_up_nothing(
        messages in vec(sent(), 1..12),
        damages in vec(damage(), 0..6),
        at in vec(any::<prop::sample::Index>(), 0..10),
    ) {
        let frames: Vec<Vec<u8>> = messages.iter().map(Sent::on_the_line).collect();
        let stream = frames.concat();
        let line = damaged(&stream, &damages);

        // A frame is due if it is whole on the line, directly after a delimiter or at the start.
        let mut due = Vec::new();
        let mut start = 0;
        for frame in &frames {
            let here = line.iter().position(|b| b.origin == Some(start));
            if let Some(here) = here {
                let whole = (0..frame.len())
                    .all(|i| line.get(here + i).and_then(|b| b.origin) == Some(start + i));
                if whole && (here == 0 || line[here - 1].value == 0) {
                    due.push(frame.clone());
                }
            }
            start += frame.len();
        }

        let bytes: Vec<u8> = line.iter().map(|b| b.value).collect();
        let got: Vec<Vec<u8>> =
            received(&bytes, &cuts(bytes.len(), at)).into_iter().flatten().collect();
        // Each frame received was sent (a false frame has odds of 1 in 2^32), and each frame that is
        // due is received, in order. Other frames may be received, too, since damage may repair itself.
        let mut rest = got.iter();
        for frame in &due {
            prop_assert!(rest.any(|g| g == frame), "a frame was not recovered");
        }
        for frame in &got {
            prop_assert!(frames.contains(frame), "a frame was made up: {:02x?}", frame);
        }
    }

    #[test]
    fn noise_gives_no_message(noise in vec(prop_oneof![1 => Just(0u8), 20 => any::<u8>()], 0..5000)) {
        prop_assert!(received(&noise, &[]).iter().all(Result::is_err));
    }

    #[test]
    fn stuffing_is_undone_and_bounded(data in vec(prop_oneof![1 => Just(0u8), 60 => 1u8..], 0..2000)) {
        let mut out = vec![0; cobs::max_encoded_len(data.len())];
        let n = cobs::encode(&data, &mut out).expect("the bound holds");
        prop_assert!(!out[..n].contains(&0));
        prop_assert_eq!(cobs::decode_in_place(&mut out[..n]), Some(&data[..]));
    }
}

/// Sends frames with a right checksum and any body: nothing panics, and each accepted message can
/// be encoded again, byte for byte.
#[test]
fn hostile_frames_with_a_right_checksum_are_refused_or_exact() {
    let mut runner = proptest::test_runner::TestRunner::default();
    let kinds = prop_oneof![Just(1u8), Just(2), Just(3), Just(16), any::<u8>()];
    let body = vec(prop_oneof![Just(1u8), Just(0), 0u8..20, any::<u8>()], 0..80);
    let version = prop_oneof![9 => Just(1u8), 1 => any::<u8>()];
    runner
        .run(&(version, kinds, body), |(version, kind, body)| {
            let mut frame = vec![version, kind];
            frame.extend(body);
            frame.extend(surfaced_wire::crc::checksum(&frame).to_le_bytes());
            let mut line = vec![0; cobs::max_encoded_len(frame.len()) + 1];
            let n = cobs::encode(&frame, &mut line).expect("the bound holds");
            let line = &line[..=n];
            for result in received(line, &[]) {
                match result {
                    Ok(again) => prop_assert_eq!(&again[..], line),
                    Err(e) => prop_assert!(!e.is_damage()),
                }
            }
            Ok(())
        })
        .expect("the property holds");
}
