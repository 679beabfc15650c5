//! Answers for other programs: by HTTP POST to a small web server, and through an MQTT broker.

mod common;

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use common::http::{SOON, answer};
use serde_json::Value;
use surfaced::device::DeviceState;
use surfaced::history::{History, Keeper};
use surfaced::outputs::{Output, OutputView};
use surfaced::recognise::RankedSurface;
use surfaced::scan::Scan;
use surfaced::scene::{Scene, SourceId};
use surfaced::station::config::{AlertCause, AlertConfig, CoilAddress, OutputsConfig, TlsFiles};
use surfaced::station::{
    Answer, AnswerState, AnsweredScan, Change, ChannelLevel, FoundSurface, LibraryState, Listener,
    StationEvent,
};
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::server::WebPkiClientVerifier;
use tokio_rustls::rustls::{RootCertStore, ServerConfig, ServerConnection, StreamOwned};

/// Takes a request, answers with a status, and gives head and body.
fn request(mut stream: impl Read + Write, status: u16) -> std::io::Result<(String, Value)> {
    let mut reader = BufReader::new(&mut stream);
    let (mut head, mut length) = (String::new(), 0);
    while reader.read_line(&mut head)? > 2 {
        let line = head.lines().next_back().unwrap().to_lowercase();
        if let Some(value) = line.strip_prefix("content-length:") {
            length = value.trim().parse().unwrap();
        }
    }
    let mut body = vec![0; length];
    reader.read_exact(&mut body)?;
    write!(stream, "HTTP/1.1 {status} x\r\nContent-Length: 0\r\n\r\n")?;
    stream.flush()?;
    Ok((head, serde_json::from_slice(&body).unwrap()))
}

/// Takes requests, answers with statuses, and gives the bodies.
fn bodies(listener: &TcpListener, statuses: &[u16]) -> Vec<Value> {
    let one = |&status: &u16| request(listener.accept().unwrap().0, status).unwrap().1;
    statuses.iter().map(one).collect()
}

fn config(http: Option<String>, mqtt: Option<String>) -> OutputsConfig {
    OutputsConfig {
        station: "press-3".into(),
        http: http.map(|address| address.parse().unwrap()),
        mqtt: mqtt.map(|address| address.parse().unwrap()),
        alerts: Vec::new(),
    }
}

/// Nothing but alerts by one rule.
fn ruled(rule: AlertConfig) -> OutputsConfig {
    OutputsConfig { alerts: vec![rule], ..config(None, None) }
}

/// A rule: two unknown scans of the last three.
fn two_unknown() -> AlertConfig {
    AlertConfig {
        name: "reject".into(),
        on: AlertCause::State(AnswerState::Unknown),
        scans: 2,
        of: 3,
        cooldown: Duration::ZERO,
        http: None,
        coil: None,
        hold: Duration::from_millis(50),
    }
}

/// The only output of a configuration.
fn start(config: &OutputsConfig, folder: &Path) -> Output {
    let history = Arc::new(History::default());
    let page = Arc::new("http://127.0.0.1:8080".to_string().into());
    Output::start(config, folder, (&history, &page)).unwrap().pop().unwrap()
}

fn send(output: &mut Output, scan: u32) {
    tell(output, answer(scan, Some("oak")));
}

fn tell(output: &mut Output, answer: Answer) {
    output.on_event(&StationEvent::Answer(Arc::new(answer)));
}

/// Waits until an output is as wanted.
fn until(output: &Output, wanted: impl Fn(&OutputView) -> bool) -> OutputView {
    let begin = Instant::now();
    loop {
        let view = output.health().view();
        if wanted(&view) {
            return view;
        }
        assert!(begin.elapsed() < SOON, "{view:?}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// An address at which nobody listens yet.
fn free() -> SocketAddr {
    listener().0.local_addr().unwrap()
}

fn listener() -> (TcpListener, String) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    (listener, address.to_string())
}

#[test]
fn answers_are_posted_in_their_order_and_again_where_the_server_cannot_take_them() {
    let folder = tempfile::tempdir().unwrap();
    let address = free();
    let config = config(Some(format!("http://{address}/answers")), None);
    let mut output = start(&config, folder.path());
    (1..=3).for_each(|scan| send(&mut output, scan));
    until(&output, |view| view.waiting == 3 && view.problem.is_some());
    let listener = TcpListener::bind(address).unwrap();
    // Not now; taken; refused for good, which is no reason to try again; taken.
    let posted = bodies(&listener, &[503, 200, 422, 200]);
    assert!(posted.iter().map(|body| &body["sequence"]).eq(&[1, 1, 2, 3]), "{posted:?}");
    assert_eq!(posted[0]["id"], posted[1]["id"], "one that comes twice is known by its id");
    assert_eq!((&posted[0]["station"], &posted[3]["scan"]), (&"press-3".into(), &3.into()));
}

#[test]
fn a_redirect_is_no_place_to_try_again_and_a_failure_is_seen_until_answers_arrive() {
    let folder = tempfile::tempdir().unwrap();
    let (listener, address) = listener();
    let mut output = start(&config(Some(format!("http://{address}/")), None), folder.path());
    send(&mut output, 1);
    bodies(&listener, &[301]);
    let is_redirected =
        |view: &OutputView| view.problem.as_ref().is_some_and(|p| p.contains("redirect"));
    assert_eq!(until(&output, is_redirected).failures, 1);
    send(&mut output, 2);
    // The first is not tried again.
    assert_eq!(bodies(&listener, &[200])[0]["scan"], 2);
    until(&output, |view| view.problem.is_none() && view.waiting == 0 && view.failures == 1);
}

#[test]
fn an_alert_is_posted_alone_and_waits_for_its_server() {
    let folder = tempfile::tempdir().unwrap();
    let address = free();
    let http = Some(format!("http://{address}/bell").parse().unwrap());
    let mut output = start(&ruled(AlertConfig { http, ..two_unknown() }), folder.path());
    tell(&mut output, answer(1, None));
    send(&mut output, 2);
    tell(&mut output, answer(3, None));
    until(&output, |view| view.waiting == 1 && view.problem.is_some());
    let listener = TcpListener::bind(address).unwrap();
    let alert = &bodies(&listener, &[200])[0];
    let found = [&alert["station"], &alert["alert"], &alert["state"]];
    assert_eq!(found, [&Value::from("press-3"), &"reject".into(), &"unknown".into()]);
    let counts = [&alert["scans"], &alert["of"], &alert["sequence"]].map(Value::as_u64);
    assert_eq!(counts, [Some(2), Some(3), Some(1)]);
    assert!(alert["id"].is_string() && alert["ranked"].is_null(), "{alert}");
}

/// A controller with a coil, and its address. It refuses the first request, follows the others, and gives
/// unit, coil and whether it was switched on.
fn controller() -> (CoilAddress, Receiver<(u8, u16, bool)>) {
    let (listener, address) = listener();
    let (send, switched) = channel();
    std::thread::spawn(move || {
        for (number, stream) in listener.incoming().enumerate() {
            let mut stream = stream.unwrap();
            // Transaction, protocol, length, unit; function, coil, value: Modbus over TCP, function 5.
            let mut request = [0; 12];
            stream.read_exact(&mut request).unwrap();
            assert_eq!((&request[2..6], request[7]), (&[0, 0, 0, 6][..], 5));
            if number == 0 {
                // Function with its high bit, and a failure of the device.
                let refusal = [&request[..4], &[0, 3, request[6], 0x85, 4]].concat();
                stream.write_all(&refusal).unwrap();
                continue;
            }
            stream.write_all(&request).unwrap();
            let coil = u16::from_be_bytes([request[8], request[9]]);
            let _ = send.send((request[6], coil, request[10..] == [0xff, 0]));
        }
    });
    (format!("modbus://{address}/9/300").parse().unwrap(), switched)
}

#[test]
fn an_alert_switches_a_coil_on_for_a_while_and_the_end_of_the_station_off() {
    let folder = tempfile::tempdir().unwrap();
    let (coil, switched) = controller();
    let rule = AlertConfig { coil: Some(coil), ..two_unknown() };
    let mut output = start(&ruled(rule.clone()), folder.path());
    (1..=2).for_each(|scan| tell(&mut output, answer(scan, None)));
    let next = || switched.recv_timeout(SOON).unwrap();
    assert_eq!([next(), next()], [(9, 300, true), (9, 300, false)]);
    let view = until(&output, |view| view.problem.is_none());
    assert_eq!(view.failures, 1, "the controller refused once");
    // An hour is longer than the station lives.
    let hold = Duration::from_secs(3600);
    let mut output = start(&ruled(AlertConfig { hold, ..rule }), folder.path());
    (1..=2).for_each(|scan| tell(&mut output, answer(scan, None)));
    assert_eq!(next(), (9, 300, true));
    drop(output);
    assert_eq!(next(), (9, 300, false));
}

#[test]
fn a_drift_of_a_reference_surface_is_posted_once_with_its_doubts_and_switches_a_coil() {
    let folder = tempfile::tempdir().unwrap();
    let ((listener, address), (coil, switched)) = (listener(), controller());
    let (name, on, scans, of) = ("worn".into(), AlertCause::Drift, 1, 1);
    let http = Some(format!("http://{address}/bell").parse().unwrap());
    let coil = Some(coil);
    let config = ruled(AlertConfig { name, on, scans, of, http, coil, ..two_unknown() });
    let history = Arc::new(History::open(&folder.path().join("history"), 1_000_000).unwrap());
    let mut keeper =
        Keeper::start(history.clone(), Scene::lmt108(), Default::default(), None).unwrap();
    let mut outputs =
        Output::start(&config, &folder.path().join("outbox"), (&history, &Arc::default())).unwrap();
    let reference = [("oak".to_string(), 0)].into();
    let library = LibraryState { reference, ..LibraryState::default() };
    keeper.on_event(&StationEvent::Library(library));
    // From scan 31 on, a channel is louder by 3 dB.
    for number in 1..=40 {
        let moved_db = if number > 30 { 3.0 } else { 0.1 * f64::from(number % 3) };
        let source = SourceId::new("ac").unwrap();
        let (level_db, noise_db) = (moved_db - 20.0, None);
        let levels = vec![ChannelLevel { source, channel: 1, level_db, noise_db }];
        let answer = Arc::new(Answer { levels, ..answer(number, Some("oak")) });
        for output in &mut outputs {
            output.on_event(&StationEvent::Answer(answer.clone()));
        }
        let scan = Box::new(Scan::of_signals(number, Default::default()));
        let answered = AnsweredScan { scan, answer, by: None };
        keeper.on_event(&StationEvent::Scan(Arc::new(answered)));
        // The keeper takes no more at once than its queue holds.
        let begin = Instant::now();
        while history.extent().scans < number as usize {
            assert!(begin.elapsed() < SOON, "{:?}", history.extent());
            std::thread::sleep(Duration::from_millis(1));
        }
    }
    let alert = &bodies(&listener, &[200])[0];
    assert_eq!((&alert["alert"], &alert["sequence"]), (&"worn".into(), &1.into()));
    let doubts = alert["drift"].as_array().unwrap();
    assert_eq!((doubts.len(), &doubts[0]["kind"]), (1, &"level_drift".into()));
    assert!(alert["state"].is_null() && alert["scans"].is_null(), "{alert}");
    let next = || switched.recv_timeout(SOON).unwrap();
    assert_eq!([next(), next()], [(9, 300, true), (9, 300, false)]);
}

#[test]
fn a_server_with_tls_is_known_by_its_authority_and_gets_the_header_of_a_file() {
    let folder = tempfile::tempdir().unwrap();
    let file = certificates(folder.path());
    let pem = |name: &str| std::fs::read(file(name)).unwrap();
    let certificate = |name: &str| CertificateDer::from_pem_slice(&pem(name)).unwrap();
    let mut clients = RootCertStore::empty();
    clients.add(certificate("ca.pem")).unwrap();
    let clients = WebPkiClientVerifier::builder(clients.into()).build().unwrap();
    let key = PrivateKeyDer::from_pem_slice(&pem("broker.key")).unwrap();
    let server = ServerConfig::builder()
        .with_client_cert_verifier(clients)
        .with_single_cert(vec![certificate("broker.pem")], key)
        .unwrap();
    let server = Arc::new(server);
    let (listener, address) = listener();
    let receive = |status| {
        let (stream, _) = listener.accept().unwrap();
        let connection = ServerConnection::new(server.clone()).unwrap();
        request(StreamOwned::new(connection, stream), status)
    };
    let of = |ca: &str, client: bool| {
        let mut config = config(Some(format!("https://{address}/answers")), None);
        let http = config.http.as_mut().unwrap();
        let client = client.then(|| (file("client.pem"), file("client.key")));
        http.tls = Some(TlsFiles { ca: Some(file(ca)), client });
        http.header_file = Some(file("header"));
        config
    };
    std::fs::write(file("header"), "Authorization: Bearer s3cret\r\n").unwrap();
    for (ca, client) in [("stranger.pem", true), ("ca.pem", false)] {
        let mut output = start(&of(ca, client), folder.path());
        send(&mut output, 1);
        assert!(receive(200).is_err(), "{ca} {client}");
        until(&output, |view| view.waiting > 0 && view.problem.is_some());
    }
    let mut output = start(&of("ca.pem", true), folder.path());
    send(&mut output, 2);
    for (status, sequence) in [(503, 1), (200, 1), (200, 2), (200, 3)] {
        let (head, body) = receive(status).unwrap();
        assert!(head.contains("authorization: Bearer s3cret\r\n"), "{head}");
        assert_eq!(body["sequence"], sequence);
    }
    let view = until(&output, |view| view.waiting == 0);
    assert!(view.output.starts_with("https://") && !format!("{view:?}").contains("s3cret"));
    drop(output);

    let refused = |config: &OutputsConfig| {
        let shown = (&Arc::new(History::default()), &Arc::default());
        Output::start(config, folder.path(), shown).unwrap_err().to_string()
    };
    for text in ["s3cret", "a b: s3cret", "A: s3\r\ncret: x", ": s3cret", ""] {
        std::fs::write(file("header"), text).unwrap();
        let why = refused(&of("ca.pem", true));
        assert!(why.contains("header: expected one line") && !why.contains("s3"), "{why}");
    }
    std::fs::write(file("header"), "A: b").unwrap();
    let why = refused(&of("ca.key", true));
    assert!(why.contains("ca.key: holds no certificate"), "{why}");
}

#[test]
fn a_station_never_waits_for_a_server_that_is_not_there_and_its_answers_wait_through_a_restart() {
    let folder = tempfile::tempdir().unwrap();
    let address = free();
    let config = config(Some(format!("http://{address}/")), None);
    let mut output = start(&config, folder.path());
    let begin = Instant::now();
    (1..=2000).for_each(|scan| send(&mut output, scan));
    assert!(begin.elapsed() < Duration::from_secs(2));
    drop(output);
    assert!(begin.elapsed() < Duration::from_secs(10), "nor does the end");
    let output = start(&config, folder.path());
    let waiting = output.health().view().waiting as usize;
    assert!(waiting >= 100, "{waiting} wait");
    let listener = TcpListener::bind(address).unwrap();
    let posted = bodies(&listener, &vec![200; waiting]);
    assert!(posted.iter().map(|body| &body["sequence"]).eq(1..=waiting), "{posted:?}");
    until(&output, |view| view.waiting == 0);
}

/// Ends a process with the test.
struct Ending(Child);

impl Drop for Ending {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Starts a program, or gives none where it is not installed, unless the machine must have it.
fn run(program: &str, arguments: &[&str]) -> Option<Ending> {
    let started =
        Command::new(program).args(arguments).stdout(Stdio::piped()).stderr(Stdio::null()).spawn();
    match started {
        Ok(child) => Some(Ending(child)),
        Err(error) if std::env::var_os("SURFACED_REQUIRE_BROKER").is_none() => {
            eprintln!("skipped: {program}: {error}");
            None
        }
        Err(error) => panic!("{program}: {error}"),
    }
}

/// A broker on a port, once it takes connections.
fn broker(port: u16, lines: &str, folder: &Path) -> Option<Ending> {
    let file = folder.join(format!("mosquitto-{port}.conf"));
    std::fs::write(&file, format!("listener {port} 127.0.0.1\n{lines}\n")).unwrap();
    let broker = run("mosquitto", &["-c", file.to_str().unwrap()])?;
    let begin = Instant::now();
    while TcpStream::connect(("127.0.0.1", port)).is_err() {
        assert!(begin.elapsed() < SOON, "mosquitto does not listen on {port}");
        std::thread::sleep(Duration::from_millis(20));
    }
    Some(broker)
}

/// The lines that a subscriber gets: the topic and the message of each line.
struct Subscriber {
    _child: Ending,
    lines: Receiver<(String, Value)>,
}

impl Subscriber {
    fn of(port: u16) -> Self {
        let port = port.to_string();
        let arguments = ["-p", &port, "-t", "#", "-q", "1", "-F", "%t %p"];
        let mut child = run("mosquitto_sub", &arguments).unwrap();
        let (send, lines) = channel();
        let out = BufReader::new(child.0.stdout.take().unwrap());
        std::thread::spawn(move || {
            for line in out.lines().map_while(Result::ok) {
                let (topic, text) = line.split_once(' ').unwrap();
                let _ = send.send((topic.into(), serde_json::from_str(text).unwrap()));
            }
        });
        Self { _child: child, lines }
    }

    /// The next message of a topic that is as wanted.
    fn next(&self, wanted: &str, is_so: impl Fn(&Value) -> bool) -> Value {
        let begin = Instant::now();
        let mut others = Vec::new();
        while let Ok((topic, said)) = self.lines.recv_timeout(SOON.saturating_sub(begin.elapsed()))
        {
            if topic == wanted && is_so(&said) {
                return said;
            }
            others.push((topic, said));
        }
        panic!("no {wanted} as wanted among {others:?}");
    }
}

const ANSWER: &str = "surfaced/press-3/answer";
const STATE: &str = "surfaced/press-3/state";

#[test]
fn answers_wait_for_the_broker_and_a_restart_and_come_once_and_in_order_and_the_last_one_stays() {
    let folder = tempfile::tempdir().unwrap();
    let port = free().port();
    let config = config(None, Some(format!("mqtt://127.0.0.1:{port}")));
    let mut output = start(&config, folder.path());
    (1..=3).for_each(|scan| send(&mut output, scan));
    until(&output, |view| view.waiting == 3 && view.problem.is_some());
    drop(output);
    let mut output = start(&config, folder.path());
    send(&mut output, 4);
    let Some(_broker) = broker(port, "allow_anonymous true", folder.path()) else { return };
    let subscriber = Subscriber::of(port);
    // Some 20 KiB; and then more than a broker takes.
    let of = |surfaces: usize, scan| {
        let ranked = (0..surfaces).map(|at| RankedSurface {
            surface: format!("a surface with a long name, number {at:06}"),
            score: 1.0 + at as f64,
        });
        Answer { ranked: ranked.collect(), ..answer(scan, Some("oak")) }
    };
    tell(&mut output, of(400, 5));
    tell(&mut output, of(4000, 6));
    until(&output, |view| view.waiting == 0 && view.problem.is_none());
    let (mut last, mut seen) = (0, Vec::new());
    while last < 6 {
        let said = subscriber.next(ANSWER, |_| true);
        last = said["scan"].as_u64().unwrap();
        assert_eq!((&said["station"], said["sequence"].as_u64()), (&"press-3".into(), Some(last)));
        seen.push(last);
    }
    // The retained one may have come before the others.
    seen.dedup();
    let first = seen.iter().position(|scan| *scan < 6).unwrap_or(0);
    assert!(seen[first..].is_sorted_by(|a, b| b - a == 1), "{seen:?}");
    // Retained messages come in any order.
    assert_eq!(Subscriber::of(port).next(ANSWER, |_| true)["scan"], 6);
    let about =
        Subscriber::of(port).next("homeassistant/sensor/surfaced_press-3/surface/config", |_| true);
    assert_eq!(about["state_topic"], ANSWER);
}

#[test]
fn the_state_tells_of_devices_and_of_a_station_that_ends_or_is_gone() {
    let folder = tempfile::tempdir().unwrap();
    let port = free().port();
    let Some(_broker) = broker(port, "allow_anonymous true", folder.path()) else { return };
    let subscriber = Subscriber::of(port);
    let mut config = config(None, Some(format!("mqtt://127.0.0.1:{port}")));
    let mut output = start(&config, folder.path());
    let online = subscriber.next(STATE, |said| said["state"] == "online");
    assert_eq!(online["page"], "http://127.0.0.1:8080");
    let (device, detail) = ("stylus".to_string(), "unplugged".to_string());
    output.on_event(&StationEvent::Device { device, state: DeviceState::Lost, detail });
    let lost = subscriber.next(STATE, |said| said["devices_down"] == 1);
    assert_eq!(
        (&lost["devices"][0]["device"], &lost["devices"][0]["state"]),
        (&"stylus".into(), &"lost".into())
    );
    let to = FoundSurface { state: AnswerState::Unknown, surface: None };
    let (from, confidence) = (None, None);
    let change = Change { unix_ms: 1, scan: 3, at_s: 1.5, since_s: 0.5, from, to, confidence };
    output.on_event(&StationEvent::Change(change.into()));
    let change = subscriber.next("surfaced/press-3/change", |said| said["scan"] == 3);
    assert_eq!(
        (&change["station"], &change["to"]["state"]),
        (&"press-3".into(), &"unknown".into())
    );
    drop(output);
    let ended = subscriber.next(STATE, |said| said["state"] == "offline");
    assert_eq!(ended["devices_down"], 1, "all that was known");
    config.alerts.push(two_unknown());
    let mut output = start(&config, folder.path());
    subscriber.next(STATE, |said| said["state"] == "online");
    (1..=2).for_each(|scan| tell(&mut output, answer(scan, None)));
    assert_eq!(subscriber.next("surfaced/press-3/alert", |_| true)["alert"], "reject");
    drop(output);
    subscriber.next(STATE, |said| said["state"] == "offline");
    // One that is killed: the broker says so.
    let data = folder.path().join("station.toml");
    let outputs = format!(
        "format = 1\n[outputs]\nmqtt = \"mqtt://127.0.0.1:{port}\"\nstation = \"press-3\"\n"
    );
    std::fs::write(&data, outputs).unwrap();
    let arguments =
        ["replay", "--speed", "1.0", "--serve=127.0.0.1:0", "--config", data.to_str().unwrap()];
    let station = run(env!("CARGO_BIN_EXE_surfaced"), &arguments).unwrap();
    // Its page is served a moment later.
    let online =
        subscriber.next(STATE, |said| said["state"] == "online" && said["page"] != Value::Null);
    assert!(online["page"].as_str().unwrap().starts_with("http://127.0.0.1:"), "{online}");
    assert_eq!(subscriber.next(ANSWER, |_| true)["synthetic"], true, "the embedded scene");
    drop(station);
    assert_eq!(subscriber.next(STATE, |said| said["state"] == "offline")["station"], "press-3");
}

/// What `surfaced outputs test` says of outputs, and its code.
fn tried(folder: &Path, outputs: &str, password: &str) -> (Option<i32>, String) {
    let station = folder.join("station.toml");
    std::fs::write(&station, format!("format = 1\n[outputs]\n{outputs}")).unwrap();
    let done = Command::new(env!("CARGO_BIN_EXE_surfaced"))
        .args(["outputs", "test", "--config", station.to_str().unwrap()])
        .env("SURFACED_MQTT_PASSWORD", password)
        .output()
        .unwrap();
    (done.status.code(), String::from_utf8([done.stdout, done.stderr].concat()).unwrap())
}

/// Certificates of a broker, a client, and a stranger's authority, made by openssl.
fn certificates(folder: &Path) -> impl Fn(&str) -> PathBuf {
    let openssl = |arguments: &str| {
        let done = Command::new("openssl")
            .current_dir(folder)
            .args(arguments.split(' '))
            .output()
            .unwrap();
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    };
    for ca in ["ca", "stranger"] {
        openssl(&format!(
            "req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN={ca} -keyout {ca}.key -out {ca}.pem"
        ));
    }
    for (name, subject) in [("broker", "/CN=127.0.0.1"), ("client", "/CN=press-3")] {
        std::fs::write(
            folder.join("names"),
            "subjectAltName=IP:127.0.0.1\nbasicConstraints=CA:FALSE\n",
        )
        .unwrap();
        openssl(&format!(
            "req -newkey rsa:2048 -nodes -subj {subject} -keyout {name}.key -out {name}.csr"
        ));
        openssl(&format!(
            "x509 -req -in {name}.csr -CA ca.pem -CAkey ca.key -CAcreateserial -days 2 -extfile names -out {name}.pem"
        ));
    }
    let folder = folder.to_path_buf();
    move |name| folder.join(name)
}

#[test]
fn a_broker_with_tls_wants_the_clients_certificate_and_is_known_by_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let (port, safe_port) = (free().port(), free().port());
    if run("mosquitto", &["-h"]).is_none() {
        return;
    }
    let file = certificates(folder.path());
    let path = |name: &str| file(name).display().to_string();
    let lines = format!(
        "allow_anonymous true\nlistener {safe_port} 127.0.0.1\ncafile {}\ncertfile {}\nkeyfile {}\n\
         require_certificate true\nuser root",
        path("ca.pem"),
        path("broker.pem"),
        path("broker.key")
    );
    let Some(_broker) = broker(port, &lines, folder.path()) else { return };
    let subscriber = Subscriber::of(port);
    let of = |ca: &str, client: bool| {
        let mut config = config(None, Some(format!("mqtts://127.0.0.1:{safe_port}")));
        let client = client.then(|| (file("client.pem"), file("client.key")));
        config.mqtt.as_mut().unwrap().tls = Some(TlsFiles { ca: Some(file(ca)), client });
        config
    };
    let mut output = start(&of("ca.pem", true), folder.path());
    send(&mut output, 1);
    assert_eq!(subscriber.next(ANSWER, |_| true)["scan"], 1);
    until(&output, |view| view.waiting == 0 && view.output.starts_with("mqtts://"));
    drop(output);
    for (ca, client) in [("stranger.pem", true), ("ca.pem", false)] {
        let mut output = start(&of(ca, client), folder.path());
        send(&mut output, 2);
        until(&output, |view| view.waiting > 0 && view.problem.is_some());
    }
    // All of them waited in one outbox.
    let _output = start(&of("ca.pem", true), folder.path());
    assert_eq!(subscriber.next(ANSWER, |said| said["scan"] == 2)["sequence"], 2);
    assert_eq!(subscriber.next(ANSWER, |said| said["scan"] == 2)["sequence"], 3);

    // The same from a file, tried from the command line.
    let test = |outputs: &str| tried(folder.path(), outputs, "");
    let address = format!("mqtt = \"mqtts://127.0.0.1:{safe_port}\"\nstation = \"press-3\"\n");
    let keys = "certificate = \"client.pem\"\nkey = \"client.key\"\n";
    let (code, text) = test(&format!("{address}ca = \"ca.pem\"\n{keys}"));
    assert!(
        code == Some(0) && text.contains("/press-3/test: acknowledged after"),
        "{code:?} {text}"
    );
    assert_eq!(subscriber.next("surfaced/press-3/test", |_| true)["state"], "unnamed");
    let (code, text) = test(&format!("{address}ca = \"stranger.pem\"\n{keys}"));
    assert!(code == Some(1) && text.contains("failed"), "{code:?} {text}");
    let (code, text) = test(&format!("{address}ca = \"absent.pem\"\n{keys}"));
    assert!(code == Some(1) && text.contains("absent.pem"), "{code:?} {text}");
    let (code, text) = test(&format!("{address}key = \"client.key\"\n"));
    assert!(
        code == Some(2) && text.contains("line 5") && text.contains("give both"),
        "{code:?} {text}"
    );
    assert_eq!(test("").0, Some(2), "no output");
}

#[test]
fn a_broker_takes_the_password_from_address_file_and_environment() {
    let folder = tempfile::tempdir().unwrap();
    let (port, known) = (free().port(), folder.path().join("known"));
    let made = ["-c", "-b", known.to_str().unwrap(), "us@er", "p:s/s"];
    let Some(mut made) = run("mosquitto_passwd", &made) else { return };
    assert!(made.0.wait().unwrap().success());
    let lines = format!("allow_anonymous false\npassword_file {}\nuser root", known.display());
    let Some(_broker) = broker(port, &lines, folder.path()) else { return };
    std::fs::write(folder.path().join("password"), "p:s/s\n").unwrap();
    let test = |user: &str, more: &str, environment: &str| {
        let mqtt = format!("mqtt = \"mqtt://{user}@127.0.0.1:{port}\"\n{more}");
        let (code, text) = tried(folder.path(), &mqtt, environment);
        assert!(!text.contains("p:s/s") && !text.contains("p%3As%2Fs"), "{text}");
        code
    };
    assert_eq!(test("us%40er:p%3As%2Fs", "", ""), Some(0));
    assert_eq!(test("us%40er", "password_file = \"password\"\n", ""), Some(0));
    assert_eq!(test("us%40er", "", "p:s/s"), Some(0));
    assert_eq!(test("us%40er", "", "another"), Some(1));
}
