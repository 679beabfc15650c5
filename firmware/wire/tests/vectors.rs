//! Checks that the crate writes and reads the bytes in its documentation.

use surfaced_wire::{
    Channel, Command, Decoder, Hello, MAX_ENCODED, Message, SAMPLES_PER_FRAME, STYLUS_CHANNELS,
    Samples, Status, encode,
};

/// The hexadecimal bytes in the table row of `src/lib.rs` that starts with `label`.
fn documented(label: &str) -> Vec<u8> {
    let docs = include_str!("../src/lib.rs");
    let row = docs.lines().find(|l| l.starts_with(&format!("//! | {label}"))).expect(label);
    let hex = row.split('`').rev().nth(1).expect("a row ends in `bytes` |");
    hex.split_whitespace().map(|b| u8::from_str_radix(b, 16).expect("two digits")).collect()
}

fn check(label: &str, message: &Message<'_>) {
    let mut out = [0; MAX_ENCODED];
    let n = encode(message, &mut out).expect("a valid message");
    let hex: Vec<String> = out[..n].iter().map(|b| format!("{b:02x}")).collect();
    println!("{label}: {}", hex.join(" "));
    let line = documented(label);
    assert_eq!(out[..n], line);
    let mut decoder = Decoder::new();
    assert_eq!(decoder.next(&mut &line[..]), Some(Ok(*message)));
}

#[test]
fn commands_are_written_as_documented() {
    check("command start", &Message::Command(Command::Start));
    check("command identify", &Message::Command(Command::Identify));
}

#[test]
fn status_is_written_as_documented() {
    let status = Status {
        samples_sent: 600_000,
        overruns: 1,
        dropped: 2,
        temperature_centi_c: Some(2550),
        sampling: true,
        ..Status::default()
    };
    check("status", &Message::Status(status));
}

#[test]
fn samples_are_written_as_documented() {
    let values: Vec<u8> =
        [1, -1, 0, 256, i16::MIN, i16::MAX, 2].iter().flat_map(|v: &i16| v.to_le_bytes()).collect();
    let samples = Samples::new(32, 7, &values).expect("one sample");
    check("samples", &Message::Samples(samples));
}

#[test]
fn hello_is_written_as_documented() {
    let channels = [Channel { name: "ir", scale: 0.5, unit: "V" }];
    let hello = Hello {
        serial: "S1",
        firmware: [0, 1, 0],
        sample_rate_hz: 10_000,
        channels: channels[..].into(),
    };
    check("hello", &Message::Hello(hello));
}

#[test]
fn a_default_frame_costs_at_most_five_percent() {
    const PAYLOAD: usize = SAMPLES_PER_FRAME * STYLUS_CHANNELS * 2;
    // Data without zeros cost COBS most; all zeros, and counting bytes, are two other extremes.
    let counting = std::array::from_fn(|i| (i % 251) as u8);
    for values in [[0xFF; PAYLOAD], [0; PAYLOAD], counting] {
        for first_index in [0, u64::MAX - 1000] {
            let samples = Samples::new(first_index, STYLUS_CHANNELS, &values).expect("32 samples");
            let n = encode(&Message::Samples(samples), &mut [0; MAX_ENCODED]).expect("it fits");
            let overhead = (n - PAYLOAD) as f64 / PAYLOAD as f64;
            println!("{n} bytes on the line for {PAYLOAD}: {:.2} %", 100.0 * overhead);
            assert!(overhead <= 0.05);
        }
    }
}
