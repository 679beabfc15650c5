//! Answers for other programs, as they come: by HTTP POST to an address, and by MQTT. Both are off
//! unless the configuration names where to.
//!
//! Each output has a bounded queue and a thread of its own, so that nobody holds up the station.
//! An answer that cannot be delivered is tried again, ever more slowly; when the queue is full, the
//! newest answers are dropped. [`OutputHealth`] reports this once, and counts. Each answer has an `id`,
//! by which a receiver recognises one that comes twice.

mod http;
mod mqtt;

pub use http::HttpOutput;
pub use mqtt::MqttOutput;

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use serde::Serialize;

/// Answers that wait for one output.
const QUEUE: usize = 256;
/// How long the end of the program waits for answers under way.
const PATIENCE: Duration = Duration::from_secs(2);

/// How an output is, as programs and the page see it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct OutputView {
    /// The address that answers go to.
    pub output: String,
    /// Answers that wait.
    pub waiting: u64,
    /// Attempts that failed, and answers that were refused or found no room.
    pub failures: u64,
    /// The reason why answers do not arrive now, if so.
    pub problem: Option<String>,
}

/// How an output is. It is said when answers begin to fail, and when they arrive again.
#[derive(Clone, Debug)]
pub struct OutputHealth(Arc<Health>);

#[derive(Debug)]
struct Health {
    output: String,
    waiting: AtomicU64,
    failures: AtomicU64,
    problem: Mutex<Option<String>>,
}

impl OutputHealth {
    fn new(output: String) -> Self {
        let (waiting, failures) = (AtomicU64::new(0), AtomicU64::new(0));
        Self(Arc::new(Health { output, waiting, failures, problem: Mutex::default() }))
    }

    /// Its state now.
    pub fn view(&self) -> OutputView {
        let Health { output, waiting, failures, problem } = &*self.0;
        OutputView {
            output: output.clone(),
            waiting: waiting.load(Ordering::Relaxed),
            failures: failures.load(Ordering::Relaxed),
            // Each change is one assignment.
            problem: problem.lock().unwrap_or_else(PoisonError::into_inner).clone(),
        }
    }

    fn set_problem(&self, now: Option<String>) -> Option<String> {
        let mut problem = self.0.problem.lock().unwrap_or_else(PoisonError::into_inner);
        std::mem::replace(&mut *problem, now)
    }

    fn waits(&self, answers: usize) {
        self.0.waiting.store(answers as u64, Ordering::Relaxed);
    }

    fn failed(&self, why: &str) {
        self.0.failures.fetch_add(1, Ordering::Relaxed);
        if self.set_problem(Some(why.into())).is_none() {
            tracing::warn!("answers do not reach {}: {why}", self.0.output);
        }
    }

    fn arrived(&self) {
        if self.set_problem(None).is_some() {
            tracing::warn!("answers reach {} again", self.0.output);
        }
    }
}

/// The time before the next attempt: doubled after each that fails, up to a minute.
#[derive(Debug)]
struct BackOff(Duration);

impl BackOff {
    const FIRST: Duration = Duration::from_millis(500);
    const LONGEST: Duration = Duration::from_secs(60);

    fn new() -> Self {
        Self(Self::FIRST)
    }

    /// How long to wait now.
    fn next(&mut self) -> Duration {
        let now = self.0;
        self.0 = (now * 2).min(Self::LONGEST);
        now
    }

    /// Waits until the next attempt is due, or until the end.
    fn wait(&mut self, ending: &AtomicBool) {
        let mut left = self.next();
        while left > Duration::ZERO && !ending.load(Ordering::Acquire) {
            let step = left.min(Duration::from_millis(100));
            std::thread::sleep(step);
            left -= step;
        }
    }

    /// It worked: the next failure is the first again.
    fn reset(&mut self) {
        self.0 = Self::FIRST;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attempts_grow_rarer_up_to_one_a_minute() {
        let mut back_off = BackOff::new();
        let waits: Vec<u64> = (0..9).map(|_| back_off.next().as_millis() as u64).collect();
        assert_eq!(waits, [500, 1000, 2000, 4000, 8000, 16_000, 32_000, 60_000, 60_000]);
        back_off.reset();
        assert_eq!(back_off.next(), BackOff::FIRST);
    }
}
