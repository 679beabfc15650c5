//! Sends requests of arbitrary bytes to two servers, one of which wants a token, and checks every
//! answer: for the fuzz target and the property tests.

use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use crossbeam_channel::Receiver;
use surfaced::serve::{Server, Settings, Token};
use surfaced::station::Command;

/// The token of the server that has one.
const SECRET: &str = "0123456789abcdef";
/// Twice the largest body that a server takes.
const MOST: usize = 128 << 10;
/// The first line of HTTP/2. The HTTP library closes a connection without an answer if the head of a
/// request is refused and the rest begins like this.
const HTTP2: &[u8] = b"PRI * HTTP/2.0\r\n";
/// Headers that say where a request ends, which is the HTTP library's work.
const FRAMING: [&str; 5] =
    ["connection", "content-length", "expect", "transfer-encoding", "upgrade"];

thread_local! {
    static SERVERS: [(Server, Receiver<Command>); 2] = [None, Some(SECRET)].map(serve);
}

fn serve(secret: Option<&str>) -> (Server, Receiver<Command>) {
    let mut settings = Settings { address: ([127, 0, 0, 1], 0).into(), ..Settings::default() };
    settings.token = secret.map(|text| Token::new(text).expect("it is long enough"));
    let limits = &mut settings.limits;
    (limits.requests_a_second, limits.burst) = (f64::MAX, f64::MAX);
    (limits.guesses_a_second, limits.guess_burst) = (f64::MAX, f64::MAX);
    (limits.readers, limits.connections_an_address) = (usize::MAX, limits.connections);
    let (send, orders) = crossbeam_channel::bounded(1);
    let (server, _) = Server::start(&settings, send).expect("a port is free");
    (server, orders)
}

/// A request in the form `METHOD PATH`, lines of `NAME: VALUE`, an empty line and the body: its
/// method, and its bytes on the line. `None` if it does not have that form, or its body begins like
/// HTTP/2.
pub fn request(bytes: &[u8]) -> Option<(String, Vec<u8>)> {
    let end = bytes.windows(2).position(|two| two == b"\n\n").unwrap_or(bytes.len());
    let (head, body) = bytes.split_at(end);
    let body = body.get(2..).unwrap_or_default();
    let body = &body[..body.len().min(MOST)];
    if body.starts_with(HTTP2) {
        return None;
    }
    let mut lines = head.split(|byte| *byte == b'\n');
    let first = lines.next()?;
    let method = first.split(|byte| *byte == b' ').next()?;
    let mut request = [first, b" HTTP/1.1\r\n"].concat();
    for line in lines {
        let name = &line[..line.iter().position(|byte| *byte == b':')?];
        if !FRAMING.iter().any(|framing| name.eq_ignore_ascii_case(framing.as_bytes())) {
            request.extend([line.trim_ascii(), b"\r\n"].concat());
        }
    }
    write!(request, "Content-Length: {}\r\nConnection: close\r\n\r\n", body.len()).ok()?;
    request.extend(body);
    Some((String::from_utf8_lossy(method).into(), request))
}

/// Sends a request to both servers.
///
/// # Panics
/// If an answer is wrong: none or an internal error of the server, a command that was not allowed or
/// whose labels could be read as a path, or invalid JSON.
pub fn send(bytes: &[u8]) {
    let Some((method, request)) = request(bytes) else { return };
    SERVERS.with(|servers| servers.iter().for_each(|server| check(server, &method, &request)));
}

fn check((server, orders): &(Server, Receiver<Command>), method: &str, request: &[u8]) {
    let said = String::from_utf8_lossy(request);
    let mut stream = TcpStream::connect(server.address()).expect("the server listens");
    stream.set_read_timeout(Some(Duration::from_secs(9))).expect("it is not 0");
    // A server that refuses may close before all is written.
    let _ = stream.write_all(request);
    let mut answer = Vec::new();
    let end = loop {
        if let Some(end) = answer.windows(4).position(|four| four == b"\r\n\r\n") {
            break end;
        }
        let mut part = [0; 4096];
        let read = match stream.read(&mut part) {
            // By the alarm with which the fuzzer measures the time of an input.
            Err(error) if error.kind() == ErrorKind::Interrupted => continue,
            read => read.unwrap_or(0),
        };
        assert!(read > 0, "no answer to {said}");
        answer.extend(&part[..read]);
    };
    let head = String::from_utf8_lossy(&answer[..end]).to_lowercase();
    // A stream of events has no end.
    if !head.contains("content-type: text/event-stream") {
        let _ = stream.read_to_end(&mut answer);
    }
    let body = &answer[end + 4..];
    let status: u16 = head.split(' ').nth(1).and_then(|status| status.parse().ok()).unwrap_or(0);
    assert!((200..500).contains(&status), "{said}: {head}");
    // A request that the HTTP library refuses reaches no handler.
    let is_handled = head.contains("content-security-policy: default-src 'none'");
    assert!(is_handled || body.is_empty() && matches!(status, 400 | 414 | 431), "{said}: {head}");
    if head.contains("content-type: application/json") && method != "HEAD" {
        assert!(serde_json::from_slice::<serde_json::Value>(body).is_ok(), "{said}: no JSON");
    }
    let ordered = orders.try_recv().ok();
    assert_eq!(ordered.is_some(), status == 202, "{said}: {head}");
    assert!(ordered.is_none() || method == "POST", "{said} ordered something");
    if let Some(Command::Enroll { surface, user, trials, .. }) = ordered {
        for name in [surface, user] {
            assert!(name == name.trim() && (1..=80).contains(&name.chars().count()), "{name:?}");
            assert!(!name.starts_with('.') && !name.contains(['/', '\\', '\0', '<', '\n']));
        }
        assert!((1..=1000).contains(&trials), "{trials} trials");
    }
}
