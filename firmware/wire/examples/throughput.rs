//! Measures how fast one core decodes: prints MB/s and values/s for frames of the default size.
//!
//! `cargo run --release -p surfaced-wire --example throughput`

use std::hint::black_box;
use std::time::Instant;

use surfaced_wire::{
    Decoder, MAX_ENCODED, Message, SAMPLES_PER_FRAME, STYLUS_CHANNELS, Samples, encode,
};

fn main() {
    // Half the bytes of small values, as of a stylus at rest, are zero; large values have few zeros.
    for (name, shift) in [("quiet signal", 8), ("full-scale signal", 0)] {
        let mut seed = 1u32;
        let mut stream = Vec::new();
        for frame in 0..10_000u64 {
            let mut values = Vec::new();
            for _ in 0..SAMPLES_PER_FRAME * STYLUS_CHANNELS {
                seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                values.extend((((seed >> 16) as i16) >> shift).to_le_bytes());
            }
            let first = frame * SAMPLES_PER_FRAME as u64;
            let samples = Samples::new(first, STYLUS_CHANNELS, &values).expect("32 samples");
            let mut out = [0; MAX_ENCODED];
            let n = encode(&Message::Samples(samples), &mut out).expect("it fits");
            stream.extend_from_slice(&out[..n]);
        }
        let mut out = [0i16; SAMPLES_PER_FRAME * STYLUS_CHANNELS];
        let (mut bytes, mut values) = (0usize, 0usize);
        let mut decoder = Decoder::new();
        let begin = Instant::now();
        while begin.elapsed().as_secs_f64() < 1.0 {
            // Cuts the stream into parts as large as one read from a serial line.
            for piece in stream.chunks(4096) {
                let mut input = piece;
                while let Some(result) = decoder.next(&mut input) {
                    if let Ok(Message::Samples(samples)) = result {
                        values += samples.copy_values(&mut out);
                        black_box(&out);
                    }
                }
            }
            bytes += stream.len();
        }
        let seconds = begin.elapsed().as_secs_f64();
        println!(
            "{name}: {:.0} MB/s, {:.0} million values/s",
            bytes as f64 / seconds / 1e6,
            values as f64 / seconds / 1e6
        );
    }
}
