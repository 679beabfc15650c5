//! Accepts connections, and limits their number, duration and size.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio_io_timeout::TimeoutStream;
use tower_service::Service;

use super::guard::{Peer, Traffic, neighbourhood};
use super::settings::{Limits, Settings};

/// The largest header section of a request, in bytes.
const LARGEST_HEAD: usize = 16 << 10;
const MOST_HEADERS: usize = 64;
/// The pause after a connection could not be accepted, for example because file handles ran out.
const NO_CONNECTION: Duration = Duration::from_millis(100);

/// Serves a router until `stop` is ready.
pub async fn serve(
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
        .max_buf_size(LARGEST_HEAD)
        .max_headers(MOST_HEADERS)
        .serve_connection(TokioIo::new(Box::pin(stream)), service);
    // An error ends only the connection of its client, so the error is ignored.
    let _ = serving.await;
}

#[cfg(test)]
mod tests {
    use super::*;

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
