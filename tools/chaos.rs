//! Attacks `surfaced` at random: an emulated stylus, readers of the page and orders at work, while
//! the line stalls, loses, lies and is unplugged, the disk fills and empties, another process edits
//! the library, readers stall, and signals strike.
//!
//! `cargo build --release && cargo run --release --example chaos -- target/release/surfaced [MINUTES] [SEED]`
//!
//! 20 minutes unless said otherwise. A station lives for some ten seconds, then is ended or killed,
//! and what it left is checked: every sample is received or counted as lost, but for what nobody can
//! know (the tail before an unplugging or a restart, what garbage hit); every scan is answered or
//! reported; every kept trial is whole; memory is bounded; an end takes under five seconds. The last
//! line on stdout is JSON; fails if there was a violation. Each is named on stderr with the seed of
//! its station, which alone repeats it: `chaos PROGRAM 0 SEED`.

#[path = "chaos/daemon.rs"]
mod daemon;
#[path = "chaos/dice.rs"]
mod dice;
#[path = "chaos/disk.rs"]
mod disk;
#[path = "chaos/line.rs"]
mod line;
#[path = "chaos/page.rs"]
mod page;
#[path = "chaos/round.rs"]
mod round;
#[path = "../tests/common/scripted.rs"]
mod scripted;
#[allow(dead_code)] // It can misbehave in ways that are not wanted here.
#[path = "../tests/common/stylus.rs"]
mod stylus;

use std::collections::BTreeMap;
use std::panic::AssertUnwindSafe;
use std::time::{Duration, Instant};

use disk::Disk;
use line::Tape;
use round::Round;

type Failure = Box<dyn std::error::Error>;

/// What all stations together did.
#[derive(Default)]
pub struct Sums {
    faults: BTreeMap<&'static str, u64>,
    violations: Vec<String>,
    sent: u64,
    received: u64,
    lost: u64,
    unknowable: u64,
    scans: u64,
    kept: u64,
    peak_mb: u64,
}

fn main() -> Result<(), Failure> {
    let mut args = std::env::args().skip(1);
    let program = args.next().ok_or("usage: chaos PROGRAM [MINUTES] [SEED]")?;
    let minutes: f64 = args.next().map_or(Ok(20.0), |text| text.parse())?;
    let first: u64 = args.next().map_or(Ok(1), |text| text.parse())?;
    let dir = tempfile::tempdir()?;
    let disk = Disk::new(dir.path())?;
    let tape = Tape::new(&disk)?;
    let (begin, length) = (Instant::now(), Duration::from_secs_f64(minutes * 60.0));
    let mut sums = Sums::default();
    for seed in first.. {
        let faults: u64 = sums.faults.values().sum();
        eprintln!("seed {seed}: {faults} faults, {} violations so far", sums.violations.len());
        let before = sums.violations.len();
        let round = Round { program: &program, dir: dir.path(), disk: &disk, tape: &tape };
        let done = std::panic::catch_unwind(AssertUnwindSafe(|| round.run(seed, &mut sums)));
        match done {
            Ok(Ok(())) => {}
            Ok(Err(error)) => sums.violations.push(error.to_string()),
            Err(_) => sums.violations.push("the emulation panicked; see above".into()),
        }
        for violation in &sums.violations[before..] {
            eprintln!("VIOLATION, seed {seed}: {violation}");
        }
        if begin.elapsed() >= length {
            break;
        }
    }
    eprintln!("faults: {:?}", sums.faults);
    let Sums { faults, violations, sent, received, lost, unknowable, scans, kept, peak_mb } = sums;
    println!(
        "{{\"minutes\":{:.1},\"faults\":{},\"violations\":{},\"samples_sent\":{sent},\
         \"samples_received\":{received},\"samples_counted_lost\":{lost},\
         \"samples_unknowable\":{unknowable},\"scans\":{scans},\"trials_kept\":{kept},\
         \"peak_rss_mb\":{peak_mb}}}",
        begin.elapsed().as_secs_f64() / 60.0,
        faults.values().sum::<u64>(),
        violations.len(),
    );
    if violations.is_empty() { Ok(()) } else { Err("there were violations".into()) }
}
