//! The server's thread, the reporter that passes events from the station to that thread, and the
//! connections, whose number, duration and size are limited.

use std::collections::HashMap;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use crossbeam_channel::Sender;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{mpsc, watch};
use tokio_io_timeout::TimeoutStream;
use tower_service::Service;

use super::api;
use super::guard::{Peer, Traffic, neighbourhood};
use super::hub::{self, Hub};
use super::settings::{Limits, ServeError, Settings};
use crate::station::{Command, Listener, StationEvent};

/// A running server. Dropping it ends all connections; unfinished answers get a moment before.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
}

/// How long a stopping server waits for unsent events, and again for unfinished answers.
const SHUTDOWN_GRACE: Duration = Duration::from_millis(300);

impl Server {
    /// Starts the server. It sends commands to the station through `orders`.
    ///
    /// # Errors
    /// If other machines can reach the address but no token is set, if operators have a token but
    /// administrators have none or the same, if the address cannot be used, or if no thread can be
    /// started.
    pub fn start(
        settings: &Settings,
        orders: Sender<Command>,
    ) -> Result<(Self, Reporter), ServeError> {
        let (reporter, notices) = Reporter::new();
        let hub = Arc::new(Hub::new(settings, orders, reporter.missed.clone()));
        let served = (api::router(hub.clone(), settings), hub.traffic.clone());
        let server = Self::serve(settings, served, |stopped| hub::run(hub, notices, stopped))?;
        Ok((server, reporter))
    }

    /// Starts a thread that serves a router and runs other work.
    pub(crate) fn serve<W: Future<Output = ()> + Send + 'static>(
        settings: &Settings,
        served: (Router, Arc<Traffic>),
        work: impl FnOnce(watch::Receiver<bool>) -> W + Send + 'static,
    ) -> Result<Self, ServeError> {
        settings.check_tokens()?;
        let bind = |error| ServeError::Bind { address: settings.address, error };
        let (stop, stopped) = watch::channel(false);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let listener = runtime.block_on(TcpListener::bind(settings.address)).map_err(bind)?;
        let address = listener.local_addr()?;
        let settings = settings.clone();
        let run = move || {
            runtime.block_on(async move {
                let publishing = tokio::spawn(work(stopped.clone()));
                accept(listener, served, &settings, stopped).await;
                // Events queued before the end are still sent to subscribers that read quickly.
                let _ = tokio::time::timeout(SHUTDOWN_GRACE, publishing).await;
            });
            // An edit of the library may wait long for the disk or another program, so it is given up.
            runtime.shutdown_timeout(SHUTDOWN_GRACE);
        };
        let thread = std::thread::Builder::new().name("serve".into()).spawn(run)?;
        Ok(Self { address, stop, thread: Some(thread) })
    }

    /// The address of the server, with the actual port.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.stop.send_replace(true);
        if let Some(thread) = self.thread.take() {
            // The result is ignored, since a thread that panicked has closed its connections, too.
            let _ = thread.join();
        }
    }
}

const QUEUE: usize = 1024;
/// Traces leave this many places of the queue free for more important events.
const KEPT_FREE: usize = 768;

/// Passes events from the station to the server.
#[derive(Debug)]
pub struct Reporter {
    queue: mpsc::Sender<StationEvent>,
    /// Number of events for which the queue had no room.
    missed: Arc<AtomicU64>,
}

impl Reporter {
    fn new() -> (Self, mpsc::Receiver<StationEvent>) {
        let (queue, notices) = mpsc::channel(QUEUE);
        (Self { queue, missed: Arc::default() }, notices)
    }
}

impl Listener for Reporter {
    fn on_event(&mut self, event: &StationEvent) {
        // The server needs neither replies to `Ping` nor whole scans.
        if matches!(event, StationEvent::Alive | StationEvent::Scan(_)) {
            return;
        }
        let fits = !matches!(event, StationEvent::Trace(_)) || self.queue.capacity() > KEPT_FREE;
        if !fits || self.queue.try_send(event.clone()).is_err() {
            self.missed.fetch_add(1, Ordering::Relaxed);
        }
    }
}

const MOST_HEADER_BYTES: usize = 16 << 10;
const MOST_HEADERS: usize = 64;
/// The pause after a connection could not be accepted, for example because file handles ran out.
const NO_CONNECTION: Duration = Duration::from_millis(100);

async fn accept(
    listener: TcpListener,
    (router, traffic): (Router, Arc<Traffic>),
    settings: &Settings,
    mut stop: watch::Receiver<bool>,
) {
    let mut places = Places { settings, taken: HashMap::new() };
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            _ = stop.wait_for(|stop| *stop) => return,
        };
        let Ok((stream, peer)) = accepted else {
            tokio::time::sleep(NO_CONNECTION).await;
            continue;
        };
        // If no place is free, dropping the stream closes the connection.
        let Some(place) = places.take(peer.ip()) else {
            traffic.refused.fetch_add(1, Ordering::Relaxed);
            continue;
        };
        let connection = connection(stream, Peer(peer), router.clone(), settings.limits.clone());
        tokio::spawn(async move {
            connection.await;
            drop(place);
        });
    }
}

/// Places for connections. Their number is limited in total, and for each address.
struct Places<'a> {
    settings: &'a Settings,
    /// One shared handle for each address. Each place that is taken holds a clone of it.
    taken: HashMap<IpAddr, Arc<()>>,
}

impl Places<'_> {
    /// Takes a place if the address may have one; dropping the result frees the place. For proxies,
    /// which serve many clients, only the total limit applies.
    fn take(&mut self, address: IpAddr) -> Option<Arc<()>> {
        let count = |place: &Arc<()>| Arc::strong_count(place) - 1;
        self.taken.retain(|_, place| count(place) > 0);
        let Limits { connections: all, connections_an_address, .. } = self.settings.limits;
        let is_proxy = self.settings.proxies.contains(&address.to_canonical());
        let most = if is_proxy { all } else { connections_an_address };
        let address = neighbourhood(address);
        let of_address = self.taken.get(&address).map_or(0, count);
        if of_address >= most || self.taken.values().map(count).sum::<usize>() >= all {
            return None;
        }
        Some(self.taken.entry(address).or_default().clone())
    }
}

async fn connection(stream: TcpStream, peer: Peer, router: Router, limits: Limits) {
    // Events are small and must go out at once. Without this option, they would only be later.
    let _ = stream.set_nodelay(true);
    let mut stream = TimeoutStream::new(stream);
    stream.set_write_timeout(Some(limits.unread));
    let service = service_fn(|mut request: hyper::Request<Incoming>| {
        request.extensions_mut().insert(peer);
        router.clone().call(request.map(Body::new))
    });
    let serving = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(limits.request)
        .max_buf_size(MOST_HEADER_BYTES)
        .max_headers(MOST_HEADERS)
        .serve_connection(TokioIo::new(Box::pin(stream)), service);
    // An error ends only the connection of its client, so the error is ignored.
    let _ = serving.await;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::{Warning, WarningKind};
    use crate::scan::Trace;

    #[test]
    fn a_server_that_does_not_read_holds_up_nothing_and_keeps_room_for_what_matters() {
        let (mut reporter, mut notices) = Reporter::new();
        let trace = StationEvent::Trace(Arc::new(Trace { fresh: vec![], images: vec![] }));
        (0..10 * QUEUE).for_each(|_| reporter.on_event(&trace));
        let warning = StationEvent::Warning(Warning::new(WarningKind::Damaged, "lost"));
        (0..10).for_each(|_| reporter.on_event(&warning));
        let mut warnings = 0;
        while let Ok(event) = notices.try_recv() {
            warnings += usize::from(matches!(event, StationEvent::Warning(_)));
        }
        assert_eq!(warnings, 10);
        let kept = (QUEUE - KEPT_FREE) as u64;
        assert_eq!(reporter.missed.load(Ordering::Relaxed), 10 * QUEUE as u64 - kept);
    }

    #[test]
    fn no_address_takes_all_places_and_a_place_is_free_again() {
        let limits = Limits { connections: 5, connections_an_address: 2, ..Limits::default() };
        let proxies = vec!["10.0.0.9".parse().unwrap()];
        let settings = Settings { limits, proxies, ..Settings::default() };
        let mut places = Places { settings: &settings, taken: HashMap::new() };
        let mut take = |address: &str| places.take(address.parse().unwrap());
        let mut first: Vec<_> = (0..2).filter_map(|_| take("10.0.0.1")).collect();
        assert!(first.len() == 2 && take("10.0.0.1").is_none());
        let behind_proxy: Vec<_> = (0..3).filter_map(|_| take("10.0.0.9")).collect();
        assert!(take("10.0.0.2").is_none(), "all five are taken");
        first.pop();
        assert!(take("10.0.0.2").is_some());
        drop((first, behind_proxy));
        assert!(take("10.0.0.3").is_some() && places.taken.len() == 1);
    }
}
