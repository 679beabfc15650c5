//! Lets `surfaced run` name scans for a long time, from a stylus on a pseudo-terminal that samples
//! at four times its usual rate. Prints how memory grew and how many samples were lost.
//!
//! `cargo build --release && cargo run --release --example soak -- target/release/surfaced [MINUTES]`
//!
//! Runs for 30 minutes by default. The last line is JSON; fails if a sample was lost, or if memory
//! grew by more than a tenth after the first fifth of the time.

#[path = "../tests/common/scripted.rs"]
mod scripted;
#[allow(dead_code)] // It can misbehave in ways that are not wanted here.
#[path = "../tests/common/stylus.rs"]
mod stylus;

use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use scripted::{Noise, scan};
use stylus::Fake;
use surfaced::dataset::synth::{self, Parameters};
use surfaced::record::{TrialOptions, write_trial};

const SPEED: f64 = 4.0;
const STATION: &str = "format = 1\n[microphone]\npresent = false\n[camera]\npresent = false\n";
const SOURCES: [&str; 4] = ["ac", "fr", "ir", "me"];

type Failure = Box<dyn std::error::Error>;

/// Resident memory of a process in kB.
fn resident_kb(process: u32) -> Result<u64, Failure> {
    let status = std::fs::read_to_string(format!("/proc/{process}/status"))?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).ok_or("no VmRSS")?;
    Ok(line.trim().trim_end_matches(" kB").parse()?)
}

fn main() -> Result<(), Failure> {
    let mut args = std::env::args().skip(1);
    let program = args.next().ok_or("usage: soak PROGRAM [MINUTES]")?;
    let minutes: f64 = args.next().map_or(Ok(30.0), |text| text.parse())?;
    let dir = tempfile::tempdir()?;
    let at = |name: &str| dir.path().join(name);
    std::fs::write(at("station.toml"), STATION)?;
    let data =
        synth::library(&Parameters { surfaces: 4, trials: 4, users: 0, ..Parameters::default() });
    // One loop of the tape: one scan of each surface, from trials that are not in the library.
    let mut tape = Vec::new();
    for entry in &data.entries {
        let mut trial = entry.load()?;
        if trial.key.number == 4 {
            tape.extend(scan(&trial, f64::INFINITY, &mut Noise(1)));
            continue;
        }
        trial.signals.retain(|id, _| SOURCES.contains(&id.as_str()));
        let options = TrialOptions { durable: false, ..TrialOptions::default() };
        write_trial(&at("library"), &trial, &data.scene, &options)?;
    }
    let values = move |index: u64, channel: usize| tape[index as usize % tape.len()][channel];
    let mut fake = Fake::with(&at("stylus"), Box::new(values));
    fake.speed = SPEED;
    fake.scales[6] = 1.0 / 32_767.0;
    let mut run = Command::new(program)
        .args(["run", "--json", "--library"])
        .arg(at("library"))
        .arg("--config")
        .arg(at("station.toml"))
        .arg("--stylus")
        .arg(at("stylus"))
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()?;
    let answers = Arc::new(AtomicU64::new(0));
    let said = Arc::<Mutex<String>>::default();
    let (count, saying) = (answers.clone(), said.clone());
    let (out, err) = (run.stdout.take().ok_or("no stdout")?, run.stderr.take().ok_or("no stderr")?);
    let counting = std::thread::spawn(move || {
        for _ in BufReader::new(out).lines() {
            count.fetch_add(1, Ordering::Relaxed);
        }
    });
    let reading = std::thread::spawn(move || {
        for line in BufReader::new(err).lines().map_while(Result::ok) {
            eprintln!("{line}");
            if let Ok(mut said) = saying.lock() {
                *said = line;
            }
        }
    });
    fake.wait_for_start();
    let begin = Instant::now();
    let length = Duration::from_secs_f64(minutes * 60.0);
    let mut early_kb = None;
    while begin.elapsed() < length {
        fake.serve(1.0);
        if begin.elapsed() >= length / 5 && early_kb.is_none() {
            early_kb = Some(resident_kb(run.id())?);
        }
    }
    let (early_kb, late_kb) = (early_kb.unwrap_or(0), resident_kb(run.id())?);
    let sent = fake.next.unwrap_or(0);
    // Waits for samples that are still on the line.
    std::thread::sleep(Duration::from_secs(1));
    Command::new("kill").args(["-s", "TERM", &run.id().to_string()]).status()?;
    while run.try_wait()?.is_none() {
        fake.obey();
    }
    for thread in [counting, reading] {
        thread.join().map_err(|_| "a reader panicked")?;
    }
    // The last line is "received: ac 10 (0 lost), …", unless something was lost.
    let account = said.lock().map(|said| said.clone()).unwrap_or_default();
    let found = account.split("ir ").nth(1).and_then(|rest| rest.split(' ').next());
    let received: u64 = found.ok_or("the daemon gave no account")?.parse()?;
    let (answers, lost) = (answers.load(Ordering::Relaxed), sent.abs_diff(received));
    println!(
        "{{\"minutes\":{minutes},\"speed\":{SPEED},\"scans_named\":{answers},\"samples_sent\":{sent},\
         \"samples_received\":{received},\"lost\":{lost},\"resident_kb_early\":{early_kb},\
         \"resident_kb_late\":{late_kb}}}"
    );
    if lost > 0 || late_kb > early_kb + early_kb / 10 {
        return Err("samples were lost, or memory grew".into());
    }
    Ok(())
}
