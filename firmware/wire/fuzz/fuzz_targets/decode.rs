//! Decodes any bytes, cut anywhere: nothing panics, and each accepted message can be encoded again.

#![no_main]

use libfuzzer_sys::fuzz_target;
use surfaced_wire::{Decoder, MAX_ENCODED, encode};

fuzz_target!(|data: &[u8]| {
    // The first byte gives the size of the parts; the rest is the stream.
    let Some((&size, stream)) = data.split_first() else { return };
    let mut decoder = Decoder::new();
    for mut piece in stream.chunks(usize::from(size) + 1) {
        while let Some(result) = decoder.next(&mut piece) {
            if let Ok(message) = result {
                assert!(encode(&message, &mut [0; MAX_ENCODED]).is_ok());
            }
        }
    }
});
