//! The server: its thread, and the reporter that passes station events on to it.

use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use axum::Router;
use crossbeam_channel::Sender;
use tokio::sync::{mpsc, watch};

use super::guard::Traffic;
use super::hub::{self, Hub};
use super::settings::{ServeError, Settings};
use super::{accept, api};
use crate::station::{Command, Listener, StationEvent};

/// A server at work; dropping it ends it.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
}

/// How long the end of the server waits for events not sent yet, and again for answers under way.
const SHUTDOWN_GRACE: Duration = Duration::from_millis(300);

impl Server {
    /// Starts to serve; commands go to the station through `orders`.
    ///
    /// # Errors
    /// If other machines reach the address and there is no token, if the address cannot be used, or
    /// if no thread can be started.
    pub fn start(
        settings: &Settings,
        orders: Sender<Command>,
    ) -> Result<(Self, Reporter), ServeError> {
        let (reporter, notices) = pair();
        let hub = Arc::new(Hub::new(settings, orders, reporter.missed()));
        let served = (api::router(hub.clone(), settings), hub.traffic.clone());
        let server = Self::serve(settings, served, |stopped| hub::run(hub, notices, stopped))?;
        Ok((server, reporter))
    }

    /// Serves a router, while other work goes on, on one thread.
    ///
    /// # Errors
    /// As [`Server::start`].
    pub(crate) fn serve<W: Future<Output = ()> + Send + 'static>(
        settings: &Settings,
        served: (Router, Arc<Traffic>),
        work: impl FnOnce(watch::Receiver<bool>) -> W + Send + 'static,
    ) -> Result<Self, ServeError> {
        if !settings.address.ip().is_loopback() && settings.token.is_none() {
            return Err(ServeError::Open(settings.address));
        }
        let bind = |error| ServeError::Bind { address: settings.address, error };
        let listener = TcpListener::bind(settings.address).map_err(bind)?;
        listener.set_nonblocking(true).map_err(ServeError::System)?;
        let address = listener.local_addr().map_err(ServeError::System)?;
        let (stop, stopped) = watch::channel(false);
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_io()
            .enable_time()
            .build()
            .map_err(ServeError::System)?;
        let listener = {
            let _inside = runtime.enter();
            tokio::net::TcpListener::from_std(listener).map_err(ServeError::System)?
        };
        let settings = settings.clone();
        let run = move || {
            runtime.block_on(async move {
                let publishing = tokio::spawn(work(stopped.clone()));
                accept::serve(listener, served, &settings, stopped).await;
                // Events that were queued before the end are still sent, to subscribers who read at
                // once.
                let _ = tokio::time::timeout(SHUTDOWN_GRACE, publishing).await;
            });
            // No longer: an edit of the library may wait for the disk or another program.
            runtime.shutdown_timeout(SHUTDOWN_GRACE);
        };
        let thread = std::thread::Builder::new()
            .name("serve".into())
            .spawn(run)
            .map_err(ServeError::System)?;
        Ok(Self { address, stop, thread: Some(thread) })
    }

    /// The address, with the port that was picked.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Ends all connections; answers under way get a moment.
    pub fn stop(mut self) {
        self.end();
    }

    fn end(&mut self) {
        self.stop.send_replace(true);
        if let Some(thread) = self.thread.take() {
            // The thread's connections are closed even if it panicked.
            let _ = thread.join();
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.end();
    }
}

/// Most events in the queue.
const QUEUE: usize = 1024;
/// Traces leave this many places in the queue free for more important events.
const KEPT_FREE: usize = 768;

/// Passes the events of the station on to the server.
#[derive(Debug)]
pub struct Reporter {
    queue: mpsc::Sender<StationEvent>,
    missed: Arc<AtomicU64>,
}

/// A reporter, and the events that it passes on.
fn pair() -> (Reporter, mpsc::Receiver<StationEvent>) {
    let (queue, notices) = mpsc::channel(QUEUE);
    (Reporter { queue, missed: Arc::default() }, notices)
}

impl Reporter {
    /// The number of events that found no room in the queue.
    fn missed(&self) -> Arc<AtomicU64> {
        self.missed.clone()
    }
}

impl Listener for Reporter {
    fn on_event(&mut self, event: &StationEvent) {
        // The server needs neither signs of life nor whole scans.
        if matches!(event, StationEvent::Alive | StationEvent::Scan(_)) {
            return;
        }
        let room = self.queue.capacity();
        let fits = !matches!(event, StationEvent::Trace(_)) || room > KEPT_FREE;
        if !fits || self.queue.try_send(event.clone()).is_err() {
            self.missed.fetch_add(1, Ordering::Relaxed);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scan::Trace;

    #[test]
    fn a_server_that_does_not_read_holds_up_nothing_and_keeps_room_for_what_matters() {
        let (mut reporter, mut notices) = pair();
        let trace = StationEvent::Trace(Arc::new(Trace { fresh: vec![], images: vec![] }));
        (0..10 * QUEUE).for_each(|_| reporter.on_event(&trace));
        (0..10).for_each(|n| reporter.on_event(&StationEvent::Warning(n.to_string())));
        let mut warnings = 0;
        while let Ok(event) = notices.try_recv() {
            warnings += usize::from(matches!(event, StationEvent::Warning(_)));
        }
        assert_eq!(warnings, 10);
        let kept = (QUEUE - KEPT_FREE) as u64;
        assert_eq!(reporter.missed().load(Ordering::Relaxed), 10 * QUEUE as u64 - kept);
    }
}
