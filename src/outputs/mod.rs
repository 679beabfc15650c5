//! Sends answers to other programs, by HTTP POST and by MQTT, if the configuration gives addresses.
//! README.md beside this file describes the interface.
//!
//! Each output has its own thread, so it cannot delay the station. An outbox on disk holds the
//! answers that have not arrived. Each is sent after the one before it has arrived.
//! A receiver recognises a repeated answer by its `id`.

#![warn(missing_docs)]

pub(crate) mod http;
mod message;
pub(crate) mod mqtt;
mod outbox;
mod tls;

use std::convert::Infallible;
use std::future::Future;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use rumqttc::{Event, MqttOptions, Packet, QoS};
use serde::Serialize;
use tokio::sync::mpsc;
use tokio::time::timeout;

use self::http::Receiver;
use self::message::StationCard;
use self::mqtt::Line;
use self::outbox::Outbox;
use crate::history::{History, HistoryError};
use crate::scan::Scan;
use crate::station::config::OutputsConfig;
use crate::station::{Answer, Change, End, Listener, StationEvent};
use crate::trial::Doubt;

/// How many answers may wait between the station and an outbox.
const QUEUE: usize = 256;
/// How long the program, at its end, waits for answers that are being sent.
const PATIENCE: Duration = Duration::from_secs(2);

/// The state of an output, for programs and for the page.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct OutputView {
    /// The address that answers go to.
    pub output: String,
    /// Number of answers that have not arrived yet.
    pub waiting: u64,
    /// Number of failed attempts and refused answers.
    pub failures: u64,
    /// Number of answers deleted to make room for newer ones.
    pub dropped: u64,
    /// The reason why answers do not arrive at present; `None` if they arrive.
    pub problem: Option<String>,
}

/// The shared state of an output. Logs when answers begin to fail, and when they arrive again.
#[derive(Clone, Debug)]
pub struct OutputHealth(Arc<Mutex<OutputState>>);

/// The view of an output, and the number of answers that its outbox never got.
#[derive(Debug)]
struct OutputState {
    view: OutputView,
    not_taken: u64,
}

impl OutputHealth {
    fn new(output: String, outbox: &Outbox) -> Self {
        let view = OutputView { output, waiting: 0, failures: 0, dropped: 0, problem: None };
        let health = Self(Arc::new(Mutex::new(OutputState { view, not_taken: 0 })));
        health.holds(outbox);
        health
    }

    /// A copy of the present state.
    pub fn view(&self) -> OutputView {
        lock(&self.0).view.clone()
    }

    fn holds(&self, outbox: &Outbox) {
        let OutputState { view, not_taken } = &mut *lock(&self.0);
        (view.waiting, view.dropped) = (outbox.waiting() as u64, outbox.dropped + *not_taken);
    }

    /// Counts an answer that the outbox never got, since the disk was too slow.
    fn not_taken(&self) {
        let mut state = lock(&self.0);
        state.not_taken += 1;
        state.view.dropped += 1;
    }

    fn failed(&self, why: &str) {
        let view = &mut lock(&self.0).view;
        view.failures += 1;
        if view.problem.replace(why.into()).is_none() {
            tracing::warn!("answers do not reach {}: {why}", view.output);
        }
    }

    fn arrived(&self) {
        let view = &mut lock(&self.0).view;
        if view.problem.take().is_some() {
            tracing::warn!("answers reach {} again", view.output);
        }
    }
}

/// What a station says to an output.
#[derive(Debug)]
enum Said {
    Answer(Arc<Answer>),
    /// By HTTP, changes are not sent: the answers to their stretches are.
    Change(Arc<Change>),
}

/// Sends the answers of a station to one address.
#[derive(Debug)]
pub struct Output {
    answers: Option<mpsc::Sender<Said>>,
    health: OutputHealth,
    card: Card,
    end: End,
}

type Card = Arc<Mutex<StationCard>>;

fn lock<T>(shared: &Mutex<T>) -> MutexGuard<'_, T> {
    // Each change leaves the value valid, so the value can be used even after a panic.
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The answers of one output that have not arrived, in their outbox.
#[derive(Debug)]
struct Pending {
    station: String,
    outbox: Outbox,
    health: OutputHealth,
}

impl Pending {
    /// Opens the outbox for an output (its name and address) in a station's folder.
    fn open(folder: &Path, output: (&str, String), station: &str) -> Result<Self, HistoryError> {
        let outbox = Outbox::open(folder, output.0)?;
        let health = OutputHealth::new(output.1, &outbox);
        Ok(Self { station: station.into(), outbox, health })
    }

    /// Puts an answer into the outbox.
    fn add(&mut self, said: &Said) {
        let Said::Answer(answer) = said else { return };
        let text = |sequence| message::answer(&self.station, sequence, answer);
        if let Err(error) = self.outbox.push(text) {
            self.health
                .failed(&format!("{error}; answers wait in memory, and end with the program"));
        }
        self.health.holds(&self.outbox);
    }

    fn first(&self) -> Option<(u64, String)> {
        self.outbox.first().unwrap_or_else(|error| {
            self.health.failed(&error.to_string());
            None
        })
    }

    /// Removes an answer from the outbox, since it has arrived or was refused for good.
    fn done(&mut self, sequence: u64) {
        if let Err(error) = self.outbox.done(sequence) {
            self.health.failed(&format!("{error}; answers are sent again after a restart"));
        }
        self.health.holds(&self.outbox);
    }
}

impl Output {
    /// Starts the outputs of a configuration, with outboxes in `folder`. The published state has
    /// the number of scans in `history` to review, and the address of the page once it is known.
    ///
    /// # Errors
    /// If the folder cannot be used, a file of an output cannot be read, or no thread can be started.
    pub fn start(
        config: &OutputsConfig,
        folder: &Path,
        shown: (&Arc<History>, &Arc<OnceLock<String>>),
    ) -> Result<Vec<Self>, HistoryError> {
        let OutputsConfig { station, http, mqtt } = config;
        let folder = folder.join(station);
        let mut outputs = Vec::new();
        if let Some(address) = http {
            let pending = Pending::open(&folder, ("http", address.to_string()), station)?;
            let (health, receiver) = (pending.health.clone(), Receiver::of(address)?);
            let post = |answers| http::post_all(pending, receiver, answers);
            outputs.push(Self::new(health, Card::default(), post)?);
        }
        if let Some(address) = mqtt {
            let output = ("mqtt", format!("{address}/{station}"));
            let pending = Pending::open(&folder, output, station)?;
            let (health, card) = (pending.health.clone(), Card::default());
            let publisher = mqtt::Publisher::new(pending, address, card.clone(), shown)?;
            outputs.push(Self::new(health, card, |answers| publisher.run(answers))?);
        }
        Ok(outputs)
    }

    /// Creates an output that runs `work` on its own thread.
    fn new<F: Future<Output = ()>>(
        health: OutputHealth,
        card: Card,
        work: impl FnOnce(mpsc::Receiver<Said>) -> F + Send + 'static,
    ) -> Result<Self, HistoryError> {
        let (answers, to_send) = mpsc::channel(QUEUE);
        let (working, ended) = crossbeam_channel::bounded::<Infallible>(0);
        let system = |error| HistoryError::Io { path: health.view().output.into(), error };
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        let runtime = runtime.map_err(system)?;
        let run = move || {
            let _working = working;
            runtime.block_on(work(to_send));
        };
        std::thread::Builder::new().name("output".into()).spawn(run).map_err(system)?;
        Ok(Self { answers: Some(answers), health, card, end: End::of(ended) })
    }

    /// A handle by which the state of the output can be read at any time.
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
        let Some(answers) = &self.answers else { return };
        let answer = match event {
            StationEvent::Answer(answer) => answer,
            // A change that finds no room is dropped; the answer to its stretch is not.
            StationEvent::Change(change) => {
                return drop(answers.try_send(Said::Change(change.clone())));
            }
            _ => return,
        };
        if answers.try_send(Said::Answer(answer.clone())).is_err() {
            self.health.not_taken();
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

/// The pause before the next attempt. It doubles after each failed attempt, up to a minute.
#[derive(Debug)]
pub(crate) struct BackOff(Duration);

impl BackOff {
    const FIRST: Duration = Duration::from_millis(500);
    const LONGEST: Duration = Duration::from_secs(60);

    pub(crate) fn new() -> Self {
        Self(Self::FIRST)
    }

    pub(crate) fn next(&mut self) -> Duration {
        let now = self.0;
        self.0 = (now * 2).min(Self::LONGEST);
        now
    }

    pub(crate) fn reset(&mut self) {
        self.0 = Self::FIRST;
    }
}

/// Reads the passwords and the certificates of the outputs, without connecting.
pub(crate) fn check(config: &OutputsConfig) -> Result<(), HistoryError> {
    config.http.iter().try_for_each(|address| Receiver::of(address).map(drop))?;
    let read = |address| mqtt::options(address, "surfaced".into()).map(drop);
    config.mqtt.iter().try_for_each(read)
}

const TEST_PATIENCE: Duration = Duration::from_secs(10);

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct OutputTest {
    pub output: String,
    pub arrived: bool,
    /// The reply of the receiver, or the problem.
    pub said: String,
}

pub(crate) fn test(config: &OutputsConfig) -> Result<Vec<OutputTest>, HistoryError> {
    let mut answer = Answer::of(&Scan::of_signals(0, Default::default()), 0.0);
    answer.doubts.push(Doubt::NotNamed { why: "a test of this output, and no scan".into() });
    let text = message::answer(&config.station, 0, &answer);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(|error| HistoryError::Io { path: "outputs".into(), error })?;
    let mut tests = Vec::new();
    if let Some(address) = &config.http {
        let done = runtime.block_on(tried(post(&Receiver::of(address)?, text.clone())));
        tests.push(OutputTest::of(address.to_string(), done));
    }
    if let Some(address) = &config.mqtt {
        let topic = format!("{}/{}/test", address.prefix, config.station);
        let options = mqtt::options(address, format!("surfaced-test-{}", std::process::id()))?;
        let done = runtime.block_on(tried(publish(options, &topic, text)));
        tests.push(OutputTest::of(format!("{address}/{}/test", config.station), done));
    }
    Ok(tests)
}

impl OutputTest {
    fn of(output: String, done: Result<String, String>) -> Self {
        Self { output, arrived: done.is_ok(), said: done.unwrap_or_else(|why| why) }
    }
}

async fn tried(work: impl Future<Output = Result<String, String>>) -> Result<String, String> {
    timeout(TEST_PATIENCE, work).await.unwrap_or_else(|_| Err("no answer in time".into()))
}

async fn post(receiver: &Receiver, text: String) -> Result<String, String> {
    let status = http::post(receiver, text).await?;
    if status.is_success() { Ok(format!("taken with {status}")) } else { Err(status.to_string()) }
}

async fn publish(options: MqttOptions, topic: &str, text: String) -> Result<String, String> {
    let (mut line, begin) = (Line::open(options), Instant::now());
    let published = line.client.try_publish(topic, QoS::AtLeastOnce, false, text);
    published.map_err(|error| error.to_string())?;
    while let Some(event) = line.events.recv().await {
        if let Event::Incoming(Packet::PubAck(_)) = event.map_err(|error| error.to_string())? {
            let _ = line.client.try_disconnect();
            return Ok(format!("acknowledged after {} ms", begin.elapsed().as_millis()));
        }
    }
    Err("the connection ended".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_that_the_outbox_never_got_stay_counted() {
        let dir = tempfile::tempdir().unwrap();
        let outbox = Outbox::open(dir.path(), "http").unwrap();
        let health = OutputHealth::new("http://here".into(), &outbox);
        health.not_taken();
        health.not_taken();
        health.holds(&outbox);
        assert_eq!(health.view().dropped, 2);
    }

    #[test]
    fn attempts_grow_rarer_up_to_one_a_minute() {
        let mut back_off = BackOff::new();
        let waits: Vec<u64> = (0..9).map(|_| back_off.next().as_millis() as u64).collect();
        assert_eq!(waits, [500, 1000, 2000, 4000, 8000, 16_000, 32_000, 60_000, 60_000]);
        back_off.reset();
        assert_eq!(back_off.next(), BackOff::FIRST);
    }
}
