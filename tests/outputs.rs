//! Answers for other programs: by HTTP POST to a small web server, and through an MQTT broker.

mod common;

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpListener;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use common::http::{SOON, answer};
use serde_json::Value;
use surfaced::outputs::{HttpOutput, MqttOutput, OutputView};
use surfaced::recognise::RankedSurface;
use surfaced::station::{Answer, Listener, StationEvent};

/// Takes requests, answers with statuses, and gives the bodies.
fn bodies(listener: &TcpListener, statuses: &[u16]) -> Vec<Value> {
    let one = |status: &u16| {
        let (mut stream, _) = listener.accept().unwrap();
        let mut reader = BufReader::new(stream.try_clone().unwrap());
        let (mut line, mut length) = (String::new(), 0);
        while reader.read_line(&mut line).unwrap() > 2 {
            if let Some(value) = line.to_lowercase().strip_prefix("content-length:") {
                length = value.trim().parse().unwrap();
            }
            line.clear();
        }
        let mut body = vec![0; length];
        reader.read_exact(&mut body).unwrap();
        write!(stream, "HTTP/1.1 {status} x\r\nContent-Length: 0\r\n\r\n").unwrap();
        serde_json::from_slice(&body).unwrap()
    };
    statuses.iter().map(one).collect()
}

#[test]
fn answers_are_posted_in_their_order_and_again_where_the_server_cannot_take_them() {
    // The port is free, and nobody listens there yet.
    let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let mut output =
        HttpOutput::start(format!("http://{address}/answers").parse().unwrap()).unwrap();
    for scan in 1..=3 {
        output.on_event(&StationEvent::Answer(Arc::new(answer(scan, Some("oak")))));
    }
    std::thread::sleep(Duration::from_millis(300));
    let listener = TcpListener::bind(address).unwrap();
    // Not now; taken; refused for good, which is no reason to try again; taken.
    let posted = bodies(&listener, &[503, 200, 422, 200]);
    let scans: Vec<_> = posted.iter().map(|body| body["scan"].as_u64().unwrap()).collect();
    assert_eq!(scans, [1, 1, 2, 3]);
    assert_eq!(posted[0]["id"], posted[1]["id"], "one that comes twice is known by its id");
}

#[test]
fn a_redirect_is_no_place_to_try_again_and_a_failure_is_seen_until_answers_arrive() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let mut output = HttpOutput::start(format!("http://{address}/").parse().unwrap()).unwrap();
    let health = output.health();
    let mut send = |scan| output.on_event(&StationEvent::Answer(Arc::new(answer(scan, None))));
    send(1);
    bodies(&listener, &[301]);
    let until = |wanted: &dyn Fn(&OutputView) -> bool| {
        let begin = Instant::now();
        while !wanted(&health.view()) {
            assert!(begin.elapsed() < SOON, "{:?}", health.view());
            std::thread::sleep(Duration::from_millis(10));
        }
    };
    until(&|view| view.problem.as_ref().is_some_and(|problem| problem.contains("redirect")));
    assert_eq!(health.view().failures, 1);
    send(2);
    // The first is not tried again.
    assert_eq!(bodies(&listener, &[200])[0]["scan"], 2);
    until(&|view| view.problem.is_none() && view.waiting == 0 && view.failures == 1);
}

#[test]
fn a_station_never_waits_for_a_server_that_is_not_there() {
    let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let mut output = HttpOutput::start(format!("http://{address}/").parse().unwrap()).unwrap();
    let begin = Instant::now();
    for scan in 1..=2000 {
        output.on_event(&StationEvent::Answer(Arc::new(answer(scan, None))));
    }
    assert!(begin.elapsed() < Duration::from_secs(2));
    drop(output);
    assert!(begin.elapsed() < Duration::from_secs(10), "nor does the end");
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
fn start(program: &str, arguments: &[&str]) -> Option<Ending> {
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

#[test]
fn answers_are_published_once_the_broker_is_there() {
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let topic = "surfaced/answers";
    let address = format!("mqtt://127.0.0.1:{port}/{topic}").parse().unwrap();
    let mut output = MqttOutput::start(address).unwrap();
    let port = port.to_string();
    let Some(_broker) = start("mosquitto", &["-p", &port]) else { return };
    let mut reader = start("sh", &[
        "-c",
        &format!("for i in 1 2 3 4 5; do mosquitto_sub -p {port} -t '{topic}' -q 1 && break; sleep 0.3; done"),
    ])
    .unwrap();
    std::thread::sleep(Duration::from_secs(3));
    // Of 400 surfaces, some 20 KiB; and then of more than a broker takes.
    let of = |surfaces: usize, scan| {
        let ranked = (0..surfaces).map(|at| RankedSurface {
            surface: format!("a surface with a long name, number {at:06}"),
            score: at as f64,
        });
        Answer { ranked: ranked.collect(), ..answer(scan, Some("oak")) }
    };
    output.on_event(&StationEvent::Answer(Arc::new(of(400, 1))));
    let (send, lines) = std::sync::mpsc::channel();
    let mut lines_of = BufReader::new(reader.0.stdout.take().unwrap()).lines();
    std::thread::spawn(move || send.send(lines_of.next()));
    let line = lines.recv_timeout(SOON).unwrap().unwrap().unwrap();
    let said: Value = serde_json::from_str(&line).unwrap();
    assert_eq!((&said["scan"], &said["surface"]), (&1.into(), &"oak".into()));
}
