//! Attacks `surfaced` at random. An emulated stylus, a microphone, readers of the page and commands
//! are at work. Meanwhile the line stalls, loses samples, sends garbage and is unplugged, the sound
//! server stalls and dies, the disk fills, another process edits the library, readers stall, and
//! signals end the station. After each station, processes edit a library at the same time, record
//! into it and review scans; some are killed in the middle of an edit.
//!
//! `cargo build --release --features live && cargo run --release --example chaos -- target/release/surfaced [MINUTES] [SEED]`
//!
//! The microphone is the monitor of a separate PulseAudio server (Debian: pulseaudio
//! pulseaudio-utils libasound2-plugins). Without the server, or if the program was built without
//! `live`, a message says so; `SURFACED_REQUIRE_SOUND=1` makes that an error.
//!
//! Runs for 20 minutes by default. Each station lives for some ten seconds and is then ended or
//! killed. Then its remains are checked. Every sample must be received or counted as lost, except
//! where nobody can know (the last ones before an unplugging or a restart, those hit by garbage).
//! Every scan must be answered or reported, every kept trial be whole, memory be bounded, and an
//! end take under five seconds. Every trial of the edited library must be there once and whole, and
//! undoing all steps must restore the first state. The last line on stdout is JSON. Fails if there
//! was a violation; stderr names each with its seed, and `chaos PROGRAM 0 SEED` repeats it.

#[path = "chaos/daemon.rs"]
mod daemon;
#[path = "chaos/dice.rs"]
mod dice;
#[path = "chaos/disk.rs"]
mod disk;
#[path = "chaos/edits.rs"]
mod edits;
#[allow(dead_code)] // It gives more than is wanted here.
#[path = "../tests/common/http.rs"]
mod http;
#[path = "chaos/line.rs"]
mod line;
#[path = "chaos/page.rs"]
mod page;
#[path = "chaos/round.rs"]
mod round;
#[path = "../tests/common/scripted.rs"]
mod scripted;
#[path = "chaos/sound.rs"]
mod sound;
#[allow(dead_code)] // It gives more than is wanted here.
#[path = "../tests/common/sound.rs"]
mod sound_server;
#[allow(dead_code)] // It can misbehave in ways that are not wanted here.
#[path = "../tests/common/stylus.rs"]
mod stylus;

use std::collections::BTreeMap;
use std::panic::AssertUnwindSafe;
use std::time::{Duration, Instant};

use disk::Disk;
use line::Tape;
use round::Round;
use sound::Sound;

type Failure = Box<dyn std::error::Error>;

/// Counts over all stations together.
#[derive(Default)]
pub struct Sums {
    faults: BTreeMap<&'static str, u64>,
    violations: Vec<String>,
    /// The attacks on the last station, each with the number of samples that its stylus had taken.
    story: Vec<(&'static str, u64)>,
    stylus: Samples,
    sound: Samples,
    scans: u64,
    kept: u64,
    peak_mb: u64,
}

/// Counts of the samples of a device.
#[derive(Default)]
pub struct Samples {
    sent: u64,
    received: u64,
    lost: u64,
    unknowable: u64,
}

/// The name of a source as a `SourceId`, for the test server.
fn id(name: &str) -> surfaced::scene::SourceId {
    // The tests give only valid names.
    surfaced::scene::SourceId::new(name).expect("the name of a source")
}

fn main() -> Result<(), Failure> {
    let mut args = std::env::args().skip(1);
    let program = args.next().ok_or("usage: chaos PROGRAM [MINUTES] [SEED]")?;
    let minutes: f64 = args.next().map_or(Ok(20.0), |text| text.parse())?;
    let first: u64 = args.next().map_or(Ok(1), |text| text.parse())?;
    let dir = tempfile::tempdir()?;
    let disk = Disk::new(dir.path())?;
    let tape = Tape::new(&disk)?;
    let mut sound = Sound::start(&program, dir.path(), &disk)?;
    let (begin, length) = (Instant::now(), Duration::from_secs_f64(minutes * 60.0));
    let mut sums = Sums::default();
    for seed in first.. {
        let faults: u64 = sums.faults.values().sum();
        eprintln!("seed {seed}: {faults} faults, {} violations so far", sums.violations.len());
        let before = sums.violations.len();
        let sound = sound.as_mut();
        let round = Round { program: &program, dir: dir.path(), disk: &disk, tape: &tape, sound };
        let life = || {
            round.run(seed, &mut sums)?;
            edits::round(&program, dir.path(), seed, &mut sums)
        };
        let done = std::panic::catch_unwind(AssertUnwindSafe(life));
        match done {
            Ok(Ok(())) => {}
            Ok(Err(error)) => sums.violations.push(error.to_string()),
            Err(_) => sums.violations.push("the emulation panicked; see above".into()),
        }
        for violation in &sums.violations[before..] {
            eprintln!("VIOLATION, seed {seed}, after {:?}: {violation}", sums.story);
        }
        if begin.elapsed() >= length {
            break;
        }
    }
    eprintln!("faults: {:?}", sums.faults);
    let Sums { faults, violations, stylus, sound, scans, kept, peak_mb, .. } = sums;
    println!(
        "{{\"minutes\":{:.1},\"faults\":{},\"violations\":{},{},{},\"scans\":{scans},\
         \"trials_kept\":{kept},\"peak_rss_mb\":{peak_mb}}}",
        begin.elapsed().as_secs_f64() / 60.0,
        faults.values().sum::<u64>(),
        violations.len(),
        stylus.json("samples"),
        sound.json("sound_samples"),
    );
    if violations.is_empty() { Ok(()) } else { Err("there were violations".into()) }
}

impl Samples {
    fn json(&self, of: &str) -> String {
        let Self { sent, received, lost, unknowable } = self;
        format!(
            "\"{of}_sent\":{sent},\"{of}_received\":{received},\"{of}_counted_lost\":{lost},\
             \"{of}_unknowable\":{unknowable}"
        )
    }

    /// Adds the counts of one life. False if samples are neither received, lost nor unknowable.
    fn add(&mut self, life: &Self) -> bool {
        let Self { sent, received, lost, unknowable } = life;
        self.sent += sent;
        self.received += received;
        self.lost += lost;
        self.unknowable += unknowable;
        sent.saturating_sub(*received) <= lost + unknowable
    }
}
