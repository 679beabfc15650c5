//! One view of the stations of a broker: their states, their last answers, and the history of all.
//!
//! There is no engine here. Answers and states come from the broker ([`subscriber`]), by a session
//! that lasts and with acknowledgements, into a bounded [`cache`] on disk. What the broker could not
//! keep, and all of a cache that was thrown away, is read from the stations' own histories
//! ([`refill`]). [`api`] serves one page and one interface.

mod api;
mod cache;
mod refill;
mod state;
mod subscriber;

use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use self::cache::Cache;
use self::state::Stations;
use crate::history::HistoryError;
use crate::outputs::broker;
use crate::serve::{ServeError, Server, Settings, Traffic};
use crate::station::config::{MqttAddress, machine_name};

/// Settings of a fleet.
#[derive(Clone, Debug)]
pub struct FleetSettings {
    /// The broker, and where on it topics begin.
    pub broker: MqttAddress,
    /// The folder of the cache.
    pub cache: PathBuf,
    /// Most bytes of the cache.
    pub most_bytes: u64,
    /// Settings of the server.
    pub serve: Settings,
}

/// Reasons why a fleet cannot be shown.
#[derive(Debug, thiserror::Error)]
pub enum FleetError {
    /// the cache, or a certificate
    #[error(transparent)]
    File(#[from] HistoryError),
    /// the server
    #[error(transparent)]
    Serve(#[from] ServeError),
}

/// State shared by the handlers of requests and of messages.
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
    /// Why the broker is not connected, if so.
    problem: Option<String>,
}

impl Fleet {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        // Each change leaves it whole.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Shows a fleet until the server is dropped.
///
/// # Errors
/// If the cache or a certificate cannot be read, another fleet uses the cache, or as
/// [`Server::start`].
pub fn start(settings: FleetSettings) -> Result<Server, FleetError> {
    let FleetSettings { broker: address, cache: folder, most_bytes, serve } = settings;
    let cache = Cache::open(&folder, most_bytes)?;
    // The same after a restart, whatever became of the cache: the broker knows its session by it.
    let place = format!("{}:{}", machine_name(), folder.display());
    let client = format!("surfaced-fleet-{:08x}", crc32fast::hash(place.as_bytes()));
    let mut options = broker::options(&address, client)?;
    options.set_clean_session(false).set_manual_acks(true);
    let stations = Stations::of(&cache);
    let problem = Some("connecting".into());
    let inner = Mutex::new(Inner { cache, stations, broker: address.to_string(), problem });
    let fleet = Arc::new(Fleet { inner, traffic: Arc::default() });
    let served = (api::router(fleet.clone(), &serve), fleet.traffic.clone());
    let work = |mut stopped: tokio::sync::watch::Receiver<bool>| async move {
        tokio::select! {
            () = subscriber::subscribe(&fleet, &options, &address.prefix) => {}
            () = refill::refill(&fleet) => {}
            _ = stopped.wait_for(|stop| *stop) => {}
        }
    };
    Ok(Server::serve(&serve, served, work)?)
}
