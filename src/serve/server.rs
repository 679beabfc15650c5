//! The server: a thread that takes connections, and its end.

use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam_channel::Sender;
use tokio::sync::watch;

use super::accept;
use super::error::ServeError;
use super::hub::{self, Hub};
use super::reporter::{self, Reporter};
use super::settings::Settings;
use crate::station::Command;

/// A server at work; dropping it ends it.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
}

/// How long the end of the server waits for events that are not sent yet, and then for answers under
/// way.
const SHUTDOWN_GRACE: Duration = Duration::from_millis(300);

impl Server {
    /// Serves from now on; `orders` go to the station.
    ///
    /// # Errors
    /// If the address is open to others and there is no token, if it cannot be had, or if the
    /// system gives no thread.
    pub fn start(
        settings: &Settings,
        orders: Sender<Command>,
    ) -> Result<(Self, Reporter), ServeError> {
        if !settings.address.ip().is_loopback() && settings.token.is_none() {
            return Err(ServeError::Open(settings.address));
        }
        let bind = |error| ServeError::Bind { address: settings.address, error };
        let listener = TcpListener::bind(settings.address).map_err(bind)?;
        listener.set_nonblocking(true).map_err(ServeError::System)?;
        let address = listener.local_addr().map_err(ServeError::System)?;
        let (reporter, notices) = reporter::pair();
        let hub = Arc::new(Hub::new(settings, orders, reporter.missed()));
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
        let work = move || {
            runtime.block_on(async move {
                let publishing = tokio::spawn(hub::run(hub.clone(), notices, stopped.clone()));
                accept::serve(listener, hub, &settings, stopped).await;
                // What was entered before the end is still sent, to subscribers who read at once.
                let _ = tokio::time::timeout(SHUTDOWN_GRACE, publishing).await;
            });
            // An edit or a list of the library may wait for the disk, or for another program.
            runtime.shutdown_timeout(SHUTDOWN_GRACE);
        };
        let thread = std::thread::Builder::new()
            .name("serve".into())
            .spawn(work)
            .map_err(ServeError::System)?;
        Ok((Self { address, stop, thread: Some(thread) }, reporter))
    }

    /// Where it serves, with the port that was picked.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Ends all connections; answers under way have a moment.
    pub fn stop(mut self) {
        self.end();
    }

    fn end(&mut self) {
        self.stop.send_replace(true);
        if let Some(thread) = self.thread.take() {
            // Had it panicked, its connections would be closed all the same.
            let _ = thread.join();
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.end();
    }
}
