//! Connections: how many, how long, how large.

use std::convert::Infallible;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::extract::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::TcpStream;
use tokio::sync::{Semaphore, watch};
use tokio_io_timeout::TimeoutStream;

use super::hub::Hub;
use super::{Settings, api};

/// What clients may take.
#[derive(Clone, Debug)]
pub struct Limits {
    /// Connections at once; one more is closed unheard.
    pub connections: usize,
    /// Readers of the stream of events at once.
    pub readers: usize,
    /// How long a request may take to arrive, and its answer to be made.
    pub request: Duration,
    /// How long a client may leave unread what was sent to it.
    pub unread: Duration,
    /// Requests a second that one address may make in the long run.
    pub requests_a_second: f64,
    /// How many of them at once.
    pub burst: f64,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            connections: 256,
            readers: 128,
            request: Duration::from_secs(10),
            unread: Duration::from_secs(20),
            requests_a_second: 50.0,
            burst: 200.0,
        }
    }
}

/// The largest body of a request, in bytes.
pub const LARGEST_BODY: usize = 64 << 10;
/// The largest head of a request, in bytes.
const LARGEST_HEAD: usize = 16 << 10;
/// The most header fields of a request.
const MOST_HEADERS: usize = 64;
/// How long to wait where the system gives no connection, as when files have run out.
const NO_CONNECTION: Duration = Duration::from_millis(100);

/// Who asks.
#[derive(Clone, Copy, Debug)]
pub struct Peer(pub SocketAddr);

/// Serves until `stop`.
pub async fn serve(
    listener: TcpListener,
    hub: Arc<Hub>,
    settings: &Settings,
    mut stop: watch::Receiver<bool>,
) {
    let listener = match tokio::net::TcpListener::from_std(listener) {
        Ok(listener) => listener,
        Err(error) => return eprintln!("warning: cannot serve: {error}"),
    };
    let router = api::router(hub.clone(), settings);
    let seats = Arc::new(Semaphore::new(settings.limits.connections));
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            _ = stop.wait_for(|stop| *stop) => return,
        };
        let Ok((stream, peer)) = accepted else {
            tokio::time::sleep(NO_CONNECTION).await;
            continue;
        };
        // Dropping the stream closes it.
        let Ok(seat) = seats.clone().try_acquire_owned() else {
            hub.lock().metrics.refused += 1;
            continue;
        };
        let connection = connection(stream, Peer(peer), router.clone(), settings.limits.clone());
        tokio::spawn(async move {
            connection.await;
            drop(seat);
        });
    }
}

async fn connection(stream: TcpStream, peer: Peer, router: Router, limits: Limits) {
    // Events are small, and wanted at once.
    let _ = stream.set_nodelay(true);
    let mut stream = TimeoutStream::new(stream);
    stream.set_write_timeout(Some(limits.unread));
    let service = service_fn(|mut request: hyper::Request<Incoming>| {
        request.extensions_mut().insert(peer);
        answer(router.clone(), request.map(Body::new))
    });
    let serving = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(limits.request)
        .max_buf_size(LARGEST_HEAD)
        .max_headers(MOST_HEADERS)
        .serve_connection(TokioIo::new(Box::pin(stream)), service);
    // A client that goes away, or sends what is no request, ends its own connection alone.
    let _ = serving.await;
}

async fn answer(router: Router, request: Request) -> Result<axum::response::Response, Infallible> {
    use tower_service::Service;
    let mut router = router;
    router.call(request).await
}
