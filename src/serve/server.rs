//! The server's thread, and the reporter that passes events from the station to that thread.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use axum::Router;
use crossbeam_channel::Sender;
use tokio::net::TcpListener;
use tokio::sync::{mpsc, watch};

use super::guard::Traffic;
use super::hub::{self, Hub};
use super::settings::{ServeError, Settings};
use super::{accept, api};
use crate::station::{Command, Listener, StationEvent};

/// A running server; dropping it stops the server.
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
    /// If other machines can reach the address but no token is set, if the address cannot be used,
    /// or if no thread can be started.
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
        if !settings.address.ip().is_loopback() && settings.token.is_none() {
            return Err(ServeError::Open(settings.address));
        }
        let bind = |error| ServeError::Bind { address: settings.address, error };
        let (stop, stopped) = watch::channel(false);
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_io()
            .enable_time()
            .build()
            .map_err(ServeError::System)?;
        let listener = runtime.block_on(TcpListener::bind(settings.address)).map_err(bind)?;
        let address = listener.local_addr().map_err(ServeError::System)?;
        let settings = settings.clone();
        let run = move || {
            runtime.block_on(async move {
                let publishing = tokio::spawn(work(stopped.clone()));
                accept::serve(listener, served, &settings, stopped).await;
                // Events that were queued before the end are still sent to subscribers that read
                // quickly.
                let _ = tokio::time::timeout(SHUTDOWN_GRACE, publishing).await;
            });
            // An edit of the library may wait long for the disk or another program, so it is given up.
            runtime.shutdown_timeout(SHUTDOWN_GRACE);
        };
        let thread = std::thread::Builder::new()
            .name("serve".into())
            .spawn(run)
            .map_err(ServeError::System)?;
        Ok(Self { address, stop, thread: Some(thread) })
    }

    /// The address of the server, with the actual port.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Stops the server. Unfinished answers get a moment, then all connections end.
    pub fn stop(self) {}
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
    /// Creates a reporter, and the receiver of its events.
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
        let (mut reporter, mut notices) = Reporter::new();
        let trace = StationEvent::Trace(Arc::new(Trace { fresh: vec![], images: vec![] }));
        (0..10 * QUEUE).for_each(|_| reporter.on_event(&trace));
        (0..10).for_each(|n| reporter.on_event(&StationEvent::Warning(n.to_string())));
        let mut warnings = 0;
        while let Ok(event) = notices.try_recv() {
            warnings += usize::from(matches!(event, StationEvent::Warning(_)));
        }
        assert_eq!(warnings, 10);
        let kept = (QUEUE - KEPT_FREE) as u64;
        assert_eq!(reporter.missed.load(Ordering::Relaxed), 10 * QUEUE as u64 - kept);
    }
}
