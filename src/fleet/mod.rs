//! One view of all stations of a broker, with their states, last answers, and common history.
//!
//! A fleet names no scans itself. Answers and states come from the broker, through a lasting
//! session with acknowledgements, and are stored in a bounded [`cache`] on disk. Answers that the
//! broker or the cache has lost are read from the stations' histories ([`refill`]). [`api`] serves
//! the page and the HTTP API.

mod api;
mod cache;
mod refill;
mod state;

use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rumqttc::{Event, MqttOptions, Packet, QoS};
use serde_json::Value;

use self::cache::Cache;
use self::state::Stations;
use crate::history::HistoryError;
use crate::outputs::BackOff;
use crate::outputs::broker::{self, Line};
use crate::serve::{ServeError, Server, Settings, Traffic};
use crate::station::config::{MqttAddress, is_segment, machine_name};

#[derive(Debug, thiserror::Error)]
pub enum FleetError {
    #[error(transparent)]
    File(#[from] HistoryError),
    #[error(transparent)]
    Serve(#[from] ServeError),
}

/// State shared by the handlers of requests and messages.
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

/// Shows the stations of a broker until the server is dropped. Answers are kept in `folder`, which
/// takes at most `most_bytes`.
///
/// # Errors
/// If the cache or a certificate cannot be read, if another fleet uses the cache, or those of
/// [`Server::start`].
pub fn start(
    address: MqttAddress,
    folder: &Path,
    most_bytes: u64,
    serve: &Settings,
) -> Result<Server, FleetError> {
    let cache = Cache::open(folder, most_bytes)?;
    // The broker finds our session by this name, so the name must be the same after a restart.
    let place = format!("{}:{}", machine_name(), folder.display());
    let client = format!("surfaced-fleet-{:08x}", crc32fast::hash(place.as_bytes()));
    let mut options = broker::options(&address, client)?;
    options.set_clean_session(false).set_manual_acks(true);
    let stations = Stations::of(&cache);
    let problem = Some("connecting".into());
    let inner = Mutex::new(Inner { cache, stations, broker: address.to_string(), problem });
    let fleet = Arc::new(Fleet { inner, traffic: Arc::default() });
    let served = (api::router(fleet.clone(), serve), fleet.traffic.clone());
    let work = |mut stopped: tokio::sync::watch::Receiver<bool>| async move {
        tokio::select! {
            () = subscribe(&fleet, &options, &address.prefix) => {}
            () = refill::refill(&fleet) => {}
            _ = stopped.wait_for(|stop| *stop) => {}
        }
    };
    Ok(Server::serve(serve, served, work)?)
}

/// Subscribes to all stations, and reconnects whenever the connection breaks. A message is
/// acknowledged after it was written to disk.
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
        tokio::time::sleep(back_off.next()).await;
    }
}

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
    let said: Value = serde_json::from_slice(payload).map_err(|error| error.to_string())?;
    let inner = &mut *fleet.lock();
    match what {
        "state" => inner.stations.stated(station, said.as_object().ok_or("it is no JSON object")?),
        _ => inner.answered(station, &said)?,
    }
    Ok(())
}
