//! A server with a station that only seems to be there, and clients that may misbehave.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam_channel::Receiver;
use serde_json::Value;
use surfaced::device::{Device, DeviceError, DeviceLink, DeviceState, StreamKind, StreamSpec};
use surfaced::recognise::RankedSurface;
use surfaced::ring::Sink;
use surfaced::scan::{Event, Options, Session};
use surfaced::scene::Phase;
use surfaced::serve::{Reporter, Server, Settings};
use surfaced::station::{
    Answer, AnswerState, Command, Guess, LibraryState, Listener, StationEvent, SurfaceProbability,
};
use surfaced::trial::Doubt;

use super::id;

/// How long a test waits for what comes at once, unless the machine is very busy.
pub const SOON: Duration = Duration::from_secs(120);

/// Asks a server, wherever it runs.
#[derive(Clone, Copy)]
pub struct Client(pub SocketAddr);

/// A server on a free port, what reports to it, and what it orders.
pub struct Served {
    pub server: Server,
    client: Client,
    pub reporter: Reporter,
    pub orders: Receiver<Command>,
}

/// An answer of a server.
#[derive(Debug)]
pub struct Reply {
    pub status: u16,
    pub head: String,
    pub body: String,
}

impl Reply {
    /// The body as JSON.
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.body).unwrap_or_else(|error| panic!("{error}: {self:?}"))
    }
}

/// A server with settings changed by `change`.
pub fn serve(change: impl FnOnce(&mut Settings)) -> Served {
    let mut settings = Settings { address: "127.0.0.1:0".parse().unwrap(), ..Settings::default() };
    change(&mut settings);
    let (send, orders) = crossbeam_channel::bounded(4);
    let (server, reporter) = Server::start(&settings, send).unwrap();
    let client = Client(server.address());
    Served { server, client, reporter, orders }
}

impl Served {
    pub fn report(&mut self, notices: impl IntoIterator<Item = StationEvent>) {
        notices.into_iter().for_each(|notice| self.reporter.on_event(&notice));
    }
}

impl std::ops::Deref for Served {
    type Target = Client;

    fn deref(&self) -> &Client {
        &self.client
    }
}

impl Client {
    pub fn address(&self) -> SocketAddr {
        self.0
    }

    /// A connection with nothing sent yet.
    pub fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(self.address()).unwrap();
        stream.set_read_timeout(Some(SOON)).unwrap();
        stream.set_write_timeout(Some(SOON)).unwrap();
        stream
    }

    /// Sends bytes as they are, and reads until the server closes.
    pub fn raw(&self, bytes: &[u8]) -> Option<Reply> {
        let mut stream = self.connect();
        // A server that refuses may close before all is written.
        let _ = stream.write_all(bytes);
        reply(&mut stream)
    }

    /// A request with header lines of its own.
    pub fn request(&self, method: &str, path: &str, headers: &[&str], body: &str) -> Reply {
        let host = format!("Host: {}", self.address());
        let own = headers.iter().any(|line| line.to_lowercase().starts_with("host:"));
        let lines = (!own).then_some(host.as_str()).into_iter().chain(headers.iter().copied());
        let lines: String = lines.map(|line| format!("{line}\r\n")).collect();
        let length = body.len();
        let text = format!(
            "{method} {path} HTTP/1.1\r\n{lines}Content-Length: {length}\r\nConnection: close\r\n\r\n{body}"
        );
        self.raw(text.as_bytes()).unwrap_or_else(|| panic!("no answer to {method} {path}"))
    }

    pub fn get(&self, path: &str) -> Reply {
        self.request("GET", path, &[], "")
    }

    pub fn post(&self, path: &str, body: &str) -> Reply {
        self.request("POST", path, &[], body)
    }

    /// Asks until the answer is as wanted: notices travel through a queue.
    pub fn until(&self, path: &str, wanted: impl Fn(&Value) -> bool) -> Value {
        let begin = Instant::now();
        loop {
            let json = self.get(path).json();
            if wanted(&json) {
                return json;
            }
            assert!(begin.elapsed() < SOON, "{path} stays {json}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

fn reply(stream: &mut TcpStream) -> Option<Reply> {
    let mut bytes = Vec::new();
    // A connection that is reset after an answer has answered.
    let _ = stream.read_to_end(&mut bytes);
    let text = String::from_utf8_lossy(&bytes).into_owned();
    let (head, body) = text.split_once("\r\n\r\n")?;
    let status = head.split(' ').nth(1)?.parse().ok()?;
    Some(Reply { status, head: head.to_lowercase(), body: body.into() })
}

/// A stylus that has sent its frames: `lost` of them did not arrive.
struct Stylus;

impl Device for Stylus {
    fn name(&self) -> &str {
        "stylus"
    }

    fn streams(&self) -> Vec<StreamSpec> {
        let kind = StreamKind::Series { channels: 3, rate_hz: 10_000.0 };
        vec![StreamSpec { id: id("ac"), kind }]
    }

    fn waits(&self) -> bool {
        true
    }

    fn run(&mut self, sinks: &mut [Sink], control: &DeviceLink) -> Result<(), DeviceError> {
        let sink = sinks[0].series().unwrap();
        sink.push_waiting(&vec![0.5; 3 * 50_000], &control.stop)?;
        Ok(())
    }
}

/// The notices of a short session: a library, one scan named, one unknown, a third in progress.
pub fn session() -> Vec<StationEvent> {
    let session = Session::start(vec![Box::new(Stylus)], Options::default()).unwrap();
    let meters = session.meters.to_vec();
    session.events.iter().find(|event| matches!(event, Event::Finished(_)));
    session.wait().unwrap();
    let library = LibraryState {
        name: "workshop".into(),
        surfaces: vec![("beech".into(), 4), ("oak".into(), 5)],
        sources: vec![id("ac"), id("mi2")],
        left_out: [("oak".into(), (5, 4))].into(),
        remarks: vec!["answers come when scans end".into()],
        ..LibraryState::default()
    };
    let device = StationEvent::Device {
        device: "stylus".into(),
        state: DeviceState::Streaming,
        detail: "serial number 7".into(),
    };
    let guess = Guess {
        scan: 3,
        scan_s: 1.5,
        named: vec![
            SurfaceProbability { surface: "oak".into(), probability: 0.75 },
            SurfaceProbability { surface: "beech".into(), probability: 0.25 },
        ],
        state: Some(AnswerState::Named),
        needed_s: Some(2.7),
        ..Guess::default()
    };
    vec![
        StationEvent::Streams(meters),
        device,
        StationEvent::Library(library),
        StationEvent::Answer(Arc::new(answer(1, Some("oak")))),
        StationEvent::Answer(Arc::new(answer(2, None))),
        StationEvent::Phase { scan: 3, phase: Some(Phase::Tap) },
        StationEvent::Phase { scan: 3, phase: Some(Phase::Drag) },
        StationEvent::Guess(guess),
    ]
}

/// An answer.
pub fn answer(scan: u32, surface: Option<&str>) -> Answer {
    let known = surface.is_some();
    let score = |surface: &str, score| RankedSurface { surface: surface.into(), score };
    let name = format!("20260921-143000.{scan:03}-{scan:02}");
    Answer {
        link: format!("/#scan={name}"),
        id: name,
        unix_ms: 1_790_000_000_000 + 6000 * u64::from(scan),
        scan,
        surface: surface.map(Into::into),
        state: if known { AnswerState::Named } else { AnswerState::Unknown },
        ranked: vec![score("oak", if known { 0.5 } else { 9.5 }), score("beech", 10.0)],
        margin: if known { 3.0 } else { 0.05 },
        confidence: known.then_some(0.97),
        p_value: Some(if known { 0.6 } else { 0.0 }),
        latency_ms: 12.5,
        scan_s: 4.8,
        settled_s: known.then_some(1.9),
        sources: vec![id("ac"), id("mi2")],
        needed_s: Some(2.7),
        doubts: match known {
            true => vec![],
            false => vec![Doubt::FitsNone { surfaces: 2, p_value: 0.0, threshold: 0.01 }],
        },
        ..Answer::default()
    }
}

/// Reads a stream of events: (type, data).
pub struct Events {
    stream: TcpStream,
    text: String,
}

impl Events {
    pub fn open(served: &Client, query: &str) -> Self {
        let mut stream = served.connect();
        let host = served.address();
        write!(stream, "GET /api/v1/events{query} HTTP/1.1\r\nHost: {host}\r\n\r\n").unwrap();
        Self { stream, text: String::new() }
    }

    /// The next event of this type.
    pub fn next(&mut self, wanted: &str) -> Value {
        let begin = Instant::now();
        let opening = format!("event: {wanted}\ndata: ");
        while begin.elapsed() < SOON {
            if let Some(at) = self.text.find(&opening) {
                let rest = &self.text[at + opening.len()..];
                if let Some(end) = rest.find("\n\n") {
                    let json = serde_json::from_str(&rest[..end]).unwrap();
                    self.text = rest[end..].to_string();
                    return json;
                }
            }
            let mut bytes = [0; 65536];
            let n = self.stream.read(&mut bytes).unwrap();
            assert!(n > 0, "the stream ended before {wanted}: {}", self.text);
            self.text.push_str(&String::from_utf8_lossy(&bytes[..n]));
        }
        panic!("no {wanted} in {}", self.text);
    }
}
