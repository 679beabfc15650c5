//! Scans found in live streams that carry no marks, by two devices whose clocks disagree.

use std::time::{Duration, Instant};

use crate::common::id;
use surfaced::device::{Device, DeviceError, DeviceLink, StreamKind, StreamSpec};
use surfaced::ring::Sink;
use surfaced::scan::detect::SensorKind;
use surfaced::scan::{CutFrom, Detection, Event, Options, Scan, ScanCommand, Session};
use surfaced::scene::Phase;
use surfaced::station::config::StationConfig;
use surfaced::trial::Signal;

/// The events, in true seconds: a tap, then a drag.
const TAP_S: [f64; 2] = [1.2, 1.26];
const DRAG_S: [f64; 2] = [2.0, 3.6];
const TOTAL_S: f64 = 4.6;

/// A sensor that samples in real time, with a clock of its own, and reports late.
struct Sensor {
    stream: &'static str,
    rate_hz: f64,
    channels: usize,
    drift: f64,
    late_s: f64,
    burst_s: f64,
    total_s: f64,
}

impl Sensor {
    /// A constant when nothing happens but noise; `seed` makes the noise.
    fn sample(&self, index: u64, seed: &mut u32) -> f32 {
        *seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let noise = (*seed >> 8) as f32 / (1 << 23) as f32 - 1.0;
        let t = index as f64 / self.rate_hz * (1.0 + self.drift);
        let within = |span: [f64; 2]| span[0] <= t && t < span[1];
        let amplitude = match () {
            () if within(TAP_S) => 0.5,
            () if within(DRAG_S) => 0.1,
            () => 0.002,
        };
        amplitude * noise
    }
}

impl Device for Sensor {
    fn name(&self) -> &str {
        self.stream
    }

    fn streams(&self) -> Vec<StreamSpec> {
        let kind = StreamKind::Series { channels: self.channels, rate_hz: self.rate_hz };
        vec![StreamSpec { id: id(self.stream), kind }]
    }

    fn run(&mut self, sinks: &mut [Sink], control: &DeviceLink) -> Result<(), DeviceError> {
        let (begin, mut sent, mut seed) = (Instant::now(), 0u64, 7);
        while (sent as f64) < self.total_s * self.rate_hz {
            if !control.sleep_until(Instant::now() + Duration::from_secs_f64(self.burst_s)) {
                break;
            }
            // Samples of `late_s` ago arrive now.
            let t = begin.elapsed().as_secs_f64() - self.late_s;
            let due = (t.max(0.0) * self.rate_hz / (1.0 + self.drift)) as u64;
            let mut samples = Vec::new();
            for index in sent..due {
                let x = self.sample(index, &mut seed);
                samples.extend(std::iter::repeat_n(x, self.channels));
            }
            sinks[0].series().unwrap().push(&samples);
            sent = due;
        }
        Ok(())
    }
}

fn detection() -> Detection {
    let cut = |source, stream, phase, channels| CutFrom {
        source: id(source),
        stream: id(stream),
        phase,
        channels,
    };
    Detection {
        detector: StationConfig::embedded().detection.detector,
        groups: vec![
            vec![(id("ac"), SensorKind::Vibration)],
            vec![(id("sound"), SensorKind::Vibration)],
        ],
        cuts: vec![
            cut("ac", "ac", Phase::Drag, 3),
            cut("mi1", "sound", Phase::Tap, 1),
            cut("mi2", "sound", Phase::Drag, 1),
        ],
    }
}

fn scans(sensors: Vec<Sensor>) -> (Vec<Scan>, Vec<String>) {
    let devices = sensors.into_iter().map(|s| Box::new(s) as Box<dyn Device>).collect();
    let options = Options { detection: Some(detection()), ..Options::default() };
    let session = Session::start(devices, options).unwrap();
    all(&session)
}

/// All scans and warnings of a session.
fn all(session: &Session) -> (Vec<Scan>, Vec<String>) {
    let (mut scans, mut warnings) = (Vec::new(), Vec::new());
    for event in &session.events {
        match event {
            Event::Scan(scan) => scans.push(*scan),
            Event::Warning(warning) => warnings.push(warning.text),
            _ => {}
        }
    }
    (scans, warnings)
}

fn acceleration(total_s: f64) -> Sensor {
    let (rate_hz, drift) = (10_000.0, 100e-6);
    Sensor { stream: "ac", rate_hz, channels: 3, drift, late_s: 0.0, burst_s: 0.004, total_s }
}

fn sound(late_s: f64) -> Sensor {
    let (rate_hz, drift) = (44_100.0, -100e-6);
    let total_s = TOTAL_S;
    Sensor { stream: "sound", rate_hz, channels: 1, drift, late_s, burst_s: 0.02, total_s }
}

/// Seconds from the begin of a cut to its first and its last loud sample, and its length.
fn loud_s(scan: &Scan, source: &str) -> [f64; 3] {
    let Some(Signal::Series(series)) = scan.trial.signals.get(source) else {
        panic!("no {source}: {:?}", scan.trial.signals.keys());
    };
    let loud = |x: &f64| x.abs() > 0.01;
    let channel: Vec<f64> = series.channel(0).collect();
    let first = channel.iter().position(loud).unwrap() as f64 / series.rate_hz();
    let last = channel.iter().rposition(loud).unwrap() as f64 / series.rate_hz();
    [first, last, series.duration_s()]
}

#[test]
fn spans_agree_whatever_the_offset_between_two_devices() {
    let runs = [0.0, 0.06, 0.2].map(|late_s| {
        (late_s, std::thread::spawn(move || scans(vec![acceleration(TOTAL_S), sound(late_s)])))
    });
    for (late_s, run) in runs {
        let (scans, warnings) = run.join().unwrap();
        assert_eq!(scans.len(), 1, "late {late_s}: {warnings:?}");
        assert!(scans[0].spoiled.is_empty(), "{:?}", scans[0].spoiled);
        let long_s = DRAG_S[1] - DRAG_S[0];
        for source in ["ac", "mi2"] {
            let [first, last, length] = loud_s(&scans[0], source);
            println!("late {late_s} {source}: {first:.4} {last:.4} {length:.4}");
            assert!(first < 0.02 && length - last < 0.02, "{source} {first} {last} {length}");
            assert!((length - long_s).abs() < 0.02, "{source}: {length}");
        }
        let [first, last, length] = loud_s(&scans[0], "mi1");
        assert!((first - 0.02).abs() < 0.02, "mi1 {first} {last} {length}");
        assert!((length - 10_501.0 / 44_100.0).abs() < 1e-3);
    }
}

#[test]
fn one_sensor_alone_makes_scans_and_a_stream_that_ends_ends_its_drag() {
    // It ends within its drag.
    let (scans, warnings) = scans(vec![acceleration(3.0)]);
    assert_eq!(scans.len(), 1, "{warnings:?}");
    assert_eq!(scans[0].trial.signals.keys().map(|id| id.as_str()).collect::<Vec<_>>(), ["ac"]);
    let [first, _, length] = loud_s(&scans[0], "ac");
    assert!(first < 0.02 && (length - 1.0).abs() < 0.03, "{first} {length}");
}

#[test]
fn a_scan_begun_by_command_ends_at_the_longest_scan() {
    let options =
        Options { detection: Some(detection()), longest_scan_s: 0.6, ..Options::default() };
    // It ends before anything is to be detected.
    let session = Session::start(vec![Box::new(acceleration(1.9))], options).unwrap();
    std::thread::sleep(Duration::from_millis(200));
    session.command(ScanCommand::Begin);
    let (scans, warnings) = all(&session);
    let [scan] = &scans[..] else { panic!("{} scans, {warnings:?}", scans.len()) };
    assert!(scan.spoiled.is_empty(), "{:?}", scan.spoiled);
    assert!((0.55..1.3).contains(&scan.scan_s), "{}", scan.scan_s);
    assert!(warnings.iter().any(|text| text.contains("ended after 0.6 s")), "{warnings:?}");
}
