//! A station of a stylus alone: `surfaced` as a process, on a pseudo-terminal's stylus.
//!
//! Beside the other common modules, since examples that use those have no program to run.

#![allow(dead_code)] // Not every test binary uses all of it.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, unbounded};
use serde_json::Value;
use surfaced::dataset;
use surfaced::dataset::synth::{self, Parameters};
use surfaced::library::Library;
use surfaced::record::{TrialOptions, write_trial};
use surfaced::scene::Scene;
use surfaced::trial::{EXPERT, Trial, TrialKey};

use crate::common::http::SOON;
use crate::common::scripted::{self, Noise, Sample};
use crate::common::stylus::Fake;

/// The sources of the stylus.
pub const CHANNELS: [&str; 4] = ["ac", "fr", "ir", "me"];

/// The scans that the stylus samples, one after the other; then it rests.
type Tape = Arc<Mutex<Vec<Sample>>>;

/// A station of a stylus alone.
pub struct Bench {
    dir: tempfile::TempDir,
    tape: Tape,
    noise: Noise,
}

/// The trial of each surface that is scanned, and in no library.
pub const SCANNED: u32 = 4;

/// Synthetic surfaces, each with trials for the library and one for a scan.
pub fn synthetic(drag_seconds: f64) -> Library {
    synth::library(&Parameters {
        surfaces: 3,
        trials: SCANNED,
        users: 0,
        drag_seconds,
        ..Parameters::default()
    })
}

/// One of its trials.
pub fn trial(library: &Library, surface: usize, number: u32) -> Trial {
    let key = TrialKey::new(library.surfaces()[surface], EXPERT, number);
    library.entries.iter().find(|entry| entry.key == key).unwrap().load().unwrap()
}

impl Bench {
    pub fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let alone = "format = 1\n[microphone]\npresent = false\n[camera]\npresent = false\n\
                     [enroll]\nt_star = []\n";
        std::fs::write(dir.path().join("station.toml"), alone).unwrap();
        Self { dir, tape: Tape::default(), noise: Noise(1) }
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// All trials but those that are scanned, as a library.
    pub fn library(&self, library: &Library) -> PathBuf {
        let path = self.path("library");
        let options = TrialOptions { durable: false, ..TrialOptions::default() };
        for entry in library.entries.iter().filter(|entry| entry.key.number != SCANNED) {
            let mut trial = entry.load().unwrap();
            trial.signals.retain(|id, _| CHANNELS.contains(&id.as_str()));
            write_trial(&path, &trial, &library.scene, &options).unwrap();
        }
        path
    }

    /// Plugs a stylus in, with nothing on its tape.
    pub fn stylus(&self) -> Fake {
        self.tape.lock().unwrap().clear();
        let tape = self.tape.clone();
        let values = move |index: u64, channel: usize| {
            let tape = tape.lock().unwrap();
            let at = usize::try_from(index).unwrap();
            // Off the tape, a step of noise.
            tape.get(at).map_or((at * 7919 % 3) as i16, |sample| sample[channel])
        };
        let mut fake = Fake::with(&self.path("stylus"), Box::new(values));
        fake.scales = [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0 / 32_767.0];
        fake
    }

    /// Puts a scan on the tape, to be sampled from the next sample on; gives its length in seconds.
    pub fn play(&mut self, fake: &Fake, trial: &Trial, drag_s: f64) -> f64 {
        let scan = scripted::scan(trial, drag_s, &mut self.noise);
        let seconds = scan.len() as f64 / 10_000.0;
        let mut tape = self.tape.lock().unwrap();
        tape.resize(fake.next.unwrap_or(0) as usize, [0; 7]);
        tape.extend(scan);
        seconds
    }

    /// Runs `surfaced` on its stylus.
    pub fn surfaced(&self, args: &[&str]) -> Surfaced {
        self.surfaced_with(args, Stdio::piped())
    }

    /// The same with another stderr.
    pub fn surfaced_with(&self, args: &[&str], stderr: Stdio) -> Surfaced {
        let (stylus, station) = (self.path("stylus"), self.path("station.toml"));
        let own = ["--stylus", stylus.to_str().unwrap(), "--config", station.to_str().unwrap()];
        Surfaced::start(&[args, &own].concat(), Stdio::null(), stderr)
    }
}

/// A process of the program.
pub struct Surfaced {
    pub child: Child,
    lines: Receiver<Value>,
    said: Arc<Mutex<String>>,
}

impl Surfaced {
    /// Runs `surfaced`, which prints lines of JSON.
    pub fn start(args: &[&str], stdin: Stdio, stderr: Stdio) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_surfaced"))
            .args(args)
            .arg("--json")
            .stdin(stdin)
            .stdout(Stdio::piped())
            .stderr(stderr)
            .spawn()
            .unwrap();
        let (send, lines) = unbounded();
        let stdout = BufReader::new(child.stdout.take().unwrap());
        std::thread::spawn(move || {
            for line in stdout.lines() {
                let _ = send.send(serde_json::from_str(&line.unwrap()).unwrap());
            }
        });
        let said = Arc::<Mutex<String>>::default();
        if let Some(stderr) = child.stderr.take() {
            let saying = said.clone();
            std::thread::spawn(move || {
                for line in BufReader::new(stderr).lines() {
                    saying.lock().unwrap().push_str(&(line.unwrap() + "\n"));
                }
            });
        }
        Self { child, lines, said }
    }

    /// The next line of JSON, while the stylus keeps sending.
    pub fn line(&self, fake: &mut Fake) -> Value {
        self.line_while(|| fake.serve(0.05))
    }

    /// The next line of JSON, while `serve` is called again and again.
    pub fn line_while(&self, mut serve: impl FnMut()) -> Value {
        let limit = Instant::now() + SOON;
        loop {
            if let Ok(line) = self.lines.try_recv() {
                return line;
            }
            assert!(Instant::now() < limit, "no line of JSON; {}", self.said());
            serve();
        }
    }

    /// The lines of JSON that nobody has read, after its end.
    pub fn rest(&self) -> Vec<Value> {
        self.lines.iter().collect()
    }

    /// All that it has said to people so far.
    pub fn said(&self) -> String {
        self.said.lock().unwrap().clone()
    }

    /// Waits until it has said this, while the stylus keeps sending.
    pub fn until_said(&self, text: &str, mut fake: Option<&mut Fake>) {
        let limit = Instant::now() + SOON;
        while !self.said().contains(text) {
            assert!(Instant::now() < limit, "`{text}` was not said in: {}", self.said());
            match &mut fake {
                Some(fake) => fake.serve(0.05),
                None => std::thread::sleep(Duration::from_millis(20)),
            }
        }
    }

    /// Sends it a signal.
    pub fn signal(&self, signal: &str) {
        let id = self.child.id().to_string();
        assert!(Command::new("kill").args(["-s", signal, &id]).status().unwrap().success());
    }

    /// Waits for its end, while the stylus keeps sending.
    pub fn end(&mut self, fake: &mut Fake) -> ExitStatus {
        self.end_while(|| fake.serve(0.05))
    }

    /// Waits for its end, while `serve` is called again and again.
    pub fn end_while(&mut self, mut serve: impl FnMut()) -> ExitStatus {
        let limit = Instant::now() + SOON;
        loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                return status;
            }
            assert!(Instant::now() < limit, "it does not end; {}", self.said());
            serve();
        }
    }
}

impl Drop for Surfaced {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A library as it is on the disk.
pub fn opened(path: &Path) -> Library {
    dataset::open(path, &Scene::lmt108()).unwrap()
}
