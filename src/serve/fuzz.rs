//! Sends requests of arbitrary bytes through the guard and all handlers, and checks every answer,
//! for the fuzz target and the property test.

use std::cell::RefCell;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use axum::Router;
use axum::body::Body;
use axum::extract::Request;
use axum::http::header::{CONTENT_SECURITY_POLICY, CONTENT_TYPE};
use axum::http::{Method, StatusCode};
use crossbeam_channel::Receiver;
use tokio::runtime::Runtime;
use tower_service::Service;

use super::hub::Hub;
use super::settings::{LARGEST_BODY, Limits, Settings, Token};
use super::{api, label};
use crate::station::Command;

/// The token of the server that has one.
const SECRET: &str = "0123456789abcdef";

/// A server without a network, and the commands that it sends to the station.
struct OfflineServer {
    router: Router,
    orders: Receiver<Command>,
    runtime: Runtime,
}

impl OfflineServer {
    fn new(token: Option<Token>) -> Self {
        let limits = Limits {
            requests_a_second: f64::MAX,
            burst: f64::MAX,
            guesses_a_second: f64::MAX,
            guess_burst: f64::MAX,
            ..Limits::default()
        };
        let settings = Settings { token, limits, ..Settings::default() };
        let (send, orders) = crossbeam_channel::bounded(1);
        let hub = Arc::new(Hub::new(&settings, send, Arc::new(AtomicU64::new(0))));
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build();
        let runtime = runtime.expect("a thread's own runtime needs nothing of the system");
        Self { router: api::router(hub, &settings), orders, runtime }
    }

    /// Sends a request, and checks the answer. True if this server can take another request.
    fn send(&mut self, request: Request) -> bool {
        let (method, path) = (request.method().clone(), request.uri().path().to_string());
        let Self { router, orders, runtime } = self;
        let (status, headers, body) = runtime.block_on(async {
            let Ok(response) = router.call(request).await;
            let (head, body) = response.into_parts();
            let stream = head.headers.get(CONTENT_TYPE).is_some_and(|t| t == "text/event-stream");
            let whole = axum::body::to_bytes(body, usize::MAX);
            // A stream of events has no end.
            let body = if stream { None } else { whole.await.ok() };
            (head.status, head.headers, body)
        });
        assert!(!status.is_server_error(), "{method} {path}: {status}");
        assert!(headers.contains_key(CONTENT_SECURITY_POLICY), "{method} {path}: no policy");
        let is_json = headers.get(CONTENT_TYPE).is_some_and(|kind| kind == "application/json");
        if let (true, Some(body)) = (is_json && method != Method::HEAD, &body) {
            assert!(serde_json::from_slice::<serde_json::Value>(body).is_ok(), "{path}: no JSON");
        }
        let ordered = orders.try_recv().ok();
        assert_eq!(ordered.is_some(), status == StatusCode::ACCEPTED, "{method} {path}: {status}");
        assert!(ordered.is_none() || method == Method::POST, "{method} {path} ordered something");
        if let Some(Command::Enroll { surface, user, trials }) = ordered {
            for name in [surface, user] {
                assert_eq!(label::check("label", &name).as_ref(), Ok(&name));
                assert!(!name.starts_with('.') && !name.contains(['/', '\\', '\0', '<', '\n']));
            }
            assert!((1..=1000).contains(&trials), "{trials} trials");
        }
        body.is_some()
    }
}

/// A request in the form `METHOD PATH`, lines of `NAME: VALUE`, an empty line and the body. `None`
/// if the HTTP parser (`hyper`) would refuse it.
fn request(bytes: &[u8]) -> Option<Request> {
    let end = bytes.windows(2).position(|two| two == b"\n\n").unwrap_or(bytes.len());
    let (head, body) = bytes.split_at(end);
    let body = body.get(2..).unwrap_or_default();
    let mut lines = head.split(|byte| *byte == b'\n');
    let mut first = lines.next()?.splitn(2, |byte| *byte == b' ');
    let mut request = Request::builder().method(first.next()?).uri(first.next()?);
    for line in lines {
        let colon = line.iter().position(|byte| *byte == b':')?;
        request = request.header(&line[..colon], line[colon + 1..].trim_ascii());
    }
    request.body(Body::from(body[..body.len().min(2 * LARGEST_BODY)].to_vec())).ok()
}

thread_local! {
    static SERVERS: RefCell<[Option<OfflineServer>; 2]> = const { RefCell::new([None, None]) };
}

/// Sends a request to two servers, one of which wants a token.
///
/// # Panics
/// If an answer is wrong: an internal error of the server, a command that was not allowed or whose
/// labels could be read as a path, or invalid JSON.
pub fn send(bytes: &[u8]) {
    SERVERS.with_borrow_mut(|servers| {
        for (server, secret) in servers.iter_mut().zip([None, Some(SECRET)]) {
            let Some(request) = request(bytes) else { return };
            let token = || secret.map(|text| Token::new(text).expect("it is long enough"));
            let known = server.get_or_insert_with(|| OfflineServer::new(token()));
            if !known.send(request) {
                *server = None;
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn the_seeds_of_the_fuzz_target_are_requests() {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fuzz/seeds");
        let mut count = 0;
        for seed in std::fs::read_dir(folder).unwrap() {
            let bytes = std::fs::read(seed.unwrap().path()).unwrap();
            assert!(request(&bytes).is_some(), "{}", String::from_utf8_lossy(&bytes));
            send(&bytes);
            count += 1;
        }
        assert!(count > 0);
    }

    const PATHS: &str = "(/api/v1/(state|scans|scans/[0-9a-z%./-]{0,12}|library|events|start|stop|\
                         reload|enroll|enroll/end)|/metrics|/healthz|/|/page.js|/[!-~]{0,12})\
                         (\\?(limit|before|types|token)=[!-~]{0,20}(&[a-z=%0-9]{0,9})?)?";
    const HEADERS: &str = "((host: (localhost|127.0.0.1:80|[!-~]{0,9})\
                           |origin: (null|http://localhost|[!-~]{0,9})\
                           |cookie: (a=b; )?surfaced_token=(0123456789abcdef|[!-~]{0,9})\
                           |authorization: (bearer|basic) (0123456789abcdef|[!-~]{0,9})\
                           |sec-fetch-site: (same-origin|cross-site)|content-type: [!-~]{0,9})\n){0,5}";
    const BODIES: &str = "\\{\"surface\": \"([a-zé .]{0,9}|[./\\\\<>\\PC]{0,9})\"\
                          (, \"user\": (\"\\PC{0,9}\"|null|7))?(, \"trials\": (-?[0-9]{1,9}))?\\}\
                          |\\PC{0,40}";

    proptest! {
        #[test]
        fn no_bytes_are_a_request_that_breaks_anything(
            bytes in proptest::collection::vec(any::<u8>(), 0..200),
        ) {
            send(&bytes);
        }

        #[test]
        fn no_request_breaks_anything_or_orders_what_it_may_not(
            method in "(GET|HEAD|POST|PUT|DELETE|OPTIONS)",
            path in PATHS,
            headers in HEADERS,
            body in BODIES,
        ) {
            send(format!("{method} {path}\n{headers}\n{body}").as_bytes());
        }
    }
}
