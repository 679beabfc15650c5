//! Any request: no panic, and nothing is ordered that is not allowed. `tools/fuzz` runs it for a
//! moment; for longer, with nightly Rust and `cargo install --locked cargo-fuzz`,
//!
//!     mkdir -p tests/fuzz/corpus
//!     cargo +nightly fuzz run --dev --fuzz-dir tests/fuzz request \
//!         tests/fuzz/corpus tests/fuzz/seeds -- -close_fd_mask=2
//!
//! (the mask silences the log of refusals, `--dev` builds sooner).

#![no_main]

#[path = "../requests.rs"]
mod requests;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| requests::send(bytes));
