//! Gaps of any length, in rest, tap and drag, through every intake: no scan without contact, no drag
//! swallowed, and each scan that a gap cut says so.

use std::ops::Range;

use proptest::prelude::*;
use surfaced_wire::{Channel, Hello, MAX_ENCODED, Message, Samples, encode};

use super::*;
use crate::device::StreamSpec;
use crate::device::lines::{Column, Count, LinesEvent, LinesIntake, LinesStream};
use crate::device::serial::{Intake, IntakeEvent, Value, Wanted};
use crate::ring::{Sink, Waker};
use crate::scan::detect::{DetectorConfig, SensorKind};
use crate::scan::marked_scan::{Marked, cut};
use crate::scan::{Options, Scan};
use crate::scene::SourceId;
use crate::station::config::StationConfig;
use crate::trial::Signal;

/// The contacts of the sensor, in seconds.
struct Script {
    taps: Vec<Range<f64>>,
    drags: Vec<Range<f64>>,
    total_s: f64,
    longest_drag_s: f64,
}

/// Two scans; the gaps of the property test lie in them and between them.
fn two_scans() -> Script {
    let (taps, drags) = (vec![1.5..1.55, 6.5..6.55], vec![2.0..5.0, 7.0..9.5]);
    Script { taps, drags, total_s: 11.0, longest_drag_s: 60.0 }
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Line {
    Stylus,
    /// Lines without a counter.
    Plain,
    /// Lines with a counter of this many values.
    Counter(u64),
    Micros,
}

/// Samples from `at_s` on are lost for `seconds`.
#[derive(Clone, Debug)]
struct Gap {
    at_s: f64,
    seconds: f64,
    /// Whether the line was cut and opened again, and whether the device began its counter again.
    reopened: bool,
    reset: bool,
}

enum AnyIntake {
    Stylus(Box<Intake>),
    Lines(Box<LinesIntake>),
}

/// A sensor, its intake, its streams and the detector, in simulated time.
struct Bench {
    line: Line,
    intake: AnyIntake,
    sinks: Vec<Sink>,
    streams: Vec<Stream>,
    detector: ScanDetector,
    marked: Vec<Marked>,
    scans: Vec<Scan>,
    /// Value of the counter at the sensor's frame 0.
    first: i64,
}

fn id(name: &str) -> SourceId {
    SourceId::new(name).unwrap()
}

impl Bench {
    /// Two streams: `ac` is the signal, `at` the time of each frame in seconds.
    fn new(line: Line, rate_hz: f64, longest_drag_s: f64) -> Self {
        let intake = match line {
            Line::Stylus => {
                let wanted =
                    |name: &str, value| Wanted { id: id(name), channels: vec![name.into()], value };
                let wanted = vec![wanted("ac", Value::FullScale), wanted("at", Value::Unit)];
                AnyIntake::Stylus(Box::new(Intake::new(wanted, rate_hz as u32)))
            }
            _ => {
                let stream = |name: &str, place| LinesStream {
                    id: id(name),
                    columns: vec![Column::Place(place)],
                    scale: Some(1.0),
                };
                let count = match line {
                    Line::Counter(_) => Some(Count::Rows(Column::Place(1))),
                    Line::Micros => Some(Count::Micros(Column::Place(1))),
                    _ => None,
                };
                let streams = vec![stream("ac", 2), stream("at", 3)];
                AnyIntake::Lines(Box::new(LinesIntake::new(streams, count, rate_hz)))
            }
        };
        let (mut sinks, mut streams) = (Vec::new(), Vec::new());
        let options = Options { ring_s: 2.0, ..Options::default() };
        for name in ["ac", "at"] {
            let spec = StreamSpec::series(&id(name), 1, rate_hz);
            let (sink, stream) = Stream::open(&spec, 0, &options, Waker::new().0);
            sinks.push(sink);
            streams.push(stream);
        }
        let cut = |name: &str| CutFrom {
            source: id(name),
            stream: id(name),
            phase: Phase::Drag,
            channels: 1,
        };
        let detection = Detection {
            detector: DetectorConfig {
                longest_drag_s,
                ..StationConfig::embedded().detection.detector
            },
            groups: vec![vec![(id("ac"), SensorKind::Vibration)]],
            cuts: vec![cut("ac"), cut("at")],
        };
        let detector = ScanDetector::new(detection, &streams, 120.0);
        let (marked, scans) = (Vec::new(), Vec::new());
        Self { line, intake, sinks, streams, detector, marked, scans, first: 0 }
    }

    /// Sends the frames of `range`, which were sampled until `now_s`; each has a value of the signal.
    fn send(&mut self, range: Range<i64>, rate_hz: f64, signal: &[f32], now_s: f64) {
        let time_s = |frame: i64| frame as f64 / rate_hz;
        let mut bytes = Vec::new();
        if self.line == Line::Stylus {
            let channels = ["ac", "at"].map(|name| Channel { name, scale: 0.01, unit: "" });
            let message = Message::Hello(Hello {
                serial: "S",
                firmware: [1, 0, 0],
                sample_rate_hz: rate_hz as u32,
                channels: channels[..].into(),
            });
            add(&mut bytes, &message);
        }
        let frames: Vec<i64> = range.clone().collect();
        for part in frames.chunks(20) {
            let value = |frame: i64| f64::from(signal[(frame - range.start) as usize]);
            if self.line == Line::Stylus {
                let values: Vec<u8> = (part.iter())
                    .flat_map(|&f| [(value(f) * 32_768.0) as i16, (time_s(f) * 100.0) as i16])
                    .flat_map(i16::to_le_bytes)
                    .collect();
                let first = (part[0] - self.first) as u64;
                add(&mut bytes, &Message::Samples(Samples::new(first, 2, &values).unwrap()));
                continue;
            }
            for &frame in part {
                let count = match self.line {
                    Line::Counter(values) => (frame - self.first) as u64 % values,
                    Line::Micros => {
                        ((frame - self.first) as f64 * 1e6 / rate_hz) as u64 % (1 << 32)
                    }
                    _ => 0,
                };
                let (x, at) = (value(frame), time_s(frame));
                bytes.extend(format!("{count},{x:.5},{at:.3}\n").bytes());
            }
        }
        self.feed(&bytes, now_s);
    }

    fn feed(&mut self, bytes: &[u8], now_s: f64) {
        let sinks = &mut self.sinks;
        let push = |sink: &mut Sink, samples: &[f32]| {
            assert_eq!(sink.series().unwrap().push(samples), 0, "the ring is too small");
        };
        match &mut self.intake {
            AnyIntake::Stylus(intake) => {
                intake.feed(bytes, now_s, |event| match event {
                    IntakeEvent::Frames { stream, samples } => push(&mut sinks[stream], samples),
                    IntakeEvent::Missing { stream, frames } => {
                        sinks[stream].series().unwrap().skip(frames);
                    }
                    _ => {}
                });
            }
            AnyIntake::Lines(intake) => {
                intake.feed(bytes, now_s, |event| match event {
                    LinesEvent::Frames { stream, samples } => push(&mut sinks[stream], samples),
                    LinesEvent::Missing(frames) => {
                        sinks.iter_mut().for_each(|sink| sink.series().unwrap().skip(frames));
                    }
                });
            }
        }
        self.turn(now_s);
    }

    /// Does the work of a turn of the collector.
    fn turn(&mut self, now_s: f64) {
        for stream in &mut self.streams {
            stream.drain(122.0);
        }
        self.detector.update_at(now_s, &mut self.streams);
        for mark in std::mem::take(&mut self.detector.marks) {
            match mark {
                Mark::Begin(_) => self.marked.push(Marked::default()),
                Mark::GiveUp { .. } => drop(self.marked.pop()),
                mark => self.marked.last_mut().unwrap().follow(mark, &self.streams).unwrap(),
            }
        }
        if self.marked.first().is_some_and(|marked| marked.ended.is_some()) {
            let marked = self.marked.remove(0);
            self.scans.extend(cut(marked, &self.streams));
        }
        let needed = self.marked.first().and_then(|marked| marked.cuts.values().next());
        let needed = needed.map(|cut| (cut.start, cut.rate_hz));
        self.streams.iter_mut().for_each(|stream| stream.forget(needed, 5.0, 122.0));
    }
}

fn add(bytes: &mut Vec<u8>, message: &Message<'_>) {
    let mut out = [0; MAX_ENCODED];
    let n = encode(message, &mut out).unwrap();
    bytes.extend(&out[..n]);
}

/// The signal of a sensor that rests at an offset, is tapped and dragged; `tilt` changes the offset.
fn signal(script: &Script, t: f64, tilt: f32, seed: &mut u32) -> f32 {
    *seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
    let noise = (*seed >> 8) as f32 / (1 << 23) as f32 - 1.0;
    let within = |spans: &[Range<f64>]| spans.iter().any(|span| span.contains(&t));
    let amplitude = match () {
        () if within(&script.taps) => 0.5,
        () if within(&script.drags) => 0.2,
        () => 0.004,
    };
    tilt + amplitude * noise
}

/// The scans that are found; time goes on while samples are lost.
fn scans(
    script: &Script,
    (line, rate_hz): (Line, f64),
    gaps: &[Gap],
    burst_s: f64,
    seed: u32,
) -> Vec<Scan> {
    let (mut bench, mut seed) = (Bench::new(line, rate_hz, script.longest_drag_s), seed);
    let (total, step) = ((script.total_s * rate_hz) as i64, ((burst_s * rate_hz) as i64).max(1));
    let mut frame = 0;
    let mut tilt = 0.1;
    while frame < total {
        let lost = |gap: &&Gap| {
            ((gap.at_s * rate_hz) as i64..((gap.at_s + gap.seconds) * rate_hz) as i64)
                .contains(&frame)
        };
        if let Some(gap) = gaps.iter().find(lost) {
            let end = ((gap.at_s + gap.seconds) * rate_hz) as i64;
            while frame < end {
                frame = (frame + (0.05 * rate_hz) as i64 + 1).min(end);
                bench.feed(&[], frame as f64 / rate_hz);
            }
            tilt = 0.3 - tilt;
            if gap.reopened {
                match &mut bench.intake {
                    AnyIntake::Stylus(intake) => intake.reopened(),
                    AnyIntake::Lines(intake) => intake.reopened(false),
                }
            }
            if gap.reset {
                bench.first = frame;
            }
            continue;
        }
        let next_gap = gaps.iter().map(|gap| (gap.at_s * rate_hz) as i64).filter(|at| *at > frame);
        let end = (frame + step).min(total).min(next_gap.min().unwrap_or(total));
        let values: Vec<f32> =
            (frame..end).map(|i| signal(script, i as f64 / rate_hz, tilt, &mut seed)).collect();
        bench.send(frame..end, rate_hz, &values, end as f64 / rate_hz);
        frame = end;
    }
    for turn in 1..100 {
        bench.feed(&[], script.total_s.max(frame as f64 / rate_hz) + 0.05 * f64::from(turn));
    }
    assert!(bench.marked.is_empty());
    bench.scans
}

/// The true times of the first and the last frame of a scan, in seconds.
fn span_s(scan: &Scan) -> Range<f64> {
    let Signal::Series(series) = &scan.trial.signals["at"] else { panic!("no series") };
    let times: Vec<f64> = series.channel(0).collect();
    let least = times.iter().copied().fold(f64::INFINITY, f64::min);
    least..times.into_iter().fold(0.0, f64::max)
}

fn overlap_s(a: &Range<f64>, b: &Range<f64>) -> f64 {
    a.end.min(b.end) - a.start.max(b.start)
}

fn check(
    script: &Script,
    (line, rate_hz): (Line, f64),
    gaps: &[Gap],
    burst_s: f64,
    seed: u32,
) -> Result<(), String> {
    let scans = scans(script, (line, rate_hz), gaps, burst_s, seed);
    let spans: Vec<_> = scans.iter().map(span_s).collect();
    let all = || {
        let spoiled: Vec<_> = scans.iter().map(|scan| &scan.spoiled).collect();
        format!("scans {spans:?} {spoiled:?}")
    };
    let gone: Vec<Range<f64>> = gaps.iter().map(|gap| gap.at_s..gap.at_s + gap.seconds).collect();
    for span in &spans {
        if script.drags.iter().all(|drag| overlap_s(drag, span) < 0.1) {
            return Err(format!("a scan without contact: {}", all()));
        }
    }
    // Without a counter, a short gap looks like a delay.
    let seen_s = if line == Line::Plain { 0.2 } else { 0.002_f64.max(2.0 / rate_hz) };
    for drag in &script.drags {
        let of: Vec<_> =
            (spans.iter().zip(&scans)).filter(|(span, _)| overlap_s(span, drag) > 0.0).collect();
        // A gap may lie so close to the drag that nobody can tell where the drag begins or ends.
        let near = drag.start - 1.0..drag.end + 0.5;
        if gone.iter().all(|gap| overlap_s(gap, &near) <= 0.0) {
            let exact = of.iter().filter(|(span, scan)| {
                let off_s = (span.start - drag.start).abs().max((span.end - drag.end).abs());
                off_s <= 0.06 && scan.spoiled.is_empty()
            });
            if exact.count() != 1 || of.len() != 1 {
                return Err(format!("the drag {drag:?} is swallowed or damaged: {}", all()));
            }
        }
        let inside = drag.start + 0.02..drag.end - 0.02;
        let cuts = |gap: &&Range<f64>| overlap_s(gap, &inside) > seen_s;
        if gone.iter().any(|gap| cuts(&gap)) && of.iter().any(|(_, scan)| scan.spoiled.is_empty()) {
            return Err(format!("the drag {drag:?} was cut without a word: {}", all()));
        }
    }
    Ok(())
}

fn lines() -> impl Strategy<Value = Line> {
    prop_oneof![
        Just(Line::Stylus),
        Just(Line::Plain),
        prop::sample::select(vec![100, 256, 1000, 10_000, 65_536, 99_999, 100_000, 1 << 32])
            .prop_map(Line::Counter),
        Just(Line::Micros),
    ]
}

fn gap() -> impl Strategy<Value = Gap> {
    let at_s = prop_oneof![1.4..1.6f64, 2.0..5.0f64, 5.0..6.4f64, 6.4..6.6f64, 7.0..9.5f64];
    let seconds = (-3.0..1.78f64).prop_map(|exponent| 10_f64.powf(exponent));
    (at_s, seconds, any::<bool>(), any::<bool>()).prop_map(|(at_s, seconds, reopened, reset)| Gap {
        at_s,
        seconds,
        reopened,
        reset: reopened && reset,
    })
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 96,
        rng_seed: proptest::test_runner::RngSeed::Fixed(1),
        failure_persistence: None,
        ..ProptestConfig::default()
    })]
    #[test]
    fn gaps_make_no_scan_and_swallow_none_and_a_scan_that_is_cut_says_so(
        line in lines(),
        rate_hz in (2.31..4.0f64).prop_map(|exponent| 10_f64.powf(exponent).round()),
        gaps in prop::collection::vec(gap(), 0..3),
        burst_s in 0.002..0.02f64,
        seed in any::<u32>(),
    ) {
        // A counter that begins again faster than rows are late cannot tell what is lost.
        let line = match line {
            Line::Counter(values) if (values as f64) < 0.25 * rate_hz => Line::Counter(1 << 16),
            line => line,
        };
        if let Err(problem) = check(&two_scans(), (line, rate_hz), &gaps, burst_s, seed) {
            return Err(TestCaseError::fail(problem));
        }
    }
}

#[test]
fn a_silence_or_a_cut_before_each_of_six_drags_costs_none_and_makes_none() {
    for reopened in [false, true] {
        let (taps, drags, mut gaps) = (vec![], vec![], vec![]);
        let mut script = Script { taps, drags, total_s: 2.0, longest_drag_s: 60.0 };
        for seconds in [0.3, 0.5, 0.8, 1.2, 1.6, 2.0] {
            gaps.push(Gap { at_s: script.total_s, seconds, reopened, reset: false });
            let start = script.total_s + seconds + 1.1;
            script.drags.push(start..start + 3.0);
            script.total_s = start + 4.0;
        }
        for line in [Line::Plain, Line::Stylus, Line::Counter(65_536), Line::Micros] {
            let found = scans(&script, (line, 400.0), &gaps, 0.008, 5).len();
            assert_eq!(found, 6, "{line:?}, reopened: {reopened}");
            check(&script, (line, 400.0), &gaps, 0.008, 5).unwrap();
        }
    }
}

#[test]
fn a_contact_that_lasts_too_long_is_noise_unless_there_is_no_longest_drag() {
    let script = |longest_drag_s| {
        let (taps, drags) = (vec![], vec![2.0..140.0]);
        Script { taps, drags, total_s: 143.0, longest_drag_s }
    };
    let found = |script| scans(&script, (Line::Counter(65_536), 400.0), &[], 0.01, 3);
    assert!(found(script(60.0)).is_empty());
    let spans: Vec<_> = found(script(f64::INFINITY)).iter().map(span_s).collect();
    assert!(spans.len() == 1 && (spans[0].end - 140.0).abs() < 0.06, "{spans:?}");
}

#[test]
fn the_level_at_rest_is_that_just_before_the_tap_unless_samples_are_missing_there() {
    let rest = |gaps: &[Gap]| {
        let scans = scans(&two_scans(), (Line::Stylus, 1000.0), gaps, 0.02, 1);
        assert_eq!(scans.len(), 2);
        scans[1].rest.get("ac").cloned()
    };
    // Noise that is uniform up to 0.004 has a root mean square of 0.004/√3.
    let level_db = rest(&[]).unwrap()[0];
    assert!((level_db - 20.0 * (0.004 / 3_f64.sqrt()).log10()).abs() < 0.4, "{level_db}");
    let gap = Gap { at_s: 6.2, seconds: 0.01, reopened: false, reset: false };
    assert_eq!(rest(&[gap]), None);
}
