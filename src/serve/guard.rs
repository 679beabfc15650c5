//! Accepts or refuses requests, by rate, token, host and origin, and adds headers to all answers.

use std::collections::{HashMap, VecDeque};
use std::hash::Hash;
use std::net::{IpAddr, Ipv6Addr, SocketAddr};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use axum::extract::{Request, State};
use axum::http::header::{
    ACCEPT, AUTHORIZATION, CACHE_CONTROL, CONTENT_SECURITY_POLICY, COOKIE, HOST, HeaderName,
    HeaderValue, LOCATION, ORIGIN, REFERRER_POLICY, RETRY_AFTER, SET_COOKIE,
    X_CONTENT_TYPE_OPTIONS, X_FRAME_OPTIONS,
};
use axum::http::{HeaderMap, Method, StatusCode, Uri};
use axum::middleware::Next;
use axum::response::{AppendHeaders, Html, IntoResponse, Response};
use rand::TryRng;
use rand::rngs::SysRng;

use super::request::{Problem, Reply};
use super::roles::{may_operator, person};
use super::settings::{Limits, Settings};
use crate::history::{Actor, Role};
use crate::outputs::lock;

const TOKEN_COOKIE: &str = "surfaced_token";
/// The cookie by which a browser that knew the token is recognised later.
const SESSION_COOKIE: &str = "surfaced_session";
const MOST_SESSIONS: usize = 1024;
const LOGGED_A_MINUTE: u32 = 10;

/// Paths that need no token, since they reveal nothing and the token form needs them.
const OPEN: [&str; 4] = ["/healthz", "/readyz", "/style.css", "/favicon.svg"];

/// The page with the token form; the text of a problem takes the place of `PROBLEM_PLACE` there.
const TOKEN_FORM: &str = include_str!("page/token.html");
const PROBLEM_PLACE: &str = "<!-- problem -->";

/// The browser may load only files of this server, and no other page may embed this one.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; \
                      media-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'self'; \
                      frame-ancestors 'none'";

const HEADERS: [(HeaderName, &str); 6] = [
    (CONTENT_SECURITY_POLICY, POLICY),
    (X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (X_FRAME_OPTIONS, "DENY"),
    (REFERRER_POLICY, "no-referrer"),
    (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
];

#[derive(Debug, Default)]
pub(crate) struct Traffic {
    /// Number of requests, both answered and refused.
    pub requests: AtomicU64,
    /// Number of requests and connections that were refused.
    pub refused: AtomicU64,
}

pub(super) struct Guard {
    traffic: Arc<Traffic>,
    settings: Settings,
    budgets: Mutex<Budgets>,
}

/// How a request that is not refused is handled.
enum Admission {
    Answered(Response),
    Passes(Actor),
}

/// The budgets of clients: how many requests and how many wrong tokens each may still send.
#[derive(Debug)]
struct Budgets {
    /// Requests of clients that need no token or gave none, by address.
    strangers: Rates<IpAddr>,
    /// Requests of clients that gave the token, by address. Strangers cannot use up this budget.
    known: Rates<IpAddr>,
    /// Wrong tokens by address; browsers with a session use `session_guesses` instead.
    guesses: Rates<IpAddr>,
    session_guesses: Rates<u128>,
    /// Sessions of browsers that gave the token, the newest last.
    sessions: VecDeque<u128>,
    logged: Option<(Instant, u32)>,
}

impl Budgets {
    fn new(limits: &Limits) -> Self {
        let requests = || Rates::new(limits.requests_a_second, limits.burst);
        Self {
            strangers: requests(),
            known: requests(),
            guesses: Rates::new(limits.guesses_a_second, limits.guess_burst),
            session_guesses: Rates::new(limits.guesses_a_second, limits.guess_burst),
            sessions: VecDeque::new(),
            logged: None,
        }
    }

    /// Compares the token that a client gave, and returns the client's role. Each attempt takes one
    /// guess from the client's budget; a correct token gives the guess back.
    fn try_token(
        &mut self,
        (settings, given): (&Settings, &str),
        (address, session): (IpAddr, Option<u128>),
    ) -> Reply<Role> {
        let now = Instant::now();
        let session = session.filter(|session| self.sessions.contains(session));
        let admitted = match session {
            Some(session) => self.session_guesses.admit(session, now),
            None => self.guesses.admit(address, now),
        };
        if !admitted {
            return Err(Problem::TooOften);
        }
        let role = settings.role_of(given).ok_or(Problem::Token)?;
        match session {
            Some(session) => self.session_guesses.give_back(session),
            None => self.guesses.give_back(address),
        }
        self.known.admit(address, now).then_some(role).ok_or(Problem::TooOften)
    }

    /// Starts a session, and drops the oldest of too many; `None` if there are no random numbers.
    fn begin_session(&mut self) -> Option<u128> {
        let half = || SysRng.try_next_u64().ok().map(u128::from);
        let session = half()? << 64 | half()?;
        self.sessions.push_back(session);
        if self.sessions.len() > MOST_SESSIONS {
            self.sessions.pop_front();
        }
        Some(session)
    }

    fn logs(&mut self, now: Instant) -> bool {
        let fresh =
            self.logged.filter(|(since, _)| now.saturating_duration_since(*since).as_secs() < 60);
        let (since, count) = fresh.unwrap_or((now, 0));
        self.logged = Some((since, count.saturating_add(1)));
        count < LOGGED_A_MINUTE
    }
}

impl Guard {
    pub(super) fn new(traffic: Arc<Traffic>, settings: &Settings) -> Self {
        let budgets = Mutex::new(Budgets::new(&settings.limits));
        Self { traffic, settings: settings.clone(), budgets }
    }

    /// Lets a request pass, or answers it. A person opens `/?token=…` once; the answer sets the
    /// cookies and redirects to the page's address without the token.
    fn check(&self, request: &Request, client: Client) -> Reply<Admission> {
        let (headers, address) = (request.headers(), neighbourhood(client.address));
        let host = text(headers, &HOST).unwrap_or_default();
        let in_address = in_address(request);
        let given = bearer(headers).or_else(|| cookie(headers, TOKEN_COOKIE)).or(in_address);
        let is_open = OPEN.contains(&request.uri().path());
        let role = match (&self.settings.token, given) {
            (Some(_), Some(given)) => {
                let given = in_address.unwrap_or(given);
                let session = cookie(headers, SESSION_COOKIE);
                let session = session.and_then(|text| u128::from_str_radix(text, 16).ok());
                let (token, from) = ((&self.settings, given), (address, session));
                let role = match lock(&self.budgets).try_token(token, from) {
                    Err(Problem::Token) if is_open => Role::Operator,
                    tried => tried?,
                };
                if in_address.is_some() {
                    return Ok(Admission::Answered(self.enter(given, client)));
                }
                role
            }
            (token, _) => {
                if !lock(&self.budgets).strangers.admit(address, Instant::now()) {
                    return Err(Problem::TooOften);
                }
                // Without a token, the host must be a name of this machine, since a stranger's DNS may
                // point any other name here. With a token, any host is allowed, since a stranger does
                // not know the token.
                match token {
                    Some(_) if is_open => Role::Operator,
                    Some(_) => return Err(Problem::Token),
                    None if is_loopback(host) => Role::Administrator,
                    None => return Err(Problem::Host(host.into())),
                }
            }
        };
        let (method, path) = (request.method(), request.uri().path());
        if method != Method::GET && method != Method::HEAD {
            check_origin(headers, host, self.settings.public_address.as_ref())?;
        }
        if role == Role::Operator && !is_open && !may_operator(method, path) {
            return Err(Problem::Role);
        }
        Ok(Admission::Passes(Actor { role, person: person(headers)? }))
    }

    /// The answer to a client that gave a token, which is one of the two.
    fn enter(&self, token: &str, client: Client) -> Response {
        let secure = if client.tls { "; Secure" } else { "" };
        let session = lock(&self.budgets).begin_session().map(|session| format!("{session:032x}"));
        let cookie = |name: &str, value: &str| {
            // Without a path, the cookie is for the folder of the page, also behind a proxy.
            let life = "HttpOnly; SameSite=Strict; Max-Age=31536000";
            (SET_COOKIE, format!("{name}={value}; {life}{secure}"))
        };
        let cookies = std::iter::once(cookie(TOKEN_COOKIE, token))
            .chain(session.map(|session| cookie(SESSION_COOKIE, &session)));
        let cookies: Vec<_> = cookies.collect();
        let headers = [(LOCATION, "./"), (CACHE_CONTROL, "no-store")];
        (StatusCode::SEE_OTHER, headers, AppendHeaders(cookies)).into_response()
    }
}

/// Passes a request to its handler, or refuses it.
pub(super) async fn guard(
    State(guard): State<Arc<Guard>>,
    mut request: Request,
    next: Next,
) -> Response {
    let settings = &guard.settings;
    let client = Client::of(&request, &settings.proxies, settings.address.ip());
    let (method, path) = (request.method().clone(), request.uri().path().to_string());
    let in_browser = text(request.headers(), &ACCEPT).is_some_and(|all| all.contains("text/html"));
    let has_form = settings.token.is_some() && in_browser && method == Method::GET && path == "/";
    let is_tried = in_address(&request).is_some();
    guard.traffic.requests.fetch_add(1, Ordering::Relaxed);
    let mut response = match guard.check(&request, client) {
        Ok(Admission::Answered(answer)) => answer,
        Ok(Admission::Passes(actor)) => {
            request.extensions_mut().insert(actor);
            tokio::time::timeout(settings.limits.request, next.run(request))
                .await
                .unwrap_or_else(|_| Problem::Slow.into_response())
        }
        Err(problem) if has_form => {
            let text = match &problem {
                Problem::Token if is_tried => "This token is not right.".to_string(),
                Problem::Token => String::new(),
                other => other.to_string(),
            };
            let mut form = Html(TOKEN_FORM.replace(PROBLEM_PLACE, &text)).into_response();
            *form.status_mut() = problem.into_response().status();
            form
        }
        Err(problem) => problem.into_response(),
    };
    let status = response.status();
    if status.is_client_error() {
        guard.traffic.refused.fetch_add(1, Ordering::Relaxed);
        if lock(&guard.budgets).logs(Instant::now()) {
            // A stranger may have chosen the path, so it is shortened and escaped for the log.
            let path: String = path.chars().take(100).collect();
            tracing::warn!("refused {method} {path:?} from {}: {status}", client.address);
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
    let (scheme, token) = text(headers, &AUTHORIZATION)?.split_once(' ')?;
    scheme.eq_ignore_ascii_case("bearer").then(|| token.trim())
}

/// The token in the query string of the page's address.
fn in_address(request: &Request) -> Option<&str> {
    let query = request.uri().query().filter(|_| request.uri().path() == "/")?;
    query.split('&').find_map(|part| part.strip_prefix("token="))
}

fn cookie<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    let pairs = text(headers, &COOKIE)?.split(';');
    pairs.filter_map(|pair| pair.trim().split_once('=')).find(|(n, _)| *n == name).map(|p| p.1)
}

/// Whether a `Host` header names this machine, at any port, since a tunnel may change the port.
fn is_loopback(host: &str) -> bool {
    let name = match host.strip_prefix('[') {
        Some(rest) => rest.split(']').next().unwrap_or_default(),
        None => host.split(':').next().unwrap_or_default(),
    };
    name.eq_ignore_ascii_case("localhost")
        || name.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
}

/// Refuses requests from pages of other sites; browsers send `Origin` or `Sec-Fetch-Site` for them.
/// A proxy may replace the host; its own name is that of the public address.
fn check_origin(headers: &HeaderMap, host: &str, public: Option<&Uri>) -> Reply<()> {
    if let Some(origin) = headers.get(ORIGIN) {
        let origin = origin.to_str().unwrap_or_default();
        let own = origin.strip_prefix("http://").or_else(|| origin.strip_prefix("https://"));
        let public = public
            .and_then(|public| Some(format!("{}://{}", public.scheme_str()?, public.authority()?)));
        if own != Some(host) && public.as_deref() != Some(origin) {
            return Err(Problem::Origin(origin.into()));
        }
    }
    let site = headers.get("sec-fetch-site").map(HeaderValue::as_bytes);
    match site {
        None | Some(b"same-origin" | b"none") => Ok(()),
        Some(site) => Err(Problem::Origin(String::from_utf8_lossy(site).into_owned())),
    }
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Peer(pub SocketAddr);

/// The client of a request, at the other end of the connection or behind a trusted proxy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Client {
    pub address: IpAddr,
    /// Whether the client uses TLS to reach a trusted proxy.
    pub tls: bool,
}

impl Client {
    /// The client of a request. `X-Forwarded-For` and `X-Forwarded-Proto` are used only if the
    /// connection comes from one of `proxies`. The client is the last address that is not a
    /// proxy's, since a client may invent the earlier addresses.
    pub(super) fn of(request: &Request, proxies: &[IpAddr], unknown: IpAddr) -> Self {
        let peer = request.extensions().get::<Peer>().map_or(unknown, |peer| peer.0.ip());
        let peer = peer.to_canonical();
        if !proxies.contains(&peer) {
            return Self { address: peer, tls: false };
        }
        let headers = request.headers();
        let forwarded: Vec<Option<IpAddr>> =
            words(headers, "x-forwarded-for").map(forwarded_address).collect();
        let is_proxy = |address: &Option<IpAddr>| address.is_some_and(|a| proxies.contains(&a));
        // One that cannot be read is not passed over: a client may have invented those before it.
        let address = forwarded.into_iter().rfind(|address| !is_proxy(address)).flatten();
        let tls = words(headers, "x-forwarded-proto").last().is_some_and(|word| word == "https");
        Self { address: address.unwrap_or(peer), tls }
    }
}

/// The address in an entry of `X-Forwarded-For`, to which some proxies add a port.
fn forwarded_address(word: &str) -> Option<IpAddr> {
    let with_port = word.parse::<SocketAddr>().map(|address| address.ip());
    let address = with_port.or_else(|_| word.trim_matches(['[', ']']).parse());
    address.ok().map(|address: IpAddr| address.to_canonical())
}

/// The comma-separated parts of all header lines with this name.
fn words<'a>(headers: &'a HeaderMap, name: &str) -> impl Iterator<Item = &'a str> {
    let lines = headers.get_all(name).into_iter().filter_map(|value| value.to_str().ok());
    lines.flat_map(|line| line.split(',')).map(str::trim)
}

/// The address by which a client is counted: its 64-bit network, which one client owns, for IPv6.
pub(super) fn neighbourhood(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => {
            IpAddr::V6(Ipv6Addr::from_bits(address.to_bits() & !u128::from(u64::MAX)))
        }
        address => address,
    }
}

const MOST_CLIENTS: usize = 4096;

/// A token bucket for each client: a store of permits, which limits the client's rate.
#[derive(Debug)]
pub(super) struct Rates<K> {
    a_second: f64,
    burst: f64,
    /// The permits in each client's bucket, and the time of that count.
    buckets: HashMap<K, (f64, Instant)>,
}

impl<K: Copy + Eq + Hash> Rates<K> {
    /// Each bucket starts full with `burst` permits, and gains `a_second` permits a second.
    pub(super) fn new(a_second: f64, burst: f64) -> Self {
        Self { a_second, burst, buckets: HashMap::new() }
    }

    /// Takes a permit from a client's bucket; false if the bucket is empty.
    pub(super) fn admit(&mut self, client: K, now: Instant) -> bool {
        let (a_second, burst) = (self.a_second, self.burst);
        let filled = |(left, since): (f64, Instant)| {
            let more = now.saturating_duration_since(since).as_secs_f64() * a_second;
            (left + more).min(burst)
        };
        if self.buckets.len() >= MOST_CLIENTS && !self.buckets.contains_key(&client) {
            // A full bucket is like a new bucket, so it need not be kept.
            self.buckets.retain(|_, bucket| filled(*bucket) < burst);
            if self.buckets.len() >= MOST_CLIENTS {
                return false;
            }
        }
        let bucket = self.buckets.entry(client).or_insert((burst, now));
        let left = filled(*bucket);
        let admitted = left >= 1.0;
        *bucket = (if admitted { left - 1.0 } else { left }, now);
        admitted
    }

    pub(super) fn give_back(&mut self, client: K) {
        if let Some((left, _)) = self.buckets.get_mut(&client) {
            *left = (*left + 1.0).min(self.burst);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use axum::body::Body;

    use super::*;

    #[test]
    fn a_client_has_its_burst_and_then_its_rate_and_others_are_not_held_up() {
        let (mut rates, now) = (Rates::new(1.0, 3.0), Instant::now());
        assert_eq!((0..5).filter(|_| rates.admit('a', now)).count(), 3);
        assert!(rates.admit('b', now));
        let later = now + Duration::from_millis(1100);
        assert!(rates.admit('a', later) && !rates.admit('a', later));
        rates.give_back('a');
        assert!(rates.admit('a', later));
    }

    #[test]
    fn clients_without_end_take_no_memory_without_end() {
        let (mut rates, now) = (Rates::new(50.0, 200.0), Instant::now());
        for n in 0..3 * MOST_CLIENTS {
            rates.admit(n, now);
        }
        assert_eq!(rates.buckets.len(), MOST_CLIENTS);
        assert!(rates.admit(usize::MAX, now + Duration::from_secs(60)));
    }

    fn client(peer: &str, headers: &[(&str, &str)]) -> Client {
        let request = headers
            .iter()
            .fold(Request::builder(), |request, (name, value)| request.header(*name, *value));
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
        for (entries, of) in [
            ("1.1.1.1, 2.2.2.2:4711", "2.2.2.2"),
            ("1.1.1.1, [2001:db8::5]:80, 10.0.0.9", "2001:db8::5"),
            ("1.1.1.1, unknown", "10.0.0.9"),
        ] {
            let behind = client("10.0.0.9", &[("x-forwarded-for", entries)]);
            assert_eq!(behind.address.to_string(), of, "{entries}");
        }
        assert_eq!(client("10.0.0.9", &[]).address.to_string(), "10.0.0.9");
    }

    #[test]
    fn neighbours_of_ipv6_count_as_one() {
        let of = |text: &str| neighbourhood(text.parse().unwrap()).to_string();
        assert_eq!(of("2001:db8::1:2:3:4"), "2001:db8::");
        assert_eq!(of("::ffff:1.2.3.4"), "1.2.3.4");
    }
}
