//! One view of all stations of a broker, with their states, last answers, and common history.
//!
//! A fleet names no scans itself. Answers and states come from the broker, through a lasting
//! session with acknowledgements, and are stored in a bounded [`cache`] on disk. Answers that the
//! broker or the cache has lost are read from the stations' histories. [`api`] serves
//! the page and the HTTP API.

mod api;
mod cache;
mod state;

use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use axum::body::{Body, to_bytes};
use axum::http::{Request, StatusCode};
use rumqttc::{Event, MqttOptions, Packet, QoS};
use serde::Deserialize;
use serde_json::Value;
use tokio::time::{sleep, timeout};

use self::cache::Cache;
use self::state::Stations;
use crate::history::HistoryError;
use crate::outputs::BackOff;
use crate::outputs::http;
use crate::outputs::mqtt::{self, Line};
use crate::serve::{ServeError, Server, Settings, Traffic};
use crate::station::config::{HttpAddress, MqttAddress, is_segment, machine_name};

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
}

impl Inner {
    /// Stores an answer of a station, if it is new.
    fn answered(&mut self, station: &str, answer: &Value) -> Result<(), String> {
        if let Some(head) = self.cache.add(station, answer)? {
            self.stations.answered(&head);
        }
        Ok(())
    }
}

impl Fleet {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        // Each change leaves the value valid, so the value can be used even after a panic.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Shows the stations of a broker until the server is dropped. `folder` keeps the answers.
pub(crate) fn start(
    address: MqttAddress,
    folder: &Path,
    most_bytes: u64,
    serve: &Settings,
) -> Result<Server, ServeError> {
    let system = |error: HistoryError| ServeError::System(error.into());
    let cache = Cache::open(folder, most_bytes).map_err(system)?;
    // The broker finds our session by this name, so the name must be the same after a restart.
    let place = format!("{}:{}", machine_name(), folder.display());
    let client = format!("surfaced-fleet-{:08x}", crc32fast::hash(place.as_bytes()));
    let mut options = mqtt::options(&address, client).map_err(system)?;
    options.set_clean_session(false).set_manual_acks(true);
    // A larger packet would end the connection, and a retained one would do so again each time.
    options.set_max_packet_size(LARGEST_OF_MQTT, LARGEST_MESSAGE);
    let stations = Stations::of(&cache);
    let problem = Some("connecting".into());
    let (broker, stale_after_s) = (address.to_string(), serve.stale_after_s);
    let inner = Mutex::new(Inner { cache, stations, broker, problem, stale_after_s });
    let fleet = Arc::new(Fleet { inner, traffic: Arc::default() });
    let served = (api::router(fleet.clone(), serve), fleet.traffic.clone());
    let work = |mut stopped: tokio::sync::watch::Receiver<bool>| async move {
        tokio::select! {
            () = subscribe(&fleet, &options, &address.prefix) => {}
            () = refill(&fleet) => {}
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
                    for what in ["answer", "state"] {
                        let topics = format!("{prefix}/+/{what}");
                        // A new connection has an empty queue, so subscribing cannot fail.
                        let _ = line.client.try_subscribe(topics, QoS::AtLeastOnce);
                    }
                }
                Some(Ok(Event::Incoming(Packet::SubAck(_)))) => {
                    back_off.reset();
                    if fleet.lock().problem.take().is_some() {
                        tracing::info!("connected to the broker");
                    }
                }
                Some(Ok(Event::Incoming(Packet::Publish(message)))) => {
                    if let Err(why) = take(fleet, prefix, &message.topic, &message.payload) {
                        tracing::warn!("{}: this message is passed over: {why}", message.topic);
                    }
                    let _ = line.client.ack(&message).await;
                }
                Some(Ok(_)) => {}
                Some(Err(error)) => break error.to_string(),
                None => break "the connection ended".into(),
            }
        };
        let before = fleet.lock().problem.replace(why.clone());
        if before.is_none_or(|before| before == "connecting") {
            tracing::warn!("the broker is not connected: {why}; it is tried again");
        }
        sleep(back_off.next()).await;
    }
}

/// Largest message of a station that is read, in bytes. A larger one is passed over.
const LARGEST_MESSAGE: usize = 256 << 10;
/// Largest packet that MQTT knows, in bytes.
const LARGEST_OF_MQTT: usize = (256 << 20) - 1;

fn take(fleet: &Fleet, prefix: &str, topic: &str, payload: &[u8]) -> Result<(), String> {
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
        return Err(format!("it has {} bytes, more than {LARGEST_MESSAGE}", payload.len()));
    }
    let said: Value = serde_json::from_slice(payload).map_err(|error| error.to_string())?;
    let inner = &mut *fleet.lock();
    match what {
        "state" => inner.stations.stated(station, said.as_object().ok_or("it is no JSON object")?),
        _ => inner.answered(station, &said)?,
    }
    Ok(())
}

/// Interval at which stations with missing answers are looked for.
const EVERY: Duration = Duration::from_secs(1);
/// How many answers one request asks for. The reply may have at most `LARGEST` bytes.
const A_REQUEST: usize = 200;
const LARGEST: usize = 32 << 20;
const MOST_REQUESTS_A_STATION: usize = 500;
const REPLY_PATIENCE: Duration = Duration::from_secs(10);

#[derive(Deserialize)]
struct Scans {
    scans: Vec<Value>,
}

/// Reads missing answers, one station after the other, without end.
async fn refill(fleet: &Fleet) {
    loop {
        sleep(EVERY).await;
        loop {
            let next = fleet.lock().stations.next_to_read();
            let Some((station, page, from_ms)) = next else { break };
            let done = read(fleet, &station, &page, from_ms).await;
            fleet.lock().stations.was_read(&station, from_ms, done);
        }
    }
}

/// Reads the history of a station, from the newest scan back to the time `from_ms`.
async fn read(fleet: &Fleet, station: &str, page: &str, from_ms: u64) -> Result<(), String> {
    let address: HttpAddress = page.parse()?;
    let mut before = String::new();
    for _ in 0..MOST_REQUESTS_A_STATION {
        let scans = request(&address, &before).await?;
        let is_last = scans.len() < A_REQUEST;
        let oldest_ms = scans.last().and_then(|scan| scan["unix_ms"].as_u64()).unwrap_or(0);
        before = format!(
            "&before={}",
            scans.last().and_then(|scan| scan["id"].as_str()).unwrap_or_default()
        );
        for scan in scans {
            add(fleet, station, scan)?;
        }
        if is_last || oldest_ms < from_ms {
            break;
        }
    }
    Ok(())
}

fn add(fleet: &Fleet, station: &str, mut scan: Value) -> Result<(), String> {
    // Outputs send no answer for a scan that could not be compared, so it is skipped here too.
    let was_compared = scan["state"] != "unnamed";
    let Some(fields) = scan.as_object_mut().filter(|_| was_compared) else { return Ok(()) };
    fields.insert("station".into(), station.into());
    // Corrections belong to the station and may change there, so they are removed.
    for said in ["correction", "became", "kept"] {
        fields.remove(said);
    }
    fleet.lock().answered(station, &scan)
}

async fn request(address: &HttpAddress, before: &str) -> Result<Vec<Value>, String> {
    let path = format!("/api/v1/scans?limit={A_REQUEST}{before}");
    let request = Request::get(path).body(Body::empty()).map_err(|error| error.to_string())?;
    let reply = timeout(REPLY_PATIENCE, async {
        let reply = http::send(address, request).await?;
        let status = reply.status();
        let body = to_bytes(Body::new(reply.into_body()), LARGEST).await;
        Ok::<_, String>((status, body.map_err(|error| error.to_string())))
    });
    let (status, body) = reply.await.map_err(|_| "its page gives no answer")??;
    match status {
        StatusCode::OK => {}
        StatusCode::UNAUTHORIZED => return Err("its page asks for a token".into()),
        StatusCode::MISDIRECTED_REQUEST => {
            return Err("its page answers only its own machine; run `surfaced fleet` there".into());
        }
        other => return Err(format!("its page answers {other}")),
    }
    serde_json::from_slice(&body?).map(|Scans { scans }| scans).map_err(|error| error.to_string())
}
