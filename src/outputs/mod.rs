//! Answers for other programs, as they come: by HTTP POST to an address, and by MQTT. Both are off
//! unless the configuration names where to. README.md beside this file has the interface.
//!
//! Each output has a thread of its own, so that nobody holds up the station, and an outbox on disk,
//! where an answer waits until it has arrived. The oldest is sent first, and the next one once it has
//! arrived: so their order is kept. Each has an `id`, by which a receiver recognises one that comes
//! twice.

pub(crate) mod broker;
pub(crate) mod client;
mod http;
mod message;
mod mqtt;
mod outbox;
mod test;

pub use test::{OutputTest, test};

use std::convert::Infallible;
use std::future::Future;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Duration;

use serde::Serialize;
use tokio::sync::mpsc;

use self::message::StationCard;
use self::outbox::Outbox;
use crate::history::{History, HistoryError};
use crate::station::config::OutputsConfig;
use crate::station::{Answer, End, Listener, StationEvent};

/// Answers on their way from the station to an outbox.
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
    /// Attempts that failed, and answers that were refused.
    pub failures: u64,
    /// Answers that made room for newer ones.
    pub dropped: u64,
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
    dropped: AtomicU64,
    problem: Mutex<Option<String>>,
}

impl OutputHealth {
    fn new(output: String) -> Self {
        let [waiting, failures, dropped] = [0; 3].map(AtomicU64::new);
        Self(Arc::new(Health { output, waiting, failures, dropped, problem: Mutex::default() }))
    }

    /// Its state now.
    pub fn view(&self) -> OutputView {
        let Health { output, waiting, failures, dropped, problem } = &*self.0;
        OutputView {
            output: output.clone(),
            waiting: waiting.load(Ordering::Relaxed),
            failures: failures.load(Ordering::Relaxed),
            dropped: dropped.load(Ordering::Relaxed),
            // Each change is one assignment.
            problem: problem.lock().unwrap_or_else(PoisonError::into_inner).clone(),
        }
    }

    fn set_problem(&self, now: Option<String>) -> Option<String> {
        let mut problem = self.0.problem.lock().unwrap_or_else(PoisonError::into_inner);
        std::mem::replace(&mut *problem, now)
    }

    fn holds(&self, outbox: &Outbox) {
        self.0.waiting.store(outbox.waiting() as u64, Ordering::Relaxed);
        self.0.dropped.store(outbox.dropped(), Ordering::Relaxed);
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

/// Sends the answers of a station to one address.
#[derive(Debug)]
pub struct Output {
    answers: Option<mpsc::Sender<Arc<Answer>>>,
    health: OutputHealth,
    card: Card,
    end: End,
}

/// A station's state, for an output that publishes it.
type Card = Arc<Mutex<StationCard>>;

fn lock(card: &Card) -> MutexGuard<'_, StationCard> {
    // Each change leaves it whole.
    card.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The answers of one output on their way: from the station into the outbox, and out of it once they
/// have arrived.
#[derive(Debug)]
struct Pending {
    station: String,
    outbox: Outbox,
    health: OutputHealth,
}

impl Pending {
    fn open(
        station: &str,
        folder: &Path,
        output: &str,
        address: String,
    ) -> Result<Self, HistoryError> {
        let outbox = Outbox::open(folder, output)?;
        let health = OutputHealth::new(address);
        health.holds(&outbox);
        Ok(Self { station: station.into(), outbox, health })
    }

    /// Puts an answer into the outbox.
    fn add(&mut self, answer: &Answer) {
        let text = |sequence| message::answer(&self.station, sequence, answer);
        if let Err(error) = self.outbox.push(text) {
            self.health
                .failed(&format!("{error}; answers wait in memory, and end with the program"));
        }
        self.health.holds(&self.outbox);
    }

    /// The oldest answer, with its number.
    fn first(&self) -> Option<(u64, String)> {
        self.outbox.first().unwrap_or_else(|error| {
            self.health.failed(&error.to_string());
            None
        })
    }

    /// The oldest answer has arrived, or never will.
    fn done(&mut self, sequence: u64) {
        if let Err(error) = self.outbox.done(sequence) {
            self.health.failed(&format!("{error}; answers are sent again after a restart"));
        }
        self.health.holds(&self.outbox);
    }
}

impl Output {
    /// The outputs of a configuration, whose outboxes are in `folder`. The state of the station shows
    /// how many scans of `history` wait for review, and `page`, once that address is known.
    ///
    /// # Errors
    /// If the folder cannot be used, a certificate cannot be read, or the system gives no thread.
    pub fn start(
        config: &OutputsConfig,
        folder: &Path,
        (history, page): (&Arc<History>, &Arc<OnceLock<String>>),
    ) -> Result<Vec<Self>, HistoryError> {
        let OutputsConfig { station, http, mqtt } = config;
        let folder = folder.join(station);
        let mut outputs = Vec::new();
        if let Some(address) = http {
            let pending = Pending::open(station, &folder, "http", address.to_string())?;
            let (health, poster) = (pending.health.clone(), http::Poster::new(pending, address));
            outputs.push(Self::new(health, Card::default(), |answers| poster.run(answers))?);
        }
        if let Some(address) = mqtt {
            let shown = format!("{address}/{station}");
            let pending = Pending::open(station, &folder, "mqtt", shown)?;
            let (health, card) = (pending.health.clone(), Card::default());
            let show =
                mqtt::Shown { card: card.clone(), history: history.clone(), page: page.clone() };
            let publisher = mqtt::Publisher::new(pending, address, show)?;
            outputs.push(Self::new(health, card, |answers| publisher.run(answers))?);
        }
        Ok(outputs)
    }

    /// An output whose `work` runs on a thread of its own.
    fn new<F: Future<Output = ()>>(
        health: OutputHealth,
        card: Card,
        work: impl FnOnce(mpsc::Receiver<Arc<Answer>>) -> F + Send + 'static,
    ) -> Result<Self, HistoryError> {
        let (answers, to_send) = mpsc::channel(QUEUE);
        let (working, ended) = crossbeam_channel::bounded::<Infallible>(0);
        let system = |error| HistoryError::Io { path: health.0.output.clone().into(), error };
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        let runtime = runtime.map_err(system)?;
        let run = move || {
            let _working = working;
            runtime.block_on(work(to_send));
        };
        std::thread::Builder::new().name("output".into()).spawn(run).map_err(system)?;
        Ok(Self { answers: Some(answers), health, card, end: End::of(ended) })
    }

    /// How it is, now and later.
    pub fn health(&self) -> OutputHealth {
        self.health.clone()
    }
}

impl Listener for Output {
    fn on_event(&mut self, event: &StationEvent) {
        if self.end.is_here(event) {
            self.answers.take();
        }
        lock(&self.card).take(event);
        let (StationEvent::Answer(answer), Some(answers)) = (event, &self.answers) else { return };
        if answers.try_send(answer.clone()).is_err() {
            self.health.0.dropped.fetch_add(1, Ordering::Relaxed);
            self.health.failed(&format!(
                "the disk is too slow: {QUEUE} answers are to be written, so answer {} is dropped",
                answer.id
            ));
        }
    }
}

impl Drop for Output {
    fn drop(&mut self) {
        self.answers.take();
        self.end.wait(PATIENCE);
    }
}

/// The time before the next attempt: doubled after each that fails, up to a minute.
#[derive(Debug)]
pub(crate) struct BackOff(Duration);

impl BackOff {
    const FIRST: Duration = Duration::from_millis(500);
    const LONGEST: Duration = Duration::from_secs(60);

    pub fn new() -> Self {
        Self(Self::FIRST)
    }

    /// How long to wait now.
    pub fn next(&mut self) -> Duration {
        let now = self.0;
        self.0 = (now * 2).min(Self::LONGEST);
        now
    }

    /// It worked: the next failure is the first again.
    pub fn reset(&mut self) {
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
