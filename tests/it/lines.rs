//! Sensors that print lines of numbers, from their line to a named surface.

use std::io::Write;
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use serde_json::Value;
use serialport::{SerialPort, TTYPort};
use surfaced::dataset;
use surfaced::scene::Scene;
use surfaced::trial::Signal;

use crate::bench::Surfaced;
use crate::common::http::SOON;
use crate::run_serve::served;

/// Seconds of rest, of a tap, of the pause after it, and of the drag.
const SCAN_S: [f64; 4] = [0.8, 0.03, 0.3, 1.6];

/// An accelerometer in g that rests, and is dragged over surfaces.
struct Accelerometer {
    rate_hz: f64,
    seed: u32,
}

impl Accelerometer {
    fn noise(&mut self) -> f64 {
        self.seed = self.seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from((self.seed >> 16) as i16) / 32_768.0
    }

    /// One scan of a surface (0 or 1), with rest before and after it.
    fn scan(&mut self, surface: usize) -> Vec<[f64; 3]> {
        let [rest_s, tap_s, pause_s, drag_s] = SCAN_S;
        let mut samples = Vec::new();
        for (seconds, loud) in
            [(rest_s, 0.0), (tap_s, 0.6), (pause_s, 0.0), (drag_s, 0.3), (rest_s, 0.0)]
        {
            for i in 0..(seconds * self.rate_hz) as usize {
                let t = i as f64 / self.rate_hz;
                let tone = |hz: f64| (std::f64::consts::TAU * hz * t).sin();
                let drag = match surface {
                    0 => [tone(35.0), 0.3 * tone(70.0), 0.1 * self.noise()],
                    _ => [0.2 * self.noise(), 0.4 * self.noise(), tone(120.0)],
                };
                let gravity = [0.0, 0.0, 1.0];
                samples.push([0, 1, 2].map(|c| gravity[c] + loud * drag[c] + 0.004 * self.noise()));
            }
        }
        samples
    }
}

/// A sensor that prints `ax,ay,az` in real time, whoever listens.
struct Sensor {
    /// The next lines to print; rest after them.
    tape: Arc<Mutex<std::collections::VecDeque<[f64; 3]>>>,
    accelerometer: Accelerometer,
    end: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Sensor {
    /// Prints with `put`, which gives up what nobody takes.
    fn start(rate_hz: f64, mut put: impl FnMut(&[u8]) + Send + 'static) -> Self {
        let (tape, end) = (Arc::<Mutex<std::collections::VecDeque<_>>>::default(), Arc::default());
        let (own, stop): (Arc<Mutex<_>>, Arc<AtomicBool>) = (Arc::clone(&tape), Arc::clone(&end));
        let mut rest = Accelerometer { rate_hz, seed: 9 };
        let print = move || {
            let (begin, mut sent) = (Instant::now(), 0_u64);
            put(b"ax,ay,az\r\n");
            while !stop.load(Ordering::Acquire) {
                let due = (begin.elapsed().as_secs_f64() * rate_hz) as u64;
                let mut text = String::new();
                while sent < due {
                    let still = [0.0, 0.0, 1.0].map(|x| x + 0.004 * rest.noise());
                    let [x, y, z] = own.lock().unwrap().pop_front().unwrap_or(still);
                    text += &format!("{x:.3},{y:.3},{z:.3}\r\n");
                    sent += 1;
                }
                put(text.as_bytes());
                std::thread::sleep(Duration::from_millis(8));
            }
        };
        let thread = Some(std::thread::spawn(print));
        Self { tape, accelerometer: Accelerometer { rate_hz, seed: 1 }, end, thread }
    }

    /// The same on a pseudo-terminal; gives its path.
    fn on_a_pty(rate_hz: f64) -> (Self, String) {
        let (mut line, slave) = TTYPort::pair().unwrap();
        line.set_timeout(Duration::from_millis(1)).unwrap();
        let path = slave.name().unwrap();
        let put = move |bytes: &[u8]| {
            let _held = &slave;
            // Like a board, which does not wait: a full line loses the rest. There is room for at
            // least a byte where the line says that there is any.
            bytes.iter().take_while(|byte| line.write(&[**byte]).is_ok()).for_each(drop);
        };
        (Self::start(rate_hz, put), path)
    }

    fn drag(&mut self, surface: usize) {
        let scan = self.accelerometer.scan(surface);
        self.tape.lock().unwrap().extend(scan);
    }
}

impl Drop for Sensor {
    fn drop(&mut self) {
        self.end.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn start(args: &[&str]) -> Surfaced {
    Surfaced::start(args, Stdio::null(), Stdio::piped())
}

fn wait() {
    std::thread::sleep(Duration::from_millis(20));
}

/// Runs a command to its end; its lines of JSON.
fn done(args: &[&str]) -> String {
    let run = Command::new(env!("CARGO_BIN_EXE_surfaced")).args(args).output().unwrap();
    let said = String::from_utf8_lossy(&run.stderr);
    assert!(run.status.success(), "{args:?}: {said}");
    String::from_utf8(run.stdout).unwrap() + &said
}

const SURFACES: [&str; 2] = ["felt", "brass"];

#[test]
fn a_sensor_that_nobody_has_described_names_a_surface_after_four_commands() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).to_str().unwrap().to_string();
    let (library, station) = (path("mine"), path("station.toml"));
    let (mut sensor, port) = Sensor::on_a_pty(400.0);
    // 1: the configuration.
    let shown = done(&["devices", "--watch", &port, "--write", &station]);
    assert!(shown.contains("lines of 3 columns at 400 Hz"), "{shown}");
    assert!(shown.contains(&format!("next: surfaced enroll LABEL --config {station}")), "{shown}");
    // 2 and 3: two surfaces.
    for (surface, label) in SURFACES.iter().enumerate() {
        let with = ["--config", &station, "--library", &library, "--trials", "2"];
        let mut enroll = start(&[&["enroll", label][..], &with].concat());
        enroll.until_said("is streaming", None);
        for number in 1..=2 {
            sensor.drag(surface);
            let line = enroll.line_while(wait);
            assert_eq!(line["trial"], number, "{line} {}", enroll.said());
        }
        assert_eq!(enroll.end_while(wait).code(), Some(0), "{}", enroll.said());
    }
    // 4: names.
    let with = ["--config", &station, "--library", &library, "--serve=127.0.0.1:0"];
    let mut run = start(&[&["run"][..], &with].concat());
    run.until_said("is streaming", None);
    for surface in [1, 0] {
        sensor.drag(surface);
        let line = run.line_while(wait);
        assert_eq!(line["surface"], SURFACES[surface], "{line} {}", run.said());
        assert_eq!(line["sources"], serde_json::json!(["sensor"]));
        assert_eq!(line["lost_samples"], 0, "{}", run.said());
        let drag_s = line["scan_s"].as_f64().unwrap();
        assert!((drag_s - SCAN_S[3]).abs() < 0.1, "{line}");
    }
    // The page, the history and the audit know it like any other source.
    let page = served(&run);
    assert!(page.get("/metrics").body.contains("\"sensor\""), "{:?}", page.get("/metrics"));
    let state = page.get("/api/v1/state").body;
    assert!(state.contains("lines from") && state.contains("brass"), "{state}");
    run.signal("TERM");
    assert_eq!(run.end_while(wait).code(), Some(0), "{}", run.said());
    let past = done(&["history", &library, "--json"]);
    assert!(past.matches("\"sensor\"").count() >= 2, "{past}");
    let audit = done(&["check", &library, "--json"]);
    assert!(audit.contains("\"trials\":4,\"accuracy\":1.0"), "{audit}");
}

#[test]
fn a_port_that_is_named_on_the_command_line_needs_no_configuration() {
    let dir = tempfile::tempdir().unwrap();
    let library = dir.path().join("mine");
    let (mut sensor, port) = Sensor::on_a_pty(250.0);
    let args = ["enroll", "felt", "--library", library.to_str().unwrap(), "--trials", "1"];
    let mut enroll = start(&[&args[..], &["--lines", &port]].concat());
    enroll.until_said("is streaming", None);
    assert!(enroll.said().contains("3 channels at 250 Hz"), "{}", enroll.said());
    sensor.drag(0);
    assert_eq!(enroll.line_while(wait)["trial"], 1, "{}", enroll.said());
    assert_eq!(enroll.end_while(wait).code(), Some(0), "{}", enroll.said());
    assert_eq!(shape(&library, "sensor"), (250.0, 3));
}

/// Rate and channels of a source in a library's first trial.
fn shape(library: &Path, source: &str) -> (f64, usize) {
    let library = dataset::open(library, &Scene::lmt108()).unwrap();
    let trial = library.entries[0].load().unwrap();
    match &trial.signals[source] {
        Signal::Series(series) => (series.rate_hz(), series.channels()),
        Signal::Image(_) => panic!("a picture"),
    }
}

#[test]
fn by_tcp_a_rate_that_is_not_given_is_measured_and_garbage_and_a_lost_line_end_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let (library, station) = (dir.path().join("mine"), dir.path().join("station.toml"));
    let server = TcpListener::bind("127.0.0.1:0").unwrap();
    server.set_nonblocking(true).unwrap();
    let config = format!(
        "format = 1\n[stylus]\npresent = false\n[microphone]\npresent = false\n\
         [camera]\npresent = false\n[[lines]]\nport = \"tcp://{}\"\n\
         [lines.sources]\ntilt = [\"ax\", \"ay\"]\nheave = [3]\n",
        server.local_addr().unwrap()
    );
    std::fs::write(&station, config).unwrap();
    let drop_line = Arc::<AtomicBool>::default();
    let (dropped, mut client) = (drop_line.clone(), None);
    let mut sensor = Sensor::start(500.0, move |bytes| {
        if dropped.swap(false, Ordering::AcqRel) {
            client = None;
        }
        if client.is_none()
            && let Ok((stream, _)) = server.accept()
        {
            let mut stream: std::net::TcpStream = stream;
            let mut first = b"ax,ay,az\n\xff\x00?\n".to_vec();
            first.extend(b"1".repeat(100_000));
            first.extend(b"\n1,2\n");
            stream.write_all(&first).unwrap();
            client = Some(stream);
        }
        if client.as_mut().is_some_and(|client| client.write_all(bytes).is_err()) {
            client = None;
        }
    });
    let with = ["--config", station.to_str().unwrap(), "--library", library.to_str().unwrap()];
    let mut record = start(&[&["record", "--label", "felt"][..], &with].concat());
    record.until_said("is streaming", None);
    sensor.drag(0);
    let line = record.line_while(wait);
    assert_eq!((&line["trial"], &line["wanted"]), (&1.into(), &Value::Null), "{line}");
    drop_line.store(true, Ordering::Release);
    record.until_said("is lost", None);
    record.until_said("lines were too long", None);
    assert!(record.said().contains("1 lines held no numbers"), "{}", record.said());
    sensor.drag(0);
    let line = record.line_while(wait);
    assert_eq!(line["trial"], 2, "{line} {}", record.said());
    record.signal("TERM");
    assert_eq!(record.end_while(wait).code(), Some(0), "{}", record.said());
    assert_eq!(shape(&library, "tilt"), (500.0, 2));
    assert_eq!(shape(&library, "heave"), (500.0, 1));
}

/// Scans of a surface, each row as `line` prints it.
fn recorded(
    surface: usize,
    scans: usize,
    rate_hz: f64,
    line: fn(u64, [f64; 3]) -> String,
) -> String {
    let mut accelerometer = Accelerometer { rate_hz, seed: 7 };
    let rows = (0..scans).flat_map(|_| accelerometer.scan(surface)).collect::<Vec<_>>();
    rows.into_iter().zip(0..).map(|(row, i)| line(i, row)).collect()
}

/// Pipes a program to `surfaced`; its lines of JSON.
fn piped(args: &[&str], mut program: Child) -> Vec<Value> {
    let from = program.stdout.take().unwrap();
    let mut run = Surfaced::start(args, from.into(), Stdio::piped());
    assert_eq!(run.end_while(wait).code(), Some(0), "{}", run.said());
    assert!(program.wait().unwrap().success());
    run.rest()
}

const ALONE: &str = "format = 1\n[stylus]\npresent = false\n[microphone]\npresent = false\n\
                     [camera]\npresent = false\n[[lines]]\nport = \"-\"\n";

#[test]
fn a_file_is_read_from_its_first_line_even_where_its_scale_has_to_be_measured() {
    let dir = tempfile::tempdir().unwrap();
    let [library, station, file] =
        ["mine", "station.toml", "rows"].map(|name| dir.path().join(name));
    std::fs::write(&station, format!("{ALONE}rate_hz = 400\n[lines.sources]\nimu = [1, 2, 3]\n"))
        .unwrap();
    let line = |_, [x, y, z]: [f64; 3]| format!("{x:.3},{y:.3},{z:.3}\n");
    // The last scan ends within its drag.
    let rows = recorded(0, 4, 400.0, line);
    let until = rows.lines().count() - 640;
    let rows = rows.lines().take(until).map(|row| format!("{row}\n")).collect::<String>();
    std::fs::write(&file, rows).unwrap();
    let (config, library) = (station.to_str().unwrap(), library.to_str().unwrap());
    let args = ["record", "--label", "felt", "--config", config, "--library", library];
    let rows = std::fs::File::open(&file).unwrap();
    let mut run = Surfaced::start(&args, rows.into(), Stdio::piped());
    assert_eq!(run.end_while(wait).code(), Some(0), "{}", run.said());
    let kept = run.rest();
    let stopped = |line: &&Value| line.to_string().contains("stopped before it was over");
    assert_eq!(kept.iter().filter(stopped).count(), 1, "{kept:?}");
    assert!(kept.len() >= 4 && stopped(&kept.last().unwrap()), "{kept:?}");
}

/// A library and a scan of each of its surfaces by way of pipes from a program, which `open` starts
/// with a file that holds what the sensor gives.
fn through_a_pipe(
    (lines, rate_hz): (&str, f64),
    line: fn(u64, [f64; 3]) -> String,
    open: &dyn Fn(&Path) -> Child,
) {
    let dir = tempfile::tempdir().unwrap();
    let (library, station) = (dir.path().join("mine"), dir.path().join("station.toml"));
    std::fs::write(&station, format!("{ALONE}rate_hz = {rate_hz}\n{lines}")).unwrap();
    let with = ["--config", station.to_str().unwrap(), "--library", library.to_str().unwrap()];
    let recording = |surface, scans| {
        let path = dir.path().join("recorded");
        std::fs::write(&path, recorded(surface, scans, rate_hz, line)).unwrap();
        open(&path)
    };
    for (surface, label) in SURFACES.iter().enumerate() {
        let args = [&["record", "--label", label][..], &with].concat();
        let kept = piped(&args, recording(surface, 3));
        assert_eq!(kept.iter().filter(|line| line["trial"].is_u64()).count(), 3, "{kept:?}");
    }
    let args = [&["run", "--lines", "-"][..], &with].concat();
    for (surface, label) in SURFACES.iter().enumerate() {
        let named = piped(&args, recording(surface, 1));
        assert_eq!(named[0]["surface"], *label, "{named:?}");
        assert_eq!(named[0]["lost_samples"], 0, "{named:?}");
    }
}

/// A program whose output is piped on.
fn spawned(command: &mut Command) -> Child {
    command.stdout(Stdio::piped()).spawn().unwrap()
}

/// Whether a program is there; else says that its test is skipped.
fn is_there(program: &str) -> bool {
    let found = Command::new("sh").args(["-c", &format!("command -v {program}")]).output().unwrap();
    if !found.status.success() {
        let required = std::env::var("SURFACED_REQUIRE_PIPES").is_ok_and(|value| value == "1");
        assert!(!required, "{program} is absent, but SURFACED_REQUIRE_PIPES=1");
        let _ = writeln!(std::io::stderr(), "SKIPPED: a test, since {program} is absent");
    }
    found.status.success()
}

#[test]
fn ros2_topic_echo_csv_of_an_imu_is_a_sensor() {
    // Its output for sensor_msgs/msg/Imu: sec, nanosec, frame_id, orientation and its covariance,
    // angular velocity and its, linear acceleration and its.
    let line = |i: u64, [x, y, z]: [f64; 3]| {
        let covariance = ",0.0".repeat(9);
        let (sec, nanosec) = (1_700_000_000 + i / 400, i % 400 * 2_500_000);
        format!(
            "{sec},{nanosec},imu_link,0.0,0.0,0.0,1.0{covariance},0.01,0.0,-0.02{covariance},{},{},{}\
             {covariance}\n",
            9.81 * x,
            9.81 * y,
            9.81 * z
        )
    };
    let lines = "[lines.sources]\nimu = [29, 30, 31]\n[lines.scale]\nimu = 0.05\n";
    through_a_pipe((lines, 400.0), line, &|recorded| spawned(Command::new("cat").arg(recorded)));
}

#[test]
fn mosquitto_sub_is_a_sensor() {
    if !is_there("mosquitto") || !is_there("mosquitto_sub") {
        return;
    }
    let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port().to_string();
    let mut broker =
        Command::new("mosquitto").args(["-p", &free]).stderr(Stdio::null()).spawn().unwrap();
    let up = || std::net::TcpStream::connect(format!("127.0.0.1:{free}")).is_ok();
    let limit = Instant::now() + SOON;
    while !up() && Instant::now() < limit {
        wait();
    }
    let line =
        |i: u64, [x, y, z]: [f64; 3]| format!("n={} x={x:.3} y={y:.3} z={z:.3}\n", i % 65_536);
    let lines = "counter = 1\n[lines.sources]\nacc = [2, 3, 4]\n[lines.scale]\nacc = 0.1\n";
    through_a_pipe((lines, 400.0), line, &|recorded| {
        let text = std::fs::read_to_string(recorded).unwrap();
        let count = text.lines().count().to_string();
        let of = ["-p", &free, "-t", "line/1/acc", "-q", "1"];
        let sub = spawned(Command::new("mosquitto_sub").args(of).args(["-C", &count]));
        // Until it has subscribed.
        std::thread::sleep(Duration::from_millis(500));
        let mut publish =
            Command::new("mosquitto_pub").args(of).arg("-l").stdin(Stdio::piped()).spawn().unwrap();
        let mut to = publish.stdin.take().unwrap();
        std::thread::spawn(move || {
            // Slowly enough for the broker's queue.
            for part in text.lines().collect::<Vec<_>>().chunks(20) {
                to.write_all((part.join("\n") + "\n").as_bytes()).unwrap();
                std::thread::sleep(Duration::from_millis(10));
            }
            drop(to);
            publish.wait().unwrap();
        });
        sub
    });
    broker.kill().unwrap();
    broker.wait().unwrap();
}

#[test]
fn arecord_is_a_sensor() {
    if !is_there("arecord") {
        return;
    }
    let line = |_, [x, _, z]: [f64; 3]| format!("{}\n", ((x + z) * 8000.0) as i16);
    let lines = "[lines.sources]\nsound = [1]\n[lines.scale]\nsound = 3.0517578125e-5\n";
    through_a_pipe((lines, 8000.0), line, &|recorded| {
        let samples: Vec<i16> = (std::fs::read_to_string(recorded).unwrap().lines())
            .map(|line| line.parse().unwrap())
            .collect();
        let raw: Vec<u8> = samples.iter().flat_map(|x| x.to_le_bytes()).collect();
        let (sound, card) = (recorded.with_extension("raw"), recorded.with_extension("conf"));
        std::fs::write(&sound, raw).unwrap();
        // A sound card that records this file.
        let config = format!(
            "</usr/share/alsa/alsa.conf>\npcm.card {{ type file slave.pcm null file /dev/null \
             infile \"{}\" format raw }}\n",
            sound.display()
        );
        std::fs::write(&card, config).unwrap();
        let arecord =
            format!("arecord -q -D card -t raw -f S16_LE -c 1 -r 8000 -s {}", samples.len());
        let pipe = format!("{arecord} | od -An -v -td2 -w2");
        spawned(Command::new("sh").args(["-c", &pipe]).env("ALSA_CONFIG_PATH", card))
    });
}

/// A board on a pseudo-terminal that sends what `print` makes of the speed that its port is set to.
fn board(print: fn(u32, u64) -> Vec<u8>) -> (Arc<AtomicBool>, JoinHandle<()>, String) {
    let (mut line, slave) = TTYPort::pair().unwrap();
    line.set_timeout(Duration::from_millis(1)).unwrap();
    let (path, end) = (slave.name().unwrap(), Arc::<AtomicBool>::default());
    let stop = end.clone();
    let send = move || {
        for i in 0.. {
            if stop.load(Ordering::Acquire) {
                return;
            }
            let baud = slave.baud_rate().unwrap();
            let _ = line.write(&print(baud, i));
            std::thread::sleep(Duration::from_millis(4));
        }
    };
    (end, std::thread::spawn(send), path)
}

/// Runs `devices --watch` on a board; what it says, and whether it succeeded.
fn watched(print: fn(u32, u64) -> Vec<u8>, args: &[&str]) -> (String, bool) {
    let (end, thread, path) = board(print);
    let args = [&["devices", "--watch", &path][..], args].concat();
    let run = Command::new(env!("CARGO_BIN_EXE_surfaced")).args(args).output().unwrap();
    end.store(true, Ordering::Release);
    thread.join().unwrap();
    let text = String::from_utf8_lossy(&run.stdout).into_owned();
    (text + &String::from_utf8_lossy(&run.stderr), run.status.success())
}

fn wave(i: u64) -> f64 {
    (i as f64 * 0.7).sin()
}

#[test]
fn the_right_speed_of_a_port_is_found_where_another_gives_noise() {
    let print = |baud, i: u64| match baud {
        57_600 => format!("{:.2},{:.2}\n", wave(i), wave(2 * i)).into_bytes(),
        _ => vec![0xf8, 0x00, 0xe6, 0x9c, 0x06, b'x', 0x80],
    };
    let (said, done) = watched(print, &[]);
    assert!(
        !done && said.contains("at 57600 baud comes text") && said.contains("@57600"),
        "{said}"
    );
}

#[test]
fn what_comes_is_shown_with_what_each_column_is_taken_for() {
    let print = |_, i: u64| match i % 4 {
        3 => b"free heap 2311\n".to_vec(),
        _ => format!("{i},{:.2},0\n", wave(i)).into_bytes(),
    };
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("station.toml");
    let (said, done) = watched(print, &["--write", file.to_str().unwrap()]);
    assert!(done && said.contains("  > ") && said.contains("always 0"), "{said}");
    assert!(said.contains("% of the lines are rows") && said.contains("free heap"), "{said}");
    let text = std::fs::read_to_string(&file).unwrap();
    assert!(text.contains("sensor = [2]"), "{text}");
}

#[test]
fn a_stream_without_line_ends_ends_the_survey() {
    let (said, done) = watched(|_, _| vec![b'7'; 64], &[]);
    assert!(!done && said.contains("no lines of numbers in one form"), "{said}");
}
