//! Measures whether readers of the event stream cost the station anything. A stylus at 10 kHz on a
//! pseudo-terminal runs alone, then with 50 readers, five of which never read, then alone again.
//!
//! `cargo run --release --example serve_load -- target/release/surfaced 300`
//!
//! The second argument is the time with readers, in seconds; each part without readers lasts half
//! as long. Fails if a sample was lost.

#[path = "../tests/common/mod.rs"]
mod common;

use std::error::Error;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use common::scripted::{self, Noise, Sample};
use common::stylus::Fake;
use serde_json::Value;
use surfaced::dataset::synth::{self, Parameters};
use surfaced::record::{TrialOptions, write_trial};
use surfaced::trial::{EXPERT, Trial};

const READERS: usize = 50;
const STALLED: usize = 5;
const DRAG_S: f64 = 1.0;
/// Clock ticks per second, the unit of processor times in /proc.
const TICKS: f64 = 100.0;

type Failed = Box<dyn Error>;

fn main() -> Result<(), Failed> {
    let mut args = std::env::args().skip(1);
    let program = args.next().ok_or("expected the path of surfaced")?;
    let seconds: f64 = args.next().map_or(Ok(60.0), |text| text.parse())?;
    let dir = tempfile::tempdir()?;
    let scans = prepare(dir.path())?;
    let mut station = Station::start(&program, dir.path())?;
    let (answers, done) = (station.answers(), Arc::new(AtomicBool::new(false)));
    let stylus = {
        let (link, done) = (dir.path().join("stylus"), done.clone());
        std::thread::spawn(move || sample(&link, &scans, &done))
    };

    println!("part         scans  answer p50 ms  p99 ms  processor of one core");
    let begin = |station: &Station| {
        (answers.lock().map_or(0, |a| a.len()), station.cpu_s(), Instant::now())
    };
    let end = |name: &str, station: &Station, from: (usize, f64, Instant)| {
        let all = answers.lock().map(|a| a.clone()).unwrap_or_default();
        let mut of_part = all[from.0..].to_vec();
        of_part.sort_by(f64::total_cmp);
        let at = |share: f64| of_part.get(((of_part.len() as f64 - 1.0) * share) as usize);
        let show = |x: Option<&f64>| x.map_or("-".into(), |x| format!("{x:.1}"));
        let busy = (station.cpu_s() - from.1) / from.2.elapsed().as_secs_f64();
        println!(
            "{name:<12} {:>5}  {:>13}  {:>6}  {:>5.1} %",
            of_part.len(),
            show(at(0.5)),
            show(at(0.99)),
            busy * 100.0
        );
    };
    std::thread::sleep(Duration::from_secs(5));
    let wait = |seconds: f64| std::thread::sleep(Duration::from_secs_f64(seconds));
    let from = begin(&station);
    wait(seconds / 2.0);
    end("alone", &station, from);
    let from = begin(&station);
    let readers = Readers::open(&station.address, seconds)?;
    wait(seconds);
    end("50 readers", &station, from);
    readers.report(seconds);
    drop(readers);
    let from = begin(&station);
    wait(seconds / 2.0);
    end("alone again", &station, from);

    let metrics = get(&station.address, "/metrics")?;
    let of =
        |name: &str| metrics.lines().filter(|l| l.starts_with(name)).collect::<Vec<_>>().join("\n");
    for name in [
        "surfaced_samples_total",
        "surfaced_lost",
        "surfaced_events_dropped",
        "surfaced_notices_missed",
    ] {
        println!("{}", of(name));
    }
    let lost = of("surfaced_lost").lines().any(|line| !line.ends_with(" 0"));
    done.store(true, Ordering::Release);
    let late = stylus.join().map_err(|_| "the stylus panicked")??;
    println!("the stylus was at most {late:.2} s behind real time");
    station.child.kill()?;
    if lost { Err("samples were lost".into()) } else { Ok(()) }
}

/// Writes a library and a station's configuration, and returns scans for the stylus to play.
fn prepare(dir: &Path) -> Result<Vec<Trial>, Failed> {
    let parameters = Parameters {
        surfaces: 6,
        trials: 4,
        users: 1,
        drag_seconds: DRAG_S,
        ..Parameters::default()
    };
    let data = synth::library(&parameters);
    let mut scans = Vec::new();
    for entry in &data.entries {
        let mut trial = entry.load()?;
        trial.signals.retain(|id, _| ["ac", "fr", "ir", "me"].contains(&id.as_str()));
        match trial.key.user == EXPERT {
            true => drop(write_trial(
                &dir.join("library"),
                &trial,
                &data.scene,
                &TrialOptions { durable: false, ..TrialOptions::default() },
            )?),
            false => scans.push(trial),
        }
    }
    let alone = "format = 1\n[microphone]\npresent = false\n[camera]\npresent = false\n";
    std::fs::write(dir.join("station.toml"), alone)?;
    Ok(scans)
}

/// Drags over one surface after the other, until `done`; returns the greatest delay, in seconds.
fn sample(link: &Path, scans: &[Trial], done: &AtomicBool) -> Result<f64, String> {
    let mut noise = Noise(1);
    let tape: Vec<Sample> =
        scans.iter().flat_map(|trial| scripted::scan(trial, DRAG_S, &mut noise)).collect();
    let values = move |index: u64, channel: usize| tape[index as usize % tape.len()][channel];
    let mut fake = Fake::with(link, Box::new(values));
    fake.scales = [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0 / 32_767.0];
    fake.wait_for_start();
    let mut late = 0.0f64;
    while !done.load(Ordering::Acquire) {
        let begin = Instant::now();
        fake.serve(1.0);
        late = late.max(begin.elapsed().as_secs_f64() - 1.0);
    }
    Ok(late)
}

/// A running process of `surfaced run`.
struct Station {
    child: Child,
    address: String,
    lines: Arc<Mutex<Vec<f64>>>,
}

impl Station {
    fn start(program: &str, dir: &Path) -> Result<Self, Failed> {
        let path = |name: &str| dir.join(name);
        let mut child = Command::new(program)
            .args(["run", "--json", "--serve=127.0.0.1:0", "--library"])
            .arg(path("library"))
            .arg("--config")
            .arg(path("station.toml"))
            .arg("--stylus")
            .arg(path("stylus"))
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        let stderr = child.stderr.take().ok_or("no stderr")?;
        let mut said = BufReader::new(stderr).lines();
        let address = said
            .by_ref()
            .map_while(Result::ok)
            .find_map(|line| line.strip_prefix("http://").map(String::from))
            .ok_or("surfaced serves nowhere")?;
        std::thread::spawn(move || said.map_while(Result::ok).for_each(|line| eprintln!("{line}")));
        let lines = Arc::<Mutex<Vec<f64>>>::default();
        let (out, latencies) = (child.stdout.take().ok_or("no stdout")?, lines.clone());
        std::thread::spawn(move || {
            for line in BufReader::new(out).lines().map_while(Result::ok) {
                let json: Value = serde_json::from_str(&line).unwrap_or_default();
                if let (Some(ms), Ok(mut all)) = (json["latency_ms"].as_f64(), latencies.lock()) {
                    all.push(ms);
                }
            }
        });
        Ok(Self { child, address, lines })
    }

    fn answers(&self) -> Arc<Mutex<Vec<f64>>> {
        self.lines.clone()
    }

    /// Processor time that the station has used so far, in seconds.
    fn cpu_s(&self) -> f64 {
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.child.id()));
        let stat = stat.unwrap_or_default();
        let after = stat.rsplit(") ").next().unwrap_or_default();
        let field = |at: usize| after.split(' ').nth(at).and_then(|x| x.parse::<f64>().ok());
        (field(11).unwrap_or(0.0) + field(12).unwrap_or(0.0)) / TICKS
    }
}

fn request(address: &str, path: &str) -> Result<TcpStream, Failed> {
    let mut stream = TcpStream::connect(address)?;
    write!(stream, "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n")?;
    Ok(stream)
}

fn get(address: &str, path: &str) -> Result<String, Failed> {
    let mut text = String::new();
    request(address, path)?.read_to_string(&mut text)?;
    Ok(text)
}

/// Programs that read the event stream.
struct Readers {
    bytes: Arc<AtomicU64>,
    traces: Arc<AtomicU64>,
    _stalled: Vec<TcpStream>,
}

impl Readers {
    fn open(address: &str, seconds: f64) -> Result<Self, Failed> {
        let (bytes, traces) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicU64::new(0)));
        let until = Instant::now() + Duration::from_secs_f64(seconds);
        for _ in STALLED..READERS {
            let stream = request(address, "/api/v1/events")?;
            let (bytes, traces) = (bytes.clone(), traces.clone());
            std::thread::spawn(move || {
                let lines = BufReader::with_capacity(1 << 16, stream).split(b'\n');
                for line in lines.map_while(Result::ok).take_while(|_| Instant::now() < until) {
                    bytes.fetch_add(line.len() as u64 + 1, Ordering::Relaxed);
                    traces.fetch_add(u64::from(line == b"event: trace"), Ordering::Relaxed);
                }
            });
        }
        let stalled = (0..STALLED).map(|_| request(address, "/api/v1/events"));
        Ok(Self { bytes, traces, _stalled: stalled.collect::<Result<_, _>>()? })
    }

    fn report(&self, seconds: f64) {
        let each = |count: &AtomicU64| {
            count.load(Ordering::Relaxed) as f64 / seconds / (READERS - STALLED) as f64
        };
        let (kilobytes, traces) = (each(&self.bytes) / 1e3, each(&self.traces));
        println!("             each reader: {kilobytes:.1} kB/s, {traces:.1} traces a second");
    }
}
