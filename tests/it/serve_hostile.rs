//! Clients that mean no good, or are broken: refused, bounded, and nobody else notices.

use std::io::Write;
use std::net::TcpStream;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::common;
use crate::common::http::{Events, SOON, Served, answer, serve, session};
use serde_json::Value;
use surfaced::device::{Warning, WarningKind};
use surfaced::serve::{Server, Settings, Token};
use surfaced::station::{LibraryState, StationEvent};

/// Patience that tests can wait for.
fn impatient() -> Served {
    serve(|settings| {
        settings.limits.request = Duration::from_millis(300);
        settings.limits.unread = Duration::from_millis(500);
    })
}

fn warning(text: &str) -> StationEvent {
    StationEvent::Warning(Warning::new(WarningKind::Damaged, text))
}

#[test]
fn what_is_too_large_is_refused() {
    let served = impatient();
    let large = format!(r#"{{"surface": "{}"}}"#, "x".repeat(70_000));
    let reply = served.post("/api/v1/enroll", &large);
    assert_eq!((reply.status, reply.json()["error"].as_str()), (413, Some("too_large")));
    let host = served.address();
    let head = format!("GET / HTTP/1.1\r\nHost: {host}\r\nX: {}\r\n\r\n", "x".repeat(200_000));
    assert!(served.raw(head.as_bytes()).is_none_or(|reply| reply.status == 431));
    let path = format!("GET /{} HTTP/1.1\r\nHost: {host}\r\n\r\n", "x".repeat(200_000));
    assert!(served.raw(path.as_bytes()).is_none_or(|reply| matches!(reply.status, 414 | 431)));
    let many = "X: y\r\n".repeat(500);
    let many = format!("GET / HTTP/1.1\r\nHost: {host}\r\n{many}\r\n");
    assert!(served.raw(many.as_bytes()).is_none_or(|reply| reply.status == 431));
    assert_eq!(served.get("/healthz").status, 200);
}

#[test]
fn what_is_no_request_is_refused_and_orders_nothing() {
    let served = impatient();
    for bytes in [
        &b"\0\0\0\0\r\n\r\n"[..],
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        b"GET\r\n\r\n",
        b"GET / HTTP/9.9\r\n\r\n",
        b"POST /api/v1/start HTTP/1.1\r\nHost: localhost\r\nContent-Length: -1\r\n\r\n",
        b"POST /api/v1/start HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\nx",
        b"POST /api/v1/enroll HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
    ] {
        let refused = served.raw(bytes).is_none_or(|reply| (400..600).contains(&reply.status));
        assert!(refused, "{:?}", String::from_utf8_lossy(bytes));
    }
    for (body, part) in [
        ("", "expected"),
        ("null", "expected"),
        ("[1]", "expected"),
        ("{", "expected"),
        ("\u{0}", "expected"),
        (r#"{"surface": 7}"#, "expected"),
        (r#"{"surface": "a", "x": 1}"#, "`x`"),
        (r#"{"surface": "<img onerror=alert(1)>"}"#, "`surface`"),
        (r#"{"surface": "oak", "user": "a/b"}"#, "`user`"),
        (r#"{"surface": "oak", "trials": 0}"#, "`trials`"),
        (r#"{"surface": "oak", "trials": -1}"#, "-1"),
        (r#"{"surface": "oak", "trials": 1e9}"#, "expected"),
    ] {
        let reply = served.post("/api/v1/enroll", body).json();
        assert_eq!(reply["error"], "bad_request", "{body}");
        assert!(reply["message"].as_str().unwrap().contains(part), "{body}: {reply}");
    }
    assert_eq!(served.request("DELETE", "/api/v1/scans/1", &[], "").status, 405);
    assert_eq!(served.get("/api/v1/scans/one").status, 404);
    assert_eq!(served.get("/api/v1/scans?limit=-1").status, 400);
    for refused in ["state=damp", "from_unix_ms=today", "colour=red"] {
        for path in ["scans", "scans.csv", "scans.jsonl"] {
            assert_eq!(
                served.get(&format!("/api/v1/{path}?{refused}")).status,
                400,
                "{path} {refused}"
            );
        }
    }
    assert_eq!(served.get("/api/v1/scans.csv?limit=5").status, 400);
    assert_eq!(served.get("/api/v1/scans.csv?state=unknown,unsure&text=x").status, 200);
    assert!(served.orders.is_empty());
}

#[test]
fn no_path_leads_to_a_file() {
    let served = impatient();
    for path in [
        "/../../../../etc/passwd",
        "/..%2f..%2f..%2fetc%2fpasswd",
        "/%2e%2e/%2e%2e/etc/passwd",
        "//etc/passwd",
        "/page.js/../../../etc/passwd",
        "/api/v1/scans/..%2f..%2fetc%2fpasswd",
        "/api/v1/../../etc/passwd",
        "/Cargo.toml",
        "/page.js%00",
    ] {
        let reply = served.get(path);
        assert!(matches!(reply.status, 400 | 404), "{path}: {}", reply.status);
        assert!(!reply.body.contains("root:"), "{path}");
    }
    for label in ["../../etc/cron.d/x", "/etc/passwd", "..", "a/b", "a\\\\b", "a\\u0000b"] {
        for field in [r#"{"surface": "LABEL"}"#, r#"{"surface": "oak", "user": "LABEL"}"#] {
            let reply = served.post("/api/v1/enroll", &field.replace("LABEL", label));
            assert_eq!(reply.status, 400, "{label}: {}", reply.body);
        }
    }
    assert!(served.orders.is_empty());
}

#[test]
fn a_script_in_a_label_is_refused_or_stays_text() {
    let mut served = impatient();
    let script = "<script>alert(1)</script>";
    let reply = served.post("/api/v1/enroll", &format!(r#"{{"surface": "{script}"}}"#));
    assert_eq!(reply.status, 400);
    assert!(served.orders.is_empty());
    // A library may hold such a label already: then it is JSON, sent as such.
    let surfaces = vec![(script.to_string(), 1)];
    served.report([
        StationEvent::Library(LibraryState { surfaces, ..LibraryState::default() }),
        StationEvent::Answer(Arc::new(answer(1, Some(script)))),
    ]);
    let state = served.until("/api/v1/state", |state| state["answer"].is_object());
    assert_eq!(state["library"]["surfaces"][0]["surface"], script);
    let reply = served.get("/api/v1/scans/1");
    assert!(reply.head.contains("content-type: application/json"));
    assert!(reply.head.contains("x-content-type-options: nosniff"));
    // Nor does a line break in a device's name break the metrics or the stream.
    served.report([warning("event: answer\ndata: {}\n\n")]);
    served.until("/api/v1/state", |state| state["warnings"] != serde_json::json!([]));
    let mut events = Events::open(&served, "");
    events.next("state");
    served.report([warning("a\n\nevent: answer\ndata: 1")]);
    assert_eq!(events.next("warning")["text"], "a\n\nevent: answer\ndata: 1");
}

#[test]
fn a_slow_request_is_given_up() {
    let served = impatient();
    let host = served.address();
    for opening in [
        "GET / HTTP/1.1\r\nHost: ".to_string(),
        format!("POST /api/v1/enroll HTTP/1.1\r\nHost: {host}\r\nContent-Length: 100\r\n\r\n{{"),
    ] {
        let (mut slow, begin) = (served.connect(), Instant::now());
        slow.write_all(opening.as_bytes()).unwrap();
        // One byte now and then keeps no connection alive.
        while begin.elapsed() < SOON && slow.write_all(b"x").is_ok() {
            std::thread::sleep(Duration::from_millis(50));
        }
        assert!(begin.elapsed() < SOON, "{opening} was still read");
    }
    assert!(served.orders.is_empty());
}

#[test]
fn connections_and_readers_and_requests_are_limited() {
    let served = serve(|settings| {
        settings.limits.connections = 4;
        settings.limits.readers = 1;
    });
    let mut reader = Events::open(&served, "");
    reader.next("state");
    let second = served.get("/api/v1/events");
    assert_eq!((second.status, second.json()["error"].as_str()), (503, Some("too_many_readers")));
    let _idle: Vec<TcpStream> = (0..3).map(|_| served.connect()).collect();
    let begin = Instant::now();
    let one_more = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n";
    while served.raw(one_more).is_some() {
        assert!(begin.elapsed() < SOON, "the fifth connection is closed unheard");
    }

    let served = serve(|settings| {
        settings.limits.burst = 5.0;
        settings.limits.requests_a_second = 0.01;
    });
    let statuses: Vec<u16> = (0..8).map(|_| served.get("/healthz").status).collect();
    assert_eq!(statuses, [200, 200, 200, 200, 200, 429, 429, 429]);
}

#[test]
fn stalled_readers_cost_a_good_one_nothing() {
    let mut served = impatient();
    let stalled: Vec<Events> = (0..5).map(|_| Events::open(&served, "")).collect();
    let mut good = Events::open(&served, "?types=answer,state");
    good.next("state");
    // Enough to fill whatever the sockets hold.
    let text = "x".repeat(100_000);
    for n in 0..400 {
        served.report([warning(&text), StationEvent::Answer(Arc::new(answer(n, None)))]);
        assert_eq!(good.next("answer")["scan"], n);
    }
    let metrics = served.get("/metrics").body;
    let of = |name: &str| -> f64 {
        let line = metrics.lines().find(|line| line.starts_with(name)).unwrap();
        line.rsplit(' ').next().unwrap().parse().unwrap()
    };
    assert_eq!(of("surfaced_notices_missed_total "), 0.0);
    assert!(of("surfaced_events_dropped_total ") > 0.0);
    // After a while they are cut off.
    let begin = Instant::now();
    while !served.get("/metrics").body.contains("surfaced_readers 1\n") {
        assert!(begin.elapsed() < SOON);
        served.report([warning(&text)]);
        std::thread::sleep(Duration::from_millis(50));
    }
    drop(stalled);
}

#[test]
fn another_sites_page_can_neither_order_nor_read() {
    let served = impatient();
    let post = |headers: &[&str]| served.request("POST", "/api/v1/start", headers, "").status;
    let own = format!("Origin: http://{}", served.address());
    assert_eq!(post(&[&own, "Sec-Fetch-Site: same-origin"]), 202);
    let bare = format!("Origin: {}", served.address());
    for headers in [
        &["Origin: http://evil.example"][..],
        &["Origin: null"],
        &["Origin: "],
        &["Origin: http://127.0.0.1:1"],
        &[&bare],
        &["Sec-Fetch-Site: cross-site"],
        &["Sec-Fetch-Site: same-site"],
    ] {
        assert_eq!(post(headers), 403, "{headers:?}");
    }
    assert_eq!(served.orders.len(), 1);
    let status_for =
        |host: &str| served.request("GET", "/api/v1/state", &[&format!("Host: {host}")], "").status;
    // A tunnel may change the port.
    for host in ["localhost", "LOCALHOST:1", "127.0.0.1:8080", "127.1.2.3", "[::1]:8080"] {
        assert_eq!(status_for(host), 200, "{host}");
    }
    // A name that was pointed here by somebody's DNS.
    for host in
        ["", "evil.example", "127.0.0.1.evil.example:80", "localhost.evil", "[::2]", "10.0.0.1"]
    {
        assert_eq!(status_for(host), 421, "{host}");
    }
    let reply = served.get("/api/v1/state");
    assert!(!reply.head.contains("access-control-allow"), "{}", reply.head);
}

#[test]
fn an_address_that_others_reach_needs_a_token() {
    let open = Settings { address: "0.0.0.0:0".parse().unwrap(), ..Settings::default() };
    let (orders, _taken) = crossbeam_channel::bounded(1);
    let error = Server::start(&open, orders.clone()).unwrap_err().to_string();
    assert!(error.contains("SURFACED_TOKEN"), "{error}");
    let closed = Settings { token: Some(Token::new("0123456789abcdef").unwrap()), ..open };
    assert!(Server::start(&closed, orders).is_ok());
}

#[test]
fn an_address_that_is_taken_is_named() {
    let served = impatient();
    let (orders, _taken) = crossbeam_channel::bounded(1);
    let settings = Settings { address: served.address(), ..Settings::default() };
    let error = Server::start(&settings, orders).unwrap_err().to_string();
    assert!(error.contains(&served.address().to_string()) && error.contains("127.0.0.1:0"));
}

#[test]
fn after_all_of_it_the_server_ends_at_once() {
    let mut served = impatient();
    served.report(session());
    let _readers: Vec<Events> = (0..10).map(|_| Events::open(&served, "")).collect();
    let _idle: Vec<TcpStream> = (0..10).map(|_| served.connect()).collect();
    let state: Value = served.until("/api/v1/state", |state| state["guess"].is_object());
    assert_eq!(state["scan"], 3);
    let begin = Instant::now();
    drop(served.server);
    assert!(begin.elapsed() < SOON);
}

/// A server with a token, which takes few requests, and believes a proxy on this machine.
fn guarded() -> Served {
    serve(|settings| {
        settings.token = Some(Token::new("0123456789abcdef").unwrap());
        settings.proxies = vec!["127.0.0.1".parse().unwrap()];
        settings.limits.burst = 20.0;
        settings.limits.requests_a_second = 0.01;
        settings.limits.guess_burst = 5.0;
        settings.limits.guesses_a_second = 0.01;
    })
}

#[test]
fn guesses_of_the_token_are_limited_on_every_way_in_and_none_is_right_after_that() {
    for guess in [
        "Authorization: Bearer 0123456789abcdeX",
        "Cookie: surfaced_token=0123456789abcdeX",
        "", // in the address
    ] {
        let served = guarded();
        let path = if guess.is_empty() { "/?token=0123456789abcdeX" } else { "/metrics" };
        let headers: Vec<&str> = Some(guess).filter(|line| !line.is_empty()).into_iter().collect();
        let statuses: Vec<u16> =
            (0..8).map(|_| served.request("GET", path, &headers, "").status).collect();
        assert_eq!(statuses, [401, 401, 401, 401, 401, 429, 429, 429], "{guess}");
        let right = ["Authorization: Bearer 0123456789abcdef"];
        let reply = served.request("GET", "/metrics", &right, "");
        assert_eq!(reply.status, 429, "a token is not compared where guesses are used up");
    }
}

#[test]
fn strangers_lock_out_neither_those_who_know_the_token_nor_another_address() {
    let served = guarded();
    let entered = served.get("/?token=0123456789abcdef");
    assert_eq!(entered.status, 303);
    let session = entered.head.split("surfaced_session=").nth(1).unwrap();
    let session = session.split(';').next().unwrap();
    let browser = format!("Cookie: surfaced_token=0123456789abcdef; surfaced_session={session}");
    let program = "Authorization: Bearer 0123456789abcdef";
    for _ in 0..60 {
        served.get("/metrics");
    }
    assert_eq!(served.get("/metrics").status, 429);
    assert_eq!(served.request("GET", "/metrics", &[program], "").status, 200);
    for _ in 0..10 {
        served.request("GET", "/metrics", &["Cookie: surfaced_token=wrong"], "");
    }
    assert_eq!(served.request("GET", "/metrics", &[&browser], "").status, 200);
    let elsewhere = [program, "X-Forwarded-For: 127.9.9.9, 192.0.2.7"];
    assert_eq!(served.request("GET", "/metrics", &elsewhere, "").status, 200);
}

#[test]
fn only_the_public_address_may_differ_from_the_host_that_a_proxy_asks_for() {
    let served = serve(|settings| {
        settings.public_address = Some("https://plant.example/press-3".parse().unwrap());
    });
    let post = |origin: &str| {
        served.request("POST", "/api/v1/start", &[&format!("Origin: {origin}")], "").status
    };
    assert_eq!(post("https://plant.example"), 202);
    for origin in ["http://plant.example", "https://plant.example:8443", "https://plant", "https:/"]
    {
        assert_eq!(post(origin), 403, "{origin}");
    }
}

#[test]
fn the_cookie_is_secure_behind_a_proxy_with_tls() {
    let served = guarded();
    let tls = ["X-Forwarded-For: 192.0.2.7", "X-Forwarded-Proto: https"];
    let secure = |reply: common::http::Reply| reply.head.contains("; secure");
    assert!(secure(served.request("GET", "/?token=0123456789abcdef", &tls, "")));
    assert!(!secure(served.get("/?token=0123456789abcdef")));
    let direct = serve(|settings| {
        settings.token = Some(Token::new("0123456789abcdef").unwrap());
    });
    assert!(!secure(direct.request("GET", "/?token=0123456789abcdef", &tls, "")));
}
