//! Any bytes, cut anywhere: no panic, and what is accepted can be written again.

#![no_main]

use libfuzzer_sys::fuzz_target;
use surfaced_wire::{Decoder, MAX_ENCODED, encode};

fuzz_target!(|data: &[u8]| {
    // The first byte says where to cut, the rest is the stream.
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
