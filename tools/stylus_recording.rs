//! Makes the firmware's input for `tools/qemu-stylus`: scans, and a library to name them.
//!
//! `cargo run --example stylus_recording -- OUT [--scans N] [--seconds S] [--surfaces N] [--trials N]`
//!
//! The surfaces are synthetic. In OUT, `library/` holds the first trials of each surface.
//! `scan.i16` holds N scans (default 1) of trials that are not in the library, and then rest up to
//! S seconds. `truth.json` names the surfaces of these scans, in order. `enroll-K.i16` holds scans
//! of the library's trials of surface K, to enrol a library instead of reading it.

#[path = "../tests/common/scripted.rs"]
mod scripted;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use scripted::{Noise, Sample, scan};
use surfaced::dataset::synth::{self, Parameters};
use surfaced::library::{Entry, Library};
use surfaced::record::{TrialOptions, write_trial};
use surfaced::trial::EXPERT;

const SOURCES: [&str; 4] = ["ac", "fr", "ir", "me"];
const RATE_HZ: f64 = 10_000.0;

type Failure = Box<dyn std::error::Error>;

fn main() -> Result<(), Failure> {
    let mut args = std::env::args().skip(1);
    let out: PathBuf = args.next().ok_or("usage: stylus_recording OUT [--scans N] …")?.into();
    let mut numbers: BTreeMap<String, f64> = BTreeMap::new();
    while let Some(name) = args.next() {
        let value = args.next().ok_or_else(|| format!("{name} needs a number"))?;
        numbers.insert(name, value.parse()?);
    }
    let number = |name: &str, default: f64| numbers.get(name).copied().unwrap_or(default);
    let (surfaces, trials) = (number("--surfaces", 3.0) as usize, number("--trials", 3.0) as u32);
    let data = synth::library(&Parameters {
        surfaces,
        trials: trials + 1,
        users: 0,
        drag_seconds: number("--drag", 2.0),
        ..Parameters::default()
    });
    std::fs::create_dir_all(&out)?;
    let noise = &mut Noise(1);
    let (mut samples, mut truth) = (Vec::new(), Vec::new());
    for index in 0..number("--scans", 1.0) as usize {
        // Takes the surfaces in another order than that of their names.
        let surface = (index + surfaces / 2) % surfaces;
        let name = data.surfaces()[surface].to_string();
        let entry = find(&data, &name, trials + 1).ok_or("no such trial")?;
        samples.extend(scan(&entry.load()?, f64::INFINITY, noise));
        truth.push(name);
    }
    // Repeats the last sample until the end.
    let rest = samples.last().copied().unwrap_or_default();
    samples.resize(samples.len().max((number("--seconds", 0.0) * RATE_HZ) as usize), rest);
    write(&out.join("scan.i16"), &samples)?;
    std::fs::write(out.join("truth.json"), serde_json::to_string(&truth)?)?;
    for (k, surface) in data.surfaces().into_iter().enumerate() {
        let mut enrolled = Vec::new();
        for number in 1..=trials {
            let entry = find(&data, surface, number).ok_or("no such trial")?;
            let mut trial = entry.load()?;
            enrolled.extend(scan(&trial, f64::INFINITY, noise));
            trial.signals.retain(|id, _| SOURCES.contains(&id.as_str()));
            let options = TrialOptions { durable: false, ..TrialOptions::default() };
            write_trial(&out.join("library"), &trial, &data.scene, &options)?;
        }
        write(&out.join(format!("enroll-{k}.i16")), &enrolled)?;
        std::fs::write(out.join(format!("enroll-{k}.txt")), surface)?;
    }
    Ok(())
}

fn find<'a>(data: &'a Library, surface: &str, number: u32) -> Option<&'a Entry> {
    let fits = |entry: &&Entry| {
        let key = &entry.key;
        key.surface == surface && key.user == EXPERT && key.number == number
    };
    data.entries.iter().find(fits)
}

fn write(path: &Path, samples: &[Sample]) -> std::io::Result<()> {
    let bytes: Vec<u8> = samples.iter().flatten().flat_map(|x| x.to_le_bytes()).collect();
    std::fs::write(path, bytes)
}
