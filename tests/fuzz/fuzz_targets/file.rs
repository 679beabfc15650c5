//! Any file: a table, an array or a sound is read or refused, without a panic. `tools/fuzz` runs it.

#![no_main]

#[path = "../files.rs"]
mod files;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| files::read(bytes));
