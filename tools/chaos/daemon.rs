//! Runs `surfaced` as a process, and keeps all its output.

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

/// Time after which a station that hangs is killed.
const HANGS: Duration = Duration::from_secs(30);

/// The states of a device, as messages name them.
const STATES: [&str; 5] = ["opening", "streaming", "stalled", "lost", "absent"];

/// A process, and the threads that read its output.
pub struct Daemon {
    child: Child,
    /// While this is true, no thread reads the process's lines of JSON.
    pub stalled: Arc<AtomicBool>,
    lines: Arc<Mutex<Vec<Value>>>,
    /// The process's lines on stderr, each with its time.
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

    /// The address at which the process serves its page.
    pub fn address(&mut self) -> Result<SocketAddr, Failure> {
        let begin = Instant::now();
        while begin.elapsed() < HANGS && self.child.try_wait()?.is_none() {
            if let Some(text) = self.said().lines().find_map(|line| line.strip_prefix("http://")) {
                return Ok(text.parse()?);
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        // Waits for the last lines, which may still be on their way.
        std::thread::sleep(Duration::from_millis(500));
        Err(format!("it does not serve: {}", self.said()).into())
    }

    /// All lines on stderr so far.
    pub fn said(&self) -> String {
        let said = self.said.lock().unwrap_or_else(PoisonError::into_inner);
        said.iter().flat_map(|(_, line)| [line, "\n"]).collect()
    }

    /// The states of a device, each with the time when it began.
    pub fn states(&self, device: &str) -> Vec<(Instant, String)> {
        let said = self.said.lock().unwrap_or_else(PoisonError::into_inner);
        let state = |(at, line): &(Instant, String)| {
            let (_, rest) = line.split_once(device)?.1.split_once(" is ")?;
            let state = rest.split(':').next()?;
            STATES.contains(&state).then(|| (*at, state.to_string()))
        };
        said.iter().filter_map(state).collect()
    }

    /// The lines of JSON so far.
    pub fn lines(&self) -> Vec<Value> {
        self.lines.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Numbers of the scans that a line of JSON or a message mentions.
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

    /// The most memory that the process has used so far, in MB.
    pub fn peak_mb(&self) -> Option<u64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).ok()?;
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
        line.trim().trim_end_matches(" kB").parse::<u64>().ok().map(|kb| kb / 1024)
    }

    /// Sends a signal and waits until the process ends, calling `meanwhile` again and again.
    /// Returns the exit status and the time that the end took.
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
