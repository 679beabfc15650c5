//! Measures how many values of the stylus one core takes from the bytes on the wire to the rings.
//!
//! `cargo run --release --example serial_load`
//!
//! Feeds bytes as reads would give them (4 KiB, the most that a tty gives at once). The same thread
//! empties the rings, so the result is what one core does for both.

use std::time::Instant;

use surfaced::device::serial::{Intake, IntakeEvent};
use surfaced::ring::{Piece, Waker, series};
use surfaced::station::config::StationConfig;
use surfaced_wire::{
    Channel, Hello, MAX_ENCODED, Message, SAMPLES_PER_FRAME, STYLUS_CHANNELS, Samples, encode,
};

const NAMES: [&str; STYLUS_CHANNELS] = ["acc_x", "acc_y", "acc_z", "fsr_1", "fsr_2", "ir", "metal"];
/// Number of values that the stylus sends in a second.
const VALUES_A_SECOND: f64 = 70_000.0;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut out = [0; MAX_ENCODED];
    let channels = NAMES.map(|name| Channel { name, scale: 1.0, unit: "" });
    let hello = Hello {
        serial: "load",
        firmware: [0, 1, 0],
        sample_rate_hz: 10_000,
        channels: channels[..].into(),
    };
    let n = encode(&Message::Hello(hello), &mut out)?;
    let hello = out[..n].to_vec();
    // A minute of noise, the worst case for the byte stuffing of the wire format.
    let (mut line, mut seed) = (Vec::new(), 1u32);
    for frame in 0..60 * 10_000 / SAMPLES_PER_FRAME as u64 {
        let mut values = Vec::with_capacity(2 * SAMPLES_PER_FRAME * STYLUS_CHANNELS);
        for _ in 0..SAMPLES_PER_FRAME * STYLUS_CHANNELS {
            seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            values.extend(((seed >> 16) as i16).to_le_bytes());
        }
        let first = frame * SAMPLES_PER_FRAME as u64;
        let samples = Samples::new(first, STYLUS_CHANNELS, &values)?;
        let n = encode(&Message::Samples(samples), &mut out)?;
        line.extend_from_slice(&out[..n]);
    }

    let wanted = StationConfig::embedded().stylus.ok_or("a stylus")?.streams;
    let (mut sinks, mut taps): (Vec<_>, Vec<_>) =
        wanted.iter().map(|w| series(w.channels.len(), 10_000, Waker::new().0)).unzip();
    let (mut values, mut lost, mut minutes) = (0u64, 0u64, 0.0);
    let begin = Instant::now();
    while begin.elapsed().as_secs_f64() < 3.0 {
        let mut intake = Intake::new(wanted.clone(), 10_000);
        intake.feed(&hello, 0.0, |_| {});
        for part in line.chunks(4096) {
            intake.feed(part, 0.0, |found| match found {
                IntakeEvent::Frames { stream, samples } => lost += sinks[stream].push(samples),
                IntakeEvent::Missing { frames, .. } => lost += frames,
                _ => lost += 1,
            });
            for tap in &mut taps {
                tap.drain(|piece| {
                    if let Piece::Samples(samples) = piece {
                        values += std::hint::black_box(samples).len() as u64;
                    }
                });
            }
        }
        minutes += 1.0;
    }
    let seconds = begin.elapsed().as_secs_f64();
    let expected = minutes * 60.0 * VALUES_A_SECOND;
    let rate = values as f64 / seconds;
    println!(
        "{{\"values_per_s\":{rate:.0},\"times_the_stylus\":{:.0},\"lost\":{lost},\"short\":{:.0}}}",
        rate / VALUES_A_SECOND,
        expected - values as f64
    );
    Ok(())
}
