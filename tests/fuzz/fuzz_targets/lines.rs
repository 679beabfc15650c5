//! Any bytes as lines of a sensor, and numbers in any form: no panic, bounded memory, and no number
//! that was not printed. `tools/fuzz` runs it for a moment.

#![no_main]

#[path = "../printed_lines.rs"]
mod printed_lines;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| printed_lines::check(bytes));
