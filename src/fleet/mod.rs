//! One view of all stations of a broker, with their states, last answers, and common history.
//!
//! A fleet names no scans itself. Answers and states come from the broker, through a lasting
//! session with acknowledgements, and are stored in a bounded [`cache`] on disk. Answers that the
//! broker or the cache has lost are read from the stations' histories ([`refill`]), where the administrator
//! allows it. [`api`] serves the page and the HTTP API.

mod api;
mod cache;
mod refill;
mod state;

use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard};

use rumqttc::{Event, MqttOptions, Packet, QoS, SubscribeFilter, SubscribeReasonCode};
use serde_json::Value;
use tokio::time::sleep;

use self::cache::Cache;
pub(crate) use self::refill::Pages;
use self::state::Stations;
use crate::history::HistoryError;
use crate::outputs::mqtt::{self, Line};
use crate::outputs::{BackOff, Sent, lock};
use crate::serve::{ServeError, Server, Settings, Traffic, unix_ms};
use crate::station::config::{MqttAddress, is_segment, machine_name};

#[derive(Debug)]
struct Fleet {
    inner: Mutex<Inner>,
    traffic: Arc<Traffic>,
}

#[derive(Debug)]
struct Inner {
    cache: Cache,
    stations: Stations,
    broker: String,
    /// The reason why the broker is not connected; `None` while it is connected.
    problem: Option<String>,
    stale_after_s: f64,
    /// How many messages were passed over, and what was wrong with the last of them.
    passed_over: (u64, Option<String>),
}

/// How far the clock of a station may be ahead before its times are no longer believed.
const CLOCKS_DIFFER_MS: u64 = 60_000;

impl Inner {
    fn new(cache: Cache, broker: String, stale_after_s: f64) -> Self {
        let (stations, passed_over) = (Stations::of(&cache), Default::default());
        let problem = Some("connecting".into());
        Self { cache, stations, broker, problem, stale_after_s, passed_over }
    }

    /// Stores an answer of a station, if it is new. An answer from the future counts as given now: at
    /// its own time it would stay the newest one.
    fn answered(&mut self, station: &str, mut answer: Value) -> Sent<()> {
        let now = unix_ms();
        let said = answer["unix_ms"].as_u64();
        if let Some(said) = said.filter(|said| *said > now + CLOCKS_DIFFER_MS) {
            if answer["id"].as_str().is_some_and(|id| self.cache.has(station, id)) {
                return Ok(());
            }
            // Only an object has this field, so that others can be set.
            answer["said_unix_ms"] = said.into();
            answer["unix_ms"] = now.into();
        }
        if let Some(head) = self.cache.add(station, &answer)? {
            self.stations.answered(&head);
        }
        Ok(())
    }

    /// Notes that nothing comes from the broker. Of several reasons in a row, the log gets the first.
    fn fails(&mut self, why: String) {
        if self.problem.as_ref().is_none_or(|before| before == "connecting") {
            tracing::warn!("the broker is not connected: {why}; it is tried again");
        }
        self.problem = Some(why);
    }

    fn pass_over(&mut self, topic: &str, why: &str) {
        tracing::warn!("{topic}: this message is passed over: {why}");
        self.passed_over = (self.passed_over.0 + 1, Some(format!("{topic}: {why}")));
    }
}

impl Fleet {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        lock(&self.inner)
    }
}

/// Shows the stations of a broker until the server is dropped. `folder` keeps the answers, in at most
/// `most_bytes`. Missing answers are read from `pages`.
pub(crate) fn start(
    address: MqttAddress,
    (folder, most_bytes): (&Path, u64),
    pages: Vec<Pages>,
    serve: &Settings,
) -> Result<Server, ServeError> {
    let system = |error: HistoryError| std::io::Error::from(error);
    let cache = Cache::open(folder, most_bytes).map_err(system)?;
    // The broker finds our session by this name, so the name must be the same after a restart.
    let place = format!("{}:{}", machine_name(), folder.display());
    let client = format!("surfaced-fleet-{:08x}", crc32fast::hash(place.as_bytes()));
    let mut options = mqtt::options(&address, client).map_err(system)?;
    options.set_clean_session(false).set_manual_acks(true);
    // A larger packet would end the connection, and a retained one would do so again each time.
    options.set_max_packet_size(LARGEST_OF_MQTT, LARGEST_MESSAGE);
    let inner = Inner::new(cache, address.to_string(), serve.stale_after_s);
    let fleet = Arc::new(Fleet { inner: Mutex::new(inner), traffic: Arc::default() });
    let served = (api::router(fleet.clone(), serve), fleet.traffic.clone());
    let work = |mut stopped: tokio::sync::watch::Receiver<bool>| async move {
        tokio::select! {
            () = subscribe(&fleet, &options, &address.prefix) => {}
            () = refill::refill(&fleet, pages.into()) => {}
            _ = stopped.wait_for(|stop| *stop) => {}
        }
    };
    Server::serve(serve, served, work)
}

/// Subscribes to all stations, anew after each break. A message is acknowledged once it is on disk.
async fn subscribe(fleet: &Fleet, options: &MqttOptions, prefix: &str) {
    let mut back_off = BackOff::new();
    loop {
        let mut line = Line::open(options.clone());
        let why = loop {
            match line.events.recv().await {
                Some(Ok(Event::Incoming(Packet::ConnAck(_)))) => {
                    let topics = ["answer", "state"].map(|what| format!("{prefix}/+/{what}"));
                    let topics = topics.map(|one| SubscribeFilter::new(one, QoS::AtLeastOnce));
                    // A new connection has an empty queue, so subscribing cannot fail.
                    let _ = line.client.try_subscribe_many(topics);
                }
                Some(Ok(Event::Incoming(Packet::SubAck(ack)))) => {
                    if ack.return_codes.contains(&SubscribeReasonCode::Failure) {
                        let topics = format!("{prefix}/+/answer or {prefix}/+/state");
                        fleet.lock().fails(format!("it does not let this user read {topics}"));
                        continue;
                    }
                    back_off = BackOff::new();
                    if fleet.lock().problem.take().is_some() {
                        tracing::info!("connected to the broker");
                    }
                }
                Some(Ok(Event::Incoming(Packet::Publish(message)))) => {
                    if let Err(why) = take(fleet, prefix, &message.topic, &message.payload) {
                        fleet.lock().pass_over(&message.topic, &why.to_string());
                    }
                    let _ = line.client.ack(&message).await;
                }
                Some(Ok(_)) => {}
                Some(Err(error)) => break error.to_string(),
                None => break "the connection ended".into(),
            }
        };
        fleet.lock().fails(why);
        sleep(back_off.next()).await;
    }
}

/// Largest message of a station that is read, in bytes. A larger one is passed over.
const LARGEST_MESSAGE: usize = 256 << 10;
/// Largest packet that MQTT knows, in bytes.
const LARGEST_OF_MQTT: usize = (256 << 20) - 1;

fn take(fleet: &Fleet, prefix: &str, topic: &str, payload: &[u8]) -> Sent<()> {
    let below = topic.strip_prefix(prefix).and_then(|rest| rest.strip_prefix('/'));
    let (station, what) = below.and_then(|rest| rest.split_once('/')).unwrap_or_default();
    if !is_segment(station) {
        return Err("the name of its station holds more than letters, digits, `-` and `_`".into());
    }
    // An empty message only deletes a retained message, so it is ignored.
    if payload.is_empty() {
        return Ok(());
    }
    if payload.len() > LARGEST_MESSAGE {
        return Err(format!("it has {} bytes, more than {LARGEST_MESSAGE}", payload.len()).into());
    }
    let said: Value = serde_json::from_slice(payload)?;
    let inner = &mut *fleet.lock();
    if what == "state" {
        let state = said.as_object().ok_or("it is no JSON object")?;
        return Ok(inner.stations.stated(station, state)?);
    }
    inner.answered(station, said)
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};
    use std::net::TcpListener;
    use std::time::Duration;

    use serde_json::json;

    use super::*;

    fn inner(folder: &Path) -> Inner {
        Inner::new(Cache::open(folder, 1 << 20).unwrap(), String::new(), 30.0)
    }

    #[test]
    fn an_answer_from_the_future_counts_as_given_now_and_without_an_id_it_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let mut inner = inner(dir.path());
        let future = unix_ms() + 10 * CLOCKS_DIFFER_MS;
        let mut answer = json!({ "station": "a", "unix_ms": future, "state": "named" });
        assert!(inner.answered("a", answer.clone()).unwrap_err().to_string().contains("`id`"));
        answer["id"] = "20260921-143000.001-01".into();
        (0..2).for_each(|_| inner.answered("a", answer.clone()).unwrap());
        let heads: Vec<_> = inner.cache.heads().collect();
        assert_eq!((heads.len(), heads[0].said_unix_ms), (1, Some(future)));
        assert!(heads[0].unix_ms <= unix_ms());
        // An answer from before says nothing of the station's clock now.
        answer["id"] = "20260921-143000.000-00".into();
        answer["unix_ms"] = (unix_ms() - CLOCKS_DIFFER_MS).into();
        inner.answered("a", answer).unwrap();
        let ahead_ms = inner.stations.view(&inner.cache)[0]["ahead_ms"].as_u64();
        assert!(ahead_ms.is_some_and(|ahead_ms| ahead_ms > 9 * CLOCKS_DIFFER_MS));
    }

    #[test]
    fn a_broker_that_refuses_the_topics_is_a_problem() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            let mut packet = [0; 256];
            assert!(stream.read(&mut packet).unwrap() > 0);
            stream.write_all(&[0x20, 2, 0, 0]).unwrap(); // CONNACK
            assert!(stream.read(&mut packet).unwrap() > 0);
            // SUBACK of the first packet, with a failure for each topic.
            stream.write_all(&[0x90, 4, packet[2], packet[3], 0x80, 0x80]).unwrap();
            while stream.read(&mut packet).is_ok_and(|bytes| bytes > 0) {}
        });
        let dir = tempfile::tempdir().unwrap();
        let fleet = Fleet { inner: Mutex::new(inner(dir.path())), traffic: Arc::default() };
        let options = MqttOptions::new("fleet", "127.0.0.1", port);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let problem = runtime.block_on(async {
            let told = async {
                while fleet.lock().problem.as_deref() == Some("connecting") {
                    sleep(Duration::from_millis(5)).await;
                }
            };
            tokio::select! {
                () = subscribe(&fleet, &options, "surfaced") => {}
                () = told => {}
                () = sleep(Duration::from_secs(30)) => {}
            }
            fleet.lock().problem.clone()
        });
        assert!(problem.as_ref().unwrap().contains("surfaced/+/answer"), "{problem:?}");
    }
}
