//! `surfaced` as a process, and all that it says.

use std::collections::BTreeSet;
use std::io::{BufRead, BufReader};
use std::net::SocketAddr;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::Failure;

/// A station that hangs is killed after this long.
const HANGS: Duration = Duration::from_secs(30);

/// States of a device.
const STATES: [&str; 5] = ["opening", "streaming", "stalled", "lost", "absent"];

/// A process, and the threads that read what it writes.
pub struct Daemon {
    child: Child,
    /// While set, nobody reads its lines of JSON.
    pub stalled: Arc<AtomicBool>,
    lines: Arc<Mutex<Vec<Value>>>,
    /// Its lines on stderr, each with its time.
    said: Arc<Mutex<Vec<(Instant, String)>>>,
    readers: Vec<JoinHandle<()>>,
}

impl Daemon {
    pub fn start(command: &mut Command) -> Result<Self, Failure> {
        let mut child =
            command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn()?;
        let (out, err) = (child.stdout.take(), child.stderr.take());
        let (out, err) = (out.ok_or("no stdout")?, err.ok_or("no stderr")?);
        let (stalled, lines) = (Arc::<AtomicBool>::default(), Arc::<Mutex<Vec<Value>>>::default());
        let said = Arc::<Mutex<Vec<(Instant, String)>>>::default();
        let (pause, to, saying) = (stalled.clone(), lines.clone(), said.clone());
        let json = std::thread::spawn(move || {
            for line in BufReader::new(out).lines().map_while(Result::ok) {
                while pause.load(Ordering::Relaxed) {
                    std::thread::sleep(Duration::from_millis(20));
                }
                let value = serde_json::from_str(&line).unwrap_or(Value::String(line));
                to.lock().unwrap_or_else(PoisonError::into_inner).push(value);
            }
        });
        let text = std::thread::spawn(move || {
            for line in BufReader::new(err).lines().map_while(Result::ok) {
                let mut said = saying.lock().unwrap_or_else(PoisonError::into_inner);
                said.push((Instant::now(), line));
            }
        });
        Ok(Self { child, stalled, lines, said, readers: vec![json, text] })
    }

    /// The address that it serves at.
    pub fn address(&mut self) -> Result<SocketAddr, Failure> {
        let begin = Instant::now();
        while begin.elapsed() < HANGS && self.child.try_wait()?.is_none() {
            if let Some(text) = self.said().lines().find_map(|line| line.strip_prefix("http://")) {
                return Ok(text.parse()?);
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        // Its last lines may still be on their way.
        std::thread::sleep(Duration::from_millis(500));
        Err(format!("it does not serve: {}", self.said()).into())
    }

    /// All that it has said to people.
    pub fn said(&self) -> String {
        let said = self.said.lock().unwrap_or_else(PoisonError::into_inner);
        said.iter().flat_map(|(_, line)| [line, "\n"]).collect()
    }

    /// The states that a device came into, and when.
    pub fn states(&self, device: &str) -> Vec<(Instant, String)> {
        let said = self.said.lock().unwrap_or_else(PoisonError::into_inner);
        let state = |(at, line): &(Instant, String)| {
            let (_, rest) = line.split_once(device)?.1.split_once(" is ")?;
            let state = rest.split(':').next()?;
            STATES.contains(&state).then(|| (*at, state.to_string()))
        };
        said.iter().filter_map(state).collect()
    }

    /// Its lines of JSON.
    pub fn lines(&self) -> Vec<Value> {
        self.lines.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The scans that a line or a message mentions.
    pub fn scans(&self) -> BTreeSet<u64> {
        let said = self.said();
        let said = said.match_indices("scan ").filter_map(|(at, found)| {
            let rest = &said[at + found.len()..];
            let digits = rest.find(|c: char| !c.is_ascii_digit()).unwrap_or(rest.len());
            rest[..digits].parse().ok()
        });
        let lines = self.lines();
        lines.iter().filter_map(|line| line["scan"].as_u64()).chain(said).collect()
    }

    pub fn is_alive(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    /// The most memory that it has had, in MB.
    pub fn peak_mb(&self) -> Option<u64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).ok()?;
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
        line.trim().trim_end_matches(" kB").parse::<u64>().ok().map(|kb| kb / 1024)
    }

    /// Sends a signal and waits for the end; how it ended, and how long that took. Meanwhile the
    /// stylus does as `meanwhile` says.
    pub fn end(
        &mut self,
        signal: &str,
        mut meanwhile: impl FnMut(),
    ) -> Result<(ExitStatus, Duration), Failure> {
        let begin = Instant::now();
        Command::new("kill").args(["-s", signal, &self.child.id().to_string()]).status()?;
        let status = loop {
            if let Some(status) = self.child.try_wait()? {
                break status;
            }
            if begin.elapsed() > HANGS {
                self.child.kill()?;
            }
            meanwhile();
        };
        let took = begin.elapsed();
        self.stalled.store(false, Ordering::Relaxed);
        for reader in self.readers.drain(..) {
            reader.join().map_err(|_| "a reader panicked")?;
        }
        Ok((status, took))
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
