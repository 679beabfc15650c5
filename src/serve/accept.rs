//! Accepts connections within limits of number, time and size.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::convert::Infallible;
use std::net::IpAddr;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::extract::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio_io_timeout::TimeoutStream;

use super::client::{Peer, neighbourhood};
use super::guard::Traffic;
use super::settings::{Limits, Settings};

/// The largest head of a request, in bytes.
const LARGEST_HEAD: usize = 16 << 10;
/// The most header fields of a request.
const MOST_HEADERS: usize = 64;
/// The pause after a connection could not be accepted, for example for lack of file handles.
const NO_CONNECTION: Duration = Duration::from_millis(100);

/// Serves a router until `stop`.
pub async fn serve(
    listener: TcpListener,
    (router, traffic): (Router, Arc<Traffic>),
    settings: &Settings,
    mut stop: watch::Receiver<bool>,
) {
    let places = Arc::new(Places::new(settings));
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
        let Some(place) = Places::take(&places, peer.ip()) else {
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

/// Places for connections, limited for each address and in total.
struct Places {
    all: usize,
    an_address: usize,
    proxies: Vec<IpAddr>,
    taken: Mutex<HashMap<IpAddr, usize>>,
}

/// A place that is taken, until it is dropped.
struct ConnectionPlace {
    of: Arc<Places>,
    address: IpAddr,
}

impl Places {
    fn new(settings: &Settings) -> Self {
        let Settings { proxies, limits, .. } = settings.clone();
        let Limits { connections: all, connections_an_address: an_address, .. } = limits;
        Self { all, an_address, proxies, taken: Mutex::default() }
    }

    /// Takes a place, if the address may have one. Proxies stand for many clients, so only the
    /// total limit applies to them.
    fn take(places: &Arc<Self>, address: IpAddr) -> Option<ConnectionPlace> {
        let taken = &mut *places.taken();
        let proxy = places.proxies.contains(&address.to_canonical());
        let most = if proxy { places.all } else { places.an_address };
        let address = neighbourhood(address);
        let of_address = taken.get(&address).copied().unwrap_or(0);
        if of_address >= most || taken.values().sum::<usize>() >= places.all {
            return None;
        }
        taken.insert(address, of_address + 1);
        Some(ConnectionPlace { of: places.clone(), address })
    }

    fn taken(&self) -> MutexGuard<'_, HashMap<IpAddr, usize>> {
        // Even after a panic, these are plain counts.
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for ConnectionPlace {
    fn drop(&mut self) {
        if let Entry::Occupied(mut taken) = self.of.taken().entry(self.address) {
            *taken.get_mut() -= 1;
            if *taken.get() == 0 {
                taken.remove();
            }
        }
    }
}

async fn connection(stream: TcpStream, peer: Peer, router: Router, limits: Limits) {
    // Events are small and must go out at once.
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
    // A client that goes away, or sends an invalid request, ends only its own connection.
    let _ = serving.await;
}

async fn answer(router: Router, request: Request) -> Result<axum::response::Response, Infallible> {
    use tower_service::Service;
    let mut router = router;
    router.call(request).await
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_address_takes_all_places_and_a_place_is_free_again() {
        let limits = Limits { connections: 5, connections_an_address: 2, ..Limits::default() };
        let proxies = vec!["10.0.0.9".parse().unwrap()];
        let settings = Settings { limits, proxies, ..Settings::default() };
        let places = Arc::new(Places::new(&settings));
        let take = |address: &str| Places::take(&places, address.parse().unwrap());
        let mut first: Vec<ConnectionPlace> = (0..2).filter_map(|_| take("10.0.0.1")).collect();
        assert!(first.len() == 2 && take("10.0.0.1").is_none());
        let _behind_proxy: Vec<ConnectionPlace> = (0..3).filter_map(|_| take("10.0.0.9")).collect();
        assert!(take("10.0.0.2").is_none(), "all five are taken");
        first.pop();
        assert!(take("10.0.0.2").is_some() && places.taken().len() == 2);
    }
}
