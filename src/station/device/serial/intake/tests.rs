use proptest::prelude::*;
use surfaced_wire::{Channel, MAX_ENCODED, encode};

use super::*;

const RATE_HZ: u32 = 1000;

fn wanted() -> Vec<Wanted> {
    let stream = |id: &str, channels: &[&str], value| Wanted {
        id: SourceId::new(id).unwrap(),
        channels: channels.iter().map(|name| name.to_string()).collect(),
        value,
    };
    vec![stream("fr", &["b", "a"], Value::FullScale), stream("me", &["metal"], Value::Unit)]
}

fn bytes(message: &Message<'_>) -> Vec<u8> {
    let mut out = [0; MAX_ENCODED];
    let n = encode(message, &mut out).unwrap();
    out[..n].to_vec()
}

fn hello(rate_hz: u32, names: &[&str]) -> Vec<u8> {
    hello_of(rate_hz, names, 0.5)
}

fn hello_of(rate_hz: u32, names: &[&str], scale: f32) -> Vec<u8> {
    let channels: Vec<_> = names.iter().map(|name| Channel { name, scale, unit: "" }).collect();
    bytes(&Message::Hello(Hello {
        serial: "S1",
        firmware: [1, 2, 3],
        sample_rate_hz: rate_hz,
        channels: channels[..].into(),
    }))
}

/// A samples message of `count` samples; each value is ten times its index plus its channel.
fn samples(first: u64, count: u64, channels: usize) -> Vec<u8> {
    let value = |index: u64, c: usize| (index as i16).wrapping_mul(10).wrapping_add(c as i16);
    let values: Vec<u8> = (first..first + count)
        .flat_map(|index| (0..channels).flat_map(move |c| value(index, c).to_le_bytes()))
        .collect();
    bytes(&Message::Samples(Samples::new(first, channels, &values).unwrap()))
}

/// The values of each stream, with NaN for missing frames; and all other events as text.
#[derive(Default)]
struct Got(Vec<Vec<f32>>, Vec<String>);

fn feed(intake: &mut Intake, bytes: &[u8], now_s: f64, got: &mut Got) {
    got.0.resize(2, Vec::new());
    intake.feed(bytes, now_s, |event| match event {
        IntakeEvent::Frames { stream, samples } => got.0[stream].extend_from_slice(samples),
        IntakeEvent::Missing { stream, frames } => {
            let n = frames as usize * if stream == 0 { 2 } else { 1 };
            got.0[stream].extend(std::iter::repeat_n(f32::NAN, n));
        }
        IntakeEvent::Hello { lacking, changed, .. } => {
            got.1.push(format!("hello {} {changed}", lacking.len()));
        }
        IntakeEvent::Refused(why) => got.1.push(why),
        IntakeEvent::Restarted => got.1.push("restarted".into()),
        IntakeEvent::Status(_) => {}
        IntakeEvent::Damaged(_) => got.1.push("damaged".into()),
    });
}

fn started() -> (Intake, Got) {
    let (mut intake, mut got) = (Intake::new(wanted(), RATE_HZ), Got::default());
    feed(&mut intake, &hello(RATE_HZ, &["a", "b", "metal"]), 0.0, &mut got);
    (intake, got)
}

#[test]
fn an_index_that_restarts_is_a_gap_by_the_clock() {
    let (mut intake, mut got) = started();
    feed(&mut intake, &samples(500, 10, 3), 1.0, &mut got);
    feed(&mut intake, &samples(0, 10, 3), 1.3, &mut got);
    assert_eq!(got.0[1].len(), 310);
    feed(&mut intake, &samples(0, 10, 3), 1.3, &mut got);
    assert_eq!(got.0[1].len(), 310 + 2 + 10);
    assert_eq!(got.1, ["hello 0 false", "restarted", "restarted"]);
}

#[test]
fn an_index_beyond_belief_is_no_gap_of_centuries() {
    let (mut intake, mut got) = started();
    feed(&mut intake, &samples(0, 10, 3), 1.0, &mut got);
    for _ in 0..3 {
        feed(&mut intake, &samples(u64::MAX - 20, 10, 3), 1.0, &mut got);
    }
    assert_eq!(got.0[1].len(), 10 + 3 * 12);
}

#[test]
fn after_a_replug_the_index_must_agree_with_the_clock() {
    let (mut intake, mut got) = started();
    feed(&mut intake, &samples(0, 10, 3), 0.0, &mut got);
    intake.reopened();
    feed(&mut intake, &samples(9_000, 10, 3), 60.0, &mut got);
    assert_eq!(got.0[1].len(), 10);
    feed(&mut intake, &hello(RATE_HZ, &["a", "b", "metal"]), 60.0, &mut got);
    feed(&mut intake, &samples(9_010, 10, 3), 60.0, &mut got);
    assert_eq!(got.0[1].len(), 10 + 60_000);
    feed(&mut intake, &samples(9_020, 10, 3), 60.0, &mut got);
    assert_eq!(got.0[1].len(), 10 + 60_000 + 10);
}

#[test]
fn a_table_that_changes_is_followed_and_reported() {
    let (mut intake, mut got) = started();
    feed(&mut intake, &samples(0, 1, 3), 0.0, &mut got);
    feed(&mut intake, &hello(RATE_HZ, &["b", "a"]), 0.0, &mut got);
    feed(&mut intake, &samples(1, 1, 2), 0.0, &mut got);
    feed(&mut intake, &hello(RATE_HZ, &["metal", "b", "a"]), 0.0, &mut got);
    feed(&mut intake, &samples(2, 1, 3), 0.0, &mut got);
    assert_eq!(got.1, ["hello 0 false", "hello 1 true", "hello 0 true"]);
    let full: Vec<f32> = got.0[0].iter().map(|x| x * 32_768.0).collect();
    assert_eq!(full, [1.0, 0.0, 10.0, 11.0, 21.0, 22.0]);
    // A missing frame keeps the late stream in step with the other streams.
    assert!(got.0[1].len() == 3 && got.0[1][1].is_nan() && got.0[1][2] == 10.0);
}

#[test]
fn what_cannot_be_used_is_refused_with_a_reason() {
    for (hello, reason) in [
        (hello(500, &["a", "b", "metal"]), "500 Hz, but 1000 Hz"),
        (hello(RATE_HZ, &["x", "y"]), "the channels x, y"),
        (hello_of(RATE_HZ, &["a", "b", "metal"], 3.4e38), "channel a"),
    ] {
        let (mut intake, mut got) = started();
        feed(&mut intake, &hello, 0.0, &mut got);
        feed(&mut intake, &samples(0, 4, 3), 0.0, &mut got);
        assert!(got.1[1].contains(reason), "{:?}", got.1);
        assert!(got.0[0].is_empty() && !intake.introduced, "{reason}");
    }
}

#[test]
fn samples_of_another_width_than_the_table_are_not_guessed_at() {
    let (mut intake, mut got) = started();
    feed(&mut intake, &samples(0, 4, 2), 0.0, &mut got);
    assert!(got.0[0].is_empty() && !intake.introduced);
}

proptest! {
    #[test]
    fn any_garbage_and_any_cut_leaves_both_streams_in_step(
        noise in prop::collection::vec((0usize..6000, any::<u8>()), 0..40),
        piece in 1usize..700,
    ) {
        let mut line = hello(RATE_HZ, &["a", "b", "metal"]);
        for frame in 0..60 {
            line.extend(samples(frame * 10, 10, 3));
        }
        for (at, byte) in noise {
            if let Some(slot) = line.get_mut(at + 60) {
                *slot = byte;
            }
        }
        let (mut intake, mut got) = (Intake::new(wanted(), RATE_HZ), Got::default());
        for part in line.chunks(piece) {
            feed(&mut intake, part, 0.0, &mut got);
        }
        prop_assert_eq!(got.0[0].len(), 2 * got.0[1].len());
        prop_assert!(got.0[1].len() <= 600);
        // A sample keeps its place, even if earlier ones are lost (the first may be lost unseen).
        let metal: Vec<_> = got.0[1].iter().map(|x| (*x * 2.0 - 2.0) / 10.0).collect();
        if let Some(first) = metal.first() {
            let first = *first;
            prop_assert!(metal.iter().enumerate().all(|(i, x)| x.is_nan() || *x == first + i as f32));
        }
    }
}
