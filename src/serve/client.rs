//! The sender of a request: the address of the connection, or the one that a trusted proxy names.

use std::net::{IpAddr, Ipv6Addr, SocketAddr};

use axum::extract::Request;
use axum::http::HeaderMap;

/// The other end of a connection.
#[derive(Clone, Copy, Debug)]
pub struct Peer(pub SocketAddr);

/// The sender of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Client {
    pub address: IpAddr,
    /// Whether the client speaks TLS with a trusted proxy.
    pub tls: bool,
}

impl Client {
    /// The client of a request. `X-Forwarded-For` and `X-Forwarded-Proto` count only if the
    /// connection comes from one of `proxies`. Of several addresses, the last that is no proxy's is
    /// the client's: the client may have made up those before it.
    pub fn of(request: &Request, proxies: &[IpAddr], unknown: IpAddr) -> Self {
        let peer = request.extensions().get::<Peer>().map_or(unknown, |peer| peer.0.ip());
        let peer = peer.to_canonical();
        if !proxies.contains(&peer) {
            return Self { address: peer, tls: false };
        }
        let headers = request.headers();
        let forwarded: Vec<IpAddr> = words(headers, "x-forwarded-for")
            .filter_map(|word| word.parse::<IpAddr>().ok())
            .map(|address| address.to_canonical())
            .collect();
        let address = forwarded.into_iter().rfind(|address| !proxies.contains(address));
        let tls = words(headers, "x-forwarded-proto").last().is_some_and(|word| word == "https");
        Self { address: address.unwrap_or(peer), tls }
    }
}

/// The comma-separated parts of all header lines called `name`.
fn words<'a>(headers: &'a HeaderMap, name: &str) -> impl Iterator<Item = &'a str> {
    let lines = headers.get_all(name).into_iter().filter_map(|value| value.to_str().ok());
    lines.flat_map(|line| line.split(',')).map(str::trim)
}

/// The address under which a client is counted: of IPv6, the network of 64 bits, all of which
/// belongs to one subscriber line.
pub fn neighbourhood(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => {
            IpAddr::V6(Ipv6Addr::from_bits(address.to_bits() & !u128::from(u64::MAX)))
        }
        address => address,
    }
}

#[cfg(test)]
mod tests {
    use axum::body::Body;

    use super::*;

    fn client(peer: &str, headers: &[(&str, &str)]) -> Client {
        let mut request = Request::builder();
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        let mut request = request.body(Body::empty()).unwrap();
        let peer = SocketAddr::new(peer.parse().unwrap(), 1);
        request.extensions_mut().insert(Peer(peer));
        Client::of(&request, &["10.0.0.9".parse().unwrap()], peer.ip())
    }

    #[test]
    fn only_a_configured_proxy_says_who_the_client_is() {
        let forwarded = [("x-forwarded-for", "1.1.1.1, 2.2.2.2"), ("x-forwarded-proto", "https")];
        let own = client("10.0.0.1", &forwarded);
        assert_eq!((own.address.to_string(), own.tls), ("10.0.0.1".into(), false));
        let behind = client("10.0.0.9", &forwarded);
        assert_eq!((behind.address.to_string(), behind.tls), ("2.2.2.2".into(), true));
        let chain = client("::ffff:10.0.0.9", &[("x-forwarded-for", "2.2.2.2, 10.0.0.9")]);
        assert_eq!((chain.address.to_string(), chain.tls), ("2.2.2.2".into(), false));
        assert_eq!(client("10.0.0.9", &[]).address.to_string(), "10.0.0.9");
    }

    #[test]
    fn neighbours_of_ipv6_count_as_one() {
        let of = |text: &str| neighbourhood(text.parse().unwrap()).to_string();
        assert_eq!(of("2001:db8::1:2:3:4"), "2001:db8::");
        assert_eq!(of("::ffff:1.2.3.4"), "1.2.3.4");
    }
}
