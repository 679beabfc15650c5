//! Who may ask: rate, host, token, origin; and what every answer carries.

use std::collections::HashMap;
use std::net::{IpAddr, SocketAddr};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use axum::extract::{Request, State};
use axum::http::header::{
    AUTHORIZATION, CACHE_CONTROL, CONTENT_SECURITY_POLICY, COOKIE, HOST, HeaderName, HeaderValue,
    LOCATION, ORIGIN, REFERRER_POLICY, RETRY_AFTER, SET_COOKIE, X_CONTENT_TYPE_OPTIONS,
    X_FRAME_OPTIONS,
};
use axum::http::{HeaderMap, Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::accept::{Limits, Peer};
use super::api::Problem;
use super::hub::Hub;
use super::{Settings, Token};

/// The cookie that holds the token.
const TOKEN_COOKIE: &str = "surfaced_token";
/// Addresses whose rate is remembered.
const ADDRESSES: usize = 4096;
/// Refusals a minute that are logged one by one.
const LOGGED: u32 = 10;

/// The page needs its own files and nothing else; nobody may frame it.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; \
                      connect-src 'self'; base-uri 'none'; form-action 'none'; \
                      frame-ancestors 'none'";

const HEADERS: [(HeaderName, &str); 6] = [
    (CONTENT_SECURITY_POLICY, POLICY),
    (X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (X_FRAME_OPTIONS, "DENY"),
    (REFERRER_POLICY, "no-referrer"),
    (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
];

/// What is asked of every request.
#[derive(Debug)]
pub struct Guard {
    hub: Arc<Hub>,
    token: Option<Token>,
    address: SocketAddr,
    limits: Limits,
    rates: Mutex<Rates>,
}

impl Guard {
    /// A guard that remembers nothing yet.
    pub fn new(hub: Arc<Hub>, settings: &Settings) -> Self {
        let Settings { address, token, limits, .. } = settings.clone();
        Self { hub, token, address, limits, rates: Mutex::default() }
    }

    fn check(&self, request: &Request, peer: Peer) -> Result<(), Problem> {
        let rates = &mut *self.rates.lock().unwrap_or_else(PoisonError::into_inner);
        if !rates.admit(peer.0.ip(), &self.limits, Instant::now()) {
            return Err(Problem::TooOften);
        }
        let headers = request.headers();
        let host = text(headers, &HOST).unwrap_or_default();
        // A name that a stranger's DNS points at this machine is no name of ours. With a token,
        // any name may stand for this machine, and the stranger does not know the token.
        if self.token.is_none() && !is_loopback(host) {
            return Err(Problem::Host(host.into()));
        }
        if let Some(token) = &self.token {
            let said = bearer(headers).or_else(|| cookie(headers));
            if !said.is_some_and(|said| token.matches(said)) {
                return Err(Problem::Token);
            }
        }
        if request.method() != Method::GET && request.method() != Method::HEAD {
            check_origin(headers, host)?;
        }
        Ok(())
    }

    /// Whether a refusal is to be logged.
    fn logs(&self) -> bool {
        let rates = &mut *self.rates.lock().unwrap_or_else(PoisonError::into_inner);
        rates.logs(Instant::now())
    }

    /// `/?token=…`, which a person opens once: the cookie, and the page without the token.
    fn enter(&self, request: &Request) -> Option<Response> {
        let token = self.token.as_ref()?;
        if request.uri().path() != "/" {
            return None;
        }
        let said = request.uri().query()?.split('&').find_map(|p| p.strip_prefix("token="))?;
        if !token.matches(said) {
            return None;
        }
        let (name, value) = (TOKEN_COOKIE, token.reveal());
        let cookie = format!("{name}={value}; HttpOnly; SameSite=Strict; Path=/; Max-Age=31536000");
        let headers = [(SET_COOKIE, cookie.as_str()), (LOCATION, "/"), (CACHE_CONTROL, "no-store")];
        Some((StatusCode::SEE_OTHER, headers).into_response())
    }
}

/// Lets a request through to its handler, or refuses it.
pub async fn guard(State(guard): State<Arc<Guard>>, request: Request, next: Next) -> Response {
    let unknown = Peer(SocketAddr::new(guard.address.ip(), 0));
    let peer = request.extensions().get::<Peer>().copied().unwrap_or(unknown);
    let (method, path) = (request.method().clone(), request.uri().path().to_string());
    guard.hub.lock().metrics.requests += 1;
    let mut response = match guard.enter(&request) {
        Some(entered) => entered,
        None => match guard.check(&request, peer) {
            Ok(()) => tokio::time::timeout(guard.limits.request, next.run(request))
                .await
                .unwrap_or_else(|_| Problem::Slow.into_response()),
            Err(problem) => problem.into_response(),
        },
    };
    let status = response.status();
    if status.is_client_error() {
        guard.hub.lock().metrics.refused += 1;
        if guard.logs() {
            // Whatever a stranger put into the path, the log stays one plain line.
            let path: String = path.chars().take(100).collect();
            eprintln!("warning: refused {method} {path:?} from {}: {status}", peer.0.ip());
        }
    }
    let headers = response.headers_mut();
    for (name, value) in HEADERS {
        headers.insert(name, HeaderValue::from_static(value));
    }
    headers.entry(CACHE_CONTROL).or_insert(HeaderValue::from_static("no-store"));
    if status == StatusCode::TOO_MANY_REQUESTS {
        headers.insert(RETRY_AFTER, HeaderValue::from_static("1"));
    }
    response
}

fn text<'a>(headers: &'a HeaderMap, name: &HeaderName) -> Option<&'a str> {
    headers.get(name)?.to_str().ok()
}

fn bearer(headers: &HeaderMap) -> Option<&str> {
    let (scheme, said) = text(headers, &AUTHORIZATION)?.split_once(' ')?;
    scheme.eq_ignore_ascii_case("bearer").then(|| said.trim())
}

fn cookie(headers: &HeaderMap) -> Option<&str> {
    let pairs = text(headers, &COOKIE)?.split(';');
    pairs
        .filter_map(|pair| pair.trim().split_once('='))
        .find(|(n, _)| *n == TOKEN_COOKIE)
        .map(|p| p.1)
}

/// Whether a `Host` names this machine by itself: `localhost`, 127.x.x.x or [::1], any port, since
/// a tunnel may change it.
fn is_loopback(host: &str) -> bool {
    let name = match host.strip_prefix('[') {
        Some(rest) => rest.split(']').next().unwrap_or_default(),
        None => host.split(':').next().unwrap_or_default(),
    };
    name.eq_ignore_ascii_case("localhost")
        || name.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
}

/// Refuses what a page of another site sends. Programs send neither of these headers.
fn check_origin(headers: &HeaderMap, host: &str) -> Result<(), Problem> {
    if let Some(origin) = headers.get(ORIGIN) {
        let origin = origin.to_str().unwrap_or_default();
        let own = origin.strip_prefix("http://").or_else(|| origin.strip_prefix("https://"));
        if own != Some(host) {
            return Err(Problem::Origin(origin.into()));
        }
    }
    let site = headers.get("sec-fetch-site").map(HeaderValue::as_bytes);
    match site {
        None | Some(b"same-origin" | b"none") => Ok(()),
        Some(site) => Err(Problem::Origin(String::from_utf8_lossy(site).into_owned())),
    }
}

/// A bucket of requests for each address, filled at a steady rate.
#[derive(Debug, Default)]
struct Rates {
    buckets: HashMap<IpAddr, (f64, Instant)>,
    logged: Option<(Instant, u32)>,
}

impl Rates {
    fn admit(&mut self, address: IpAddr, limits: &Limits, now: Instant) -> bool {
        let filled = |(left, since): (f64, Instant)| {
            let more =
                now.saturating_duration_since(since).as_secs_f64() * limits.requests_a_second;
            (left + more).min(limits.burst)
        };
        if self.buckets.len() >= ADDRESSES && !self.buckets.contains_key(&address) {
            // A full bucket is as good as none.
            self.buckets.retain(|_, bucket| filled(*bucket) < limits.burst);
            if self.buckets.len() >= ADDRESSES {
                return false;
            }
        }
        let bucket = self.buckets.entry(address).or_insert((limits.burst, now));
        let left = filled(*bucket);
        let admitted = left >= 1.0;
        *bucket = (if admitted { left - 1.0 } else { left }, now);
        admitted
    }

    fn logs(&mut self, now: Instant) -> bool {
        let fresh =
            self.logged.filter(|(since, _)| now.saturating_duration_since(*since).as_secs() < 60);
        let (since, count) = fresh.unwrap_or((now, 0));
        self.logged = Some((since, count.saturating_add(1)));
        count < LOGGED
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn an_address_has_its_burst_and_then_its_rate_and_others_are_not_held_up() {
        let limits = Limits { burst: 3.0, requests_a_second: 1.0, ..Limits::default() };
        let (mut rates, now) = (Rates::default(), Instant::now());
        let [a, b] = ["10.0.0.1", "10.0.0.2"].map(|text| text.parse().unwrap());
        assert_eq!((0..5).filter(|_| rates.admit(a, &limits, now)).count(), 3);
        assert!(rates.admit(b, &limits, now));
        let later = now + Duration::from_millis(1100);
        assert!(rates.admit(a, &limits, later) && !rates.admit(a, &limits, later));
    }

    #[test]
    fn addresses_without_end_take_no_memory_without_end() {
        let limits = Limits::default();
        let (mut rates, now) = (Rates::default(), Instant::now());
        for n in 0..3 * ADDRESSES as u32 {
            rates.admit(IpAddr::V4(n.into()), &limits, now);
        }
        assert_eq!(rates.buckets.len(), ADDRESSES);
        let later = now + Duration::from_secs(60);
        assert!(rates.admit(IpAddr::V4(u32::MAX.into()), &limits, later));
    }

    #[test]
    fn only_names_of_this_machine_pass_without_a_token() {
        for host in ["localhost", "LOCALHOST:1", "127.0.0.1:8080", "127.1.2.3", "[::1]:8080"] {
            assert!(is_loopback(host), "{host}");
        }
        for host in
            ["", "evil.example", "127.0.0.1.evil.example", "localhost.evil", "[::2]", "10.0.0.1"]
        {
            assert!(!is_loopback(host), "{host}");
        }
    }

    #[test]
    fn a_page_of_another_site_cannot_order() {
        let said = |name: &'static str, value: &'static str| {
            let mut headers = HeaderMap::new();
            headers.insert(name, HeaderValue::from_static(value));
            check_origin(&headers, "localhost:8080").is_ok()
        };
        assert!(check_origin(&HeaderMap::new(), "localhost:8080").is_ok(), "programs send none");
        assert!(said("origin", "http://localhost:8080") && said("sec-fetch-site", "same-origin"));
        for origin in ["null", "", "http://localhost:9", "http://evil.example", "localhost:8080"] {
            assert!(!said("origin", origin), "{origin}");
        }
        assert!(!said("sec-fetch-site", "cross-site") && !said("sec-fetch-site", "same-site"));
    }
}
