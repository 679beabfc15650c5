//! Sends answers to other programs, by HTTP POST and by MQTT, if the configuration gives addresses.
//! README.md beside this file describes the interface.
//!
//! Each output has its own thread, so it cannot delay the station. An outbox on disk holds the
//! answers that have not arrived. Each is sent after the one before it has arrived.
//! A receiver recognises a repeated answer by its `id`.

#![warn(missing_docs)]

mod alert;
pub(crate) mod http;
pub(crate) mod message;
pub(crate) mod mqtt;
mod outbox;
mod tls;

use std::convert::Infallible;
use std::error::Error;
use std::future::Future;
use std::path::Path;
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};

use rumqttc::{Event, MqttOptions, Packet, QoS};
use serde::Serialize;
use tokio::sync::mpsc;
use tokio::time::{Interval, MissedTickBehavior, interval, timeout};

use self::alert::{Alert, Watch};
use self::http::Receiver;
use self::message::StationCard;
use self::mqtt::Line;
use self::outbox::Outbox;
use crate::history::{History, HistoryError};
use crate::scan::Scan;
use crate::station::config::{AlertCause, HttpAddress, OutputsConfig};
use crate::station::{Answer, Change, End, Listener, StationEvent};
use crate::trial::Doubt;

pub(crate) use surfaced_method::system::lock;

/// How many answers may wait between the station and an outbox.
const QUEUE: usize = 256;
/// Begins the name of the outbox of an alert; the alert's name follows.
const ALERT: &str = "alert-";
/// How long the program, at its end, waits for answers that are being sent.
const PATIENCE: Duration = Duration::from_secs(2);

/// The state of an output, for programs and for the page.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct OutputView {
    /// The address that answers go to.
    pub output: String,
    /// The name of the alert that is sent there; `None` for all answers.
    pub alert: Option<String>,
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
    fn new(output: String, alert: Option<&str>) -> Self {
        let (alert, problem) = (alert.map(String::from), None);
        let view = OutputView { output, alert, waiting: 0, failures: 0, dropped: 0, problem };
        Self(Arc::new(Mutex::new(OutputState { view, not_taken: 0 })))
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

#[derive(Debug)]
enum Said {
    Answer(Arc<Answer>),
    /// For the broker alone: by HTTP the answers to the stretches are sent.
    Change(Arc<Change>),
    Alert(Arc<Alert>),
}

/// Sends the answers of a station to one address.
#[derive(Debug)]
pub struct Output {
    said: Option<mpsc::Sender<Said>>,
    health: OutputHealth,
    wants: Wants,
    end: End,
}

/// The events that an output gets.
#[derive(Debug, Default)]
struct Wants {
    /// The state of the station, of which the broker hears.
    card: Option<Card>,
    /// All answers, and not only alerts.
    answers: bool,
    alerts: Vec<Watch>,
}

type Card = Arc<Mutex<StationCard>>;

/// An interval that goes on from a tick that comes late.
pub(crate) fn every(period: Duration) -> Interval {
    let mut interval = interval(period);
    interval.set_missed_tick_behavior(MissedTickBehavior::Delay);
    interval
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
        let health = OutputHealth::new(output.1, output.0.strip_prefix(ALERT));
        health.holds(&outbox);
        Ok(Self { station: station.into(), outbox, health })
    }

    /// Puts an answer or an alert into the outbox. A change is of no use later.
    fn add(&mut self, said: &Said) {
        let (station, outbox) = (&self.station, &mut self.outbox);
        let added = match said {
            Said::Answer(answer) => outbox.push(|number| message::answer(station, number, answer)),
            Said::Alert(alert) => {
                outbox.push(|number| message::event(station, Some(number), &**alert))
            }
            Said::Change(_) => return,
        };
        if let Err(error) = added {
            self.health
                .failed(&format!("{error}; answers wait in memory, and end with the program"));
        }
        self.health.holds(&self.outbox);
    }

    fn first(&self) -> Option<(u64, String)> {
        let first = self.outbox.first().inspect_err(|error| self.health.failed(&error.to_string()));
        first.ok().flatten()
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
        let OutputsConfig { station, http, mqtt, alerts } = config;
        let history = shown.0;
        let folder = folder.join(station);
        let post = |name: &str, address: &HttpAddress, wants| {
            let pending = Pending::open(&folder, (name, address.to_string()), station)?;
            let (health, receiver) = (pending.health.clone(), Receiver::of(address)?);
            Self::new(health, wants, history, |said| http::post_all(pending, receiver, said))
        };
        let of_rule = |rule| Wants { alerts: vec![Watch::new(rule)], ..Wants::default() };
        let mut outputs = Vec::new();
        if let Some(address) = http {
            outputs.push(post("http", address, Wants { answers: true, ..Wants::default() })?);
        }
        if let Some(address) = mqtt {
            let output = ("mqtt", format!("{address}/{station}"));
            let pending = Pending::open(&folder, output, station)?;
            let (health, card) = (pending.health.clone(), Card::default());
            let publisher = mqtt::Publisher::new(pending, address, card.clone(), shown)?;
            let alerts = alerts.iter().map(Watch::new).collect();
            let wants = Wants { card: Some(card), answers: true, alerts };
            outputs.push(Self::new(health, wants, history, |answers| publisher.run(answers))?);
        }
        for rule in alerts {
            if let Some(address) = &rule.http {
                outputs.push(post(&format!("{ALERT}{}", rule.name), address, of_rule(rule))?);
            }
            if let Some(coil) = rule.coil.clone() {
                let health = OutputHealth::new(coil.to_string(), Some(&rule.name));
                let hold = rule.hold;
                let own = health.clone();
                let switch = move |alerts| alert::switch_all(own, coil, hold, alerts);
                outputs.push(Self::new(health, of_rule(rule), history, switch)?);
            }
        }
        Ok(outputs)
    }

    /// Creates an output that runs `work` on its own thread, and watches the drift there if a rule is for it.
    fn new<F: Future<Output = ()>>(
        health: OutputHealth,
        mut wants: Wants,
        history: &Arc<History>,
        work: impl FnOnce(mpsc::Receiver<Said>) -> F + Send + 'static,
    ) -> Result<Self, HistoryError> {
        let (said, to_send) = mpsc::channel(QUEUE);
        let (working, ended) = crossbeam_channel::bounded::<Infallible>(0);
        let system = |error| HistoryError::Io { path: health.view().output.into(), error };
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        let runtime = runtime.map_err(system)?;
        let is_for_drift = |watch: &mut Watch| watch.rule.on == AlertCause::Drift;
        let for_drift: Vec<_> = wants.alerts.extract_if(.., is_for_drift).collect();
        if !for_drift.is_empty() {
            let said = said.downgrade();
            runtime.spawn(alert::watch_drift(history.clone(), for_drift, said));
        }
        let run = move || {
            let _working = working;
            runtime.block_on(work(to_send));
        };
        std::thread::Builder::new().name("output".into()).spawn(run).map_err(system)?;
        Ok(Self { said: Some(said), health, wants, end: End::of(ended) })
    }

    /// A handle by which the state of the output can be read at any time.
    pub fn health(&self) -> OutputHealth {
        self.health.clone()
    }
}

impl Listener for Output {
    fn on_event(&mut self, event: &StationEvent) {
        if self.end.is_here(event) {
            self.said.take();
        }
        let Wants { card, answers, alerts } = &mut self.wants;
        if let Some(card) = card {
            lock(card).take(event);
            if let (StationEvent::Change(change), Some(said)) = (event, &self.said) {
                // A change that finds no room is dropped; the answer to its stretch is not.
                let _ = said.try_send(Said::Change(change.clone()));
            }
        }
        let (StationEvent::Answer(answer) | StationEvent::Unnamed(answer)) = event else { return };
        let compared = matches!(event, StationEvent::Answer(_));
        let news = (*answers && compared).then(|| Said::Answer(answer.clone()));
        let alerts = alerts.iter_mut().filter_map(|watch| watch.hears(answer)).map(Said::Alert);
        let Some(said) = &self.said else { return };
        for one in news.into_iter().chain(alerts) {
            if said.try_send(one).is_err() {
                self.health.not_taken();
                self.health.failed(&format!(
                    "the disk is too slow: {QUEUE} answers are to be written, so answer {} is dropped",
                    answer.id
                ));
            }
        }
    }
}

impl Drop for Output {
    fn drop(&mut self) {
        self.said.take();
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
}

/// Reads the passwords and the certificates of the outputs, without connecting.
pub(crate) fn check(config: &OutputsConfig) -> Result<(), HistoryError> {
    let of_alerts = config.alerts.iter().filter_map(|alert| alert.http.as_ref());
    let mut posted = config.http.iter().chain(of_alerts);
    posted.try_for_each(|address| Receiver::of(address).map(drop))?;
    let mut published = config.mqtt.iter();
    published.try_for_each(|address| mqtt::options(address, "surfaced".into()).map(drop))
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
    let posted = |address: &HttpAddress| {
        let receiver = Receiver::of(address)?;
        let done = runtime.block_on(within(TEST_PATIENCE, post(&receiver, text.clone())));
        Ok::<_, HistoryError>(OutputTest::of(address.to_string(), done))
    };
    let mut tests = config.http.iter().map(posted).collect::<Result<Vec<_>, _>>()?;
    if let Some(address) = &config.mqtt {
        let topic = format!("{}/{}/test", address.prefix, config.station);
        let options = mqtt::options(address, format!("surfaced-test-{}", std::process::id()))?;
        let done = runtime.block_on(within(TEST_PATIENCE, publish(options, &topic, text.clone())));
        tests.push(OutputTest::of(format!("{address}/{}/test", config.station), done));
    }
    for alert in &config.alerts {
        if let Some(address) = &alert.http {
            tests.push(posted(address)?);
        }
        if let Some(coil) = &alert.coil {
            let done = runtime.block_on(within(TEST_PATIENCE, alert::read(coil)));
            let said = |on| format!("the coil is {}", if on { "on" } else { "off" });
            tests.push(OutputTest::of(coil.to_string(), done.map(said)));
        }
    }
    Ok(tests)
}

impl OutputTest {
    fn of(output: String, done: Sent<String>) -> Self {
        Self { output, arrived: done.is_ok(), said: done.unwrap_or_else(|why| why.to_string()) }
    }
}

/// The result of sending something, or the reason why it failed.
pub(crate) type Sent<T> = Result<T, Box<dyn Error + Send + Sync>>;

/// The result of `work`, which fails if it takes too long.
async fn within<T>(patience: Duration, work: impl Future<Output = Sent<T>>) -> Sent<T> {
    timeout(patience, work).await.unwrap_or_else(|_| Err("no answer in time".into()))
}

async fn post(receiver: &Receiver, text: String) -> Sent<String> {
    let status = http::post(receiver, text).await?;
    if status.is_success() { Ok(format!("taken with {status}")) } else { Err(status.to_string())? }
}

async fn publish(options: MqttOptions, topic: &str, text: String) -> Sent<String> {
    let (mut line, begin) = (Line::open(options), Instant::now());
    line.client.try_publish(topic, QoS::AtLeastOnce, false, text)?;
    while let Some(event) = line.events.recv().await {
        if let Event::Incoming(Packet::PubAck(_)) = event? {
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
        let health = OutputHealth::new("http://here".into(), None);
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
    }
}
