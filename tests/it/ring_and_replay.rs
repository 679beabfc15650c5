//! From recordings through rings back to scans: nothing is changed, and what is lost is said.

use std::sync::Arc;
use std::time::Duration;

use crate::common::id;
use crate::common::replayed::{listen, picture, replay, same_signals, series, trial, whole_trial};
use proptest::prelude::*;
use surfaced::device::{Begin, Device, DeviceError, DeviceLink, Mark, Open, Replay};
use surfaced::device::{Speed, StreamKind, StreamSpec};
use surfaced::library::{Entry, LibraryError, LoadTrial};
use surfaced::ring::Sink;
use surfaced::scan::{CutFrom, Event, Options, Scan, Session};
use surfaced::scene::{Phase, Scene, SourceId};
use surfaced::trial::{Signal, Trial, TrialKey};

#[test]
fn a_scan_holds_the_data_of_the_recording_and_not_its_name() {
    let trials = [whole_trial(1, 9_000), whole_trial(2, 4_000)];
    let reported = listen(Replay { synthetic: true, ..replay(&trials) }, Options::default());
    assert!(same_signals(&reported.scans, &trials));
    for (scan, trial) in reported.scans.iter().zip(&trials) {
        assert_eq!(scan.truth.as_ref(), Some(&trial.key));
        assert_eq!(scan.trial.key, TrialKey::new("", "", scan.number));
        assert!(scan.synthetic && scan.spoiled.is_empty() && scan.lost_samples == 0);
        let drag_s = ["ac", "me", "mi2"].map(|name| match &trial.signals[name] {
            Signal::Series(series) => series.duration_s(),
            Signal::Image(_) => 0.0,
        });
        assert_eq!(scan.scan_s, drag_s.into_iter().fold(0.0, f64::max));
    }
    assert_eq!(
        (reported.totals.scans, reported.totals.lost(), reported.totals.failed.len()),
        (2, 0, 0)
    );
    assert!(reported.warnings.is_empty());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn chunks_and_rings_of_any_size_give_the_same_scans(
        chunk_s in 0.0002..0.4_f64, ring_s in 0.0002..0.2_f64, ring_images in 1usize..3,
        frames in prop::collection::vec(1usize..3000, 1..4),
    ) {
        let trials: Vec<_> =
            frames.iter().enumerate().map(|(i, &n)| whole_trial(i as u32 + 1, n)).collect();
        let options = Options { ring_s, ring_images, ..Options::default() };
        let reported = listen(Replay { chunk_s, ..replay(&trials) }, options);
        prop_assert!(same_signals(&reported.scans, &trials));
        prop_assert_eq!(reported.totals.lost(), 0);
    }

    #[test]
    fn progress_does_not_depend_on_chunks_or_rings(
        chunk_s in 0.0005..0.4_f64, ring_s in 0.002..0.2_f64,
    ) {
        let trials = [whole_trial(1, 6_000), whole_trial(2, 2_000)];
        let options = |ring_s| Options { ring_s, progress_every_s: Some(0.02), ..Options::default() };
        let plain = listen(replay(&trials), options(1.0));
        let other = listen(Replay { chunk_s, ..replay(&trials) }, options(ring_s));
        prop_assert!(plain.so_far.len() >= 8, "{}", plain.so_far.len());
        prop_assert_eq!(plain.so_far, other.so_far);
    }
}

#[test]
fn a_slow_reader_costs_no_data_where_devices_wait() {
    let trials: Vec<_> = (1..5).map(|n| whole_trial(n, 3_000)).collect();
    let options = Options {
        events: 1,
        progress_every_s: Some(0.02),
        deliver_limit: Duration::ZERO,
        ..Options::default()
    };
    let session = Session::start(vec![Box::new(replay(&trials))], options).unwrap();
    let mut scans = Vec::new();
    for event in &session.events {
        std::thread::sleep(Duration::from_millis(3));
        if let Event::Scan(scan) = event {
            scans.push(*scan);
        }
    }
    assert!(same_signals(&scans, &trials));
}

#[test]
fn a_reader_that_never_reads_holds_up_no_live_device() {
    let trials: Vec<_> = (1..4).map(|n| whole_trial(n, 8_000)).collect();
    let options =
        Options { ring_s: 10.0, events: 1, progress_every_s: Some(0.01), ..Options::default() };
    let live = Replay { speed: Speed::RealTime(50.0), ..replay(&trials) };
    let session = Session::start(vec![Box::new(live)], options).unwrap();
    let sound = session.meters.iter().find(|meter| meter.id == id("mi2")).unwrap().clone();
    while sound.counts().received < 24_000 {
        std::thread::sleep(Duration::from_millis(1));
    }
    let scans = session.events.iter().filter(|event| matches!(event, Event::Scan(_))).count();
    assert_eq!((scans, session.wait().unwrap().lost()), (3, 0));
}

#[test]
fn progress_is_a_prefix_of_the_scan() {
    let trials = [whole_trial(1, 6_000)];
    let options = Options { progress_every_s: Some(0.01), ..Options::default() };
    let reported = listen(replay(&trials), options);
    assert!(reported.so_far.iter().all(|(number, _, so_far)| {
        *number == 1
            && so_far.signals.iter().all(|(id, signal)| match (signal, &trials[0].signals[id]) {
                (Signal::Series(part), Signal::Series(whole)) => {
                    whole.samples().starts_with(part.samples())
                }
                (part, whole) => part == whole,
            })
    }));
    let (_, scan_s, last) = reported.so_far.last().unwrap();
    assert_eq!(last.signals.len(), 5);
    assert!(*scan_s <= reported.scans[0].scan_s && reported.scans[0].scan_s - scan_s < 0.01 + 1e-9);
}

#[test]
fn trials_may_differ_in_sources_rates_and_channels() {
    let trials = [
        trial(1, vec![("ac", series(10_000.0, 3, 500, 1)), ("ca2", picture(9))]),
        trial(2, vec![("ac", series(2_000.0, 3, 700, 2)), ("mi2", series(8_000.0, 1, 100, 2))]),
        trial(3, vec![("ac", series(2_800.0, 1, 300, 3))]),
        trial(4, vec![("ca1", picture(7))]),
    ];
    let reported = listen(replay(&trials), Options::default());
    assert!(same_signals(&reported.scans, &trials));
}

#[test]
fn a_source_that_does_not_fit_the_scene_is_left_out_and_said() {
    let trials =
        [trial(1, vec![("mi2", series(8_000.0, 2, 50, 1)), ("ir", series(50.0, 1, 9, 1))])];
    let reported = listen(replay(&trials), Options::default());
    assert_eq!(reported.scans[0].trial.signals.keys().cloned().collect::<Vec<_>>(), [id("ir")]);
    assert!(reported.warnings[0].contains("mi2 is left out"), "{:?}", reported.warnings);
}

#[test]
fn a_trial_without_any_source_is_spoiled() {
    let reported = listen(replay(&[trial(1, vec![])]), Options::default());
    assert!(reported.scans[0].spoiled[0].to_string().contains("no source"));
}

#[test]
fn what_a_small_ring_loses_is_counted_to_the_frame() {
    let trials = [whole_trial(1, 8_000), whole_trial(2, 8_000)];
    // Each chunk is ten times what the ring holds, so that most is lost on any machine.
    let options = Options { ring_s: 0.002, ..Options::default() };
    let speed = Speed::RealTime(50.0);
    let reported = listen(Replay { speed, chunk_s: 0.02, ..replay(&trials) }, options);
    assert_eq!(reported.scans.len(), 2);
    for scan in &reported.scans {
        assert!(scan.lost_samples > 0 && !scan.spoiled.is_empty());
        // Time is kept: what was lost is filled, not closed up.
        let Signal::Series(sound) = &scan.trial.signals["mi2"] else { unreachable!() };
        assert_eq!(sound.frames(), 8_000);
    }
    let mut lost = 0;
    for (source, counts) in &reported.totals.streams {
        assert_eq!(counts.pushed, counts.received + counts.lost, "{source}");
        assert_eq!(counts.fill, 0);
        lost += counts.lost;
    }
    assert_eq!(reported.totals.streams["mi2"].pushed, 16_000);
    assert_eq!(lost, reported.scans.iter().map(|scan| scan.lost_samples).sum::<u64>());
}

#[test]
fn in_real_time_with_room_nothing_is_lost() {
    let trials = [whole_trial(1, 8_000)];
    let options = Options { ring_s: 10.0, ..Options::default() };
    let reported = listen(Replay { speed: Speed::RealTime(50.0), ..replay(&trials) }, options);
    assert!(same_signals(&reported.scans, &trials));
    assert!(reported.scans[0].spoiled.is_empty());
}

/// A sensor at 1 kHz that loses what the test says, at an index of its only scan of 100 frames.
struct Gappy {
    before: usize,
    lost: u64,
}

impl Device for Gappy {
    fn name(&self) -> &str {
        "gappy"
    }

    fn streams(&self) -> Vec<StreamSpec> {
        let kind = StreamKind::Series { channels: 1, rate_hz: 1000.0 };
        vec![StreamSpec { id: id("line"), kind }]
    }

    fn run(&mut self, sinks: &mut [Sink], control: &DeviceLink) -> Result<(), DeviceError> {
        let sink = sinks[0].series().unwrap();
        sink.push(&[-1.0; 10]);
        control.mark(Mark::Begin(Begin::default()));
        let (source, stream) = (id("ir"), id("line"));
        let cut = CutFrom { source, stream, phase: Phase::Drag, channels: 1 };
        control.mark(Mark::Open(Open { cut, start: sink.position(), rate_hz: 1000.0 }));
        sink.push(&vec![1.0; self.before]);
        sink.skip(self.lost);
        sink.push(&vec![2.0; 100 - self.before - self.lost as usize]);
        control.mark(Mark::End { at: std::time::Instant::now() });
        Ok(())
    }
}

fn gappy(before: usize, lost: u64) -> Scan {
    listen(Gappy { before, lost }, Options::default()).scans.remove(0)
}

fn samples(scan: &Scan) -> &[f32] {
    let Signal::Series(series) = &scan.trial.signals["ir"] else { unreachable!() };
    series.samples()
}

#[test]
fn a_millisecond_is_bridged_and_counted() {
    let scan = gappy(40, 1);
    assert!(scan.spoiled.is_empty(), "{:?}", scan.spoiled);
    assert_eq!((samples(&scan).len(), scan.lost_samples), (100, 1));
    assert_eq!(samples(&scan)[39..42], [1.0, 1.0, 2.0]);
}

#[test]
fn a_longer_gap_spoils_the_scan() {
    let scan = gappy(40, 2);
    let said = scan.spoiled[0].to_string();
    assert_eq!(said, "ir: a gap of 2.0 ms, longer than the 1 ms that can be bridged");
    assert_eq!((samples(&scan).len(), scan.lost_samples), (100, 2));
}

#[test]
fn a_gap_at_the_begin_holds_nothing_from_before_the_scan() {
    assert_eq!(samples(&gappy(0, 1)), [2.0; 100]);
}

#[test]
fn a_gap_at_the_end_is_seen_although_nothing_follows() {
    let scan = gappy(99, 1);
    assert_eq!((samples(&scan), scan.lost_samples), (&[1.0; 100][..], 1));
}

#[test]
fn a_source_that_was_lost_altogether_is_missing_and_said() {
    let scan = gappy(0, 100);
    assert!(scan.trial.signals.is_empty() && scan.lost_samples == 100);
    assert!(
        scan.spoiled[0].to_string().contains("none of its 100.0 ms arrived"),
        "{:?}",
        scan.spoiled
    );
}

struct Failing(fn(&DeviceLink) -> Result<(), DeviceError>);

impl Device for Failing {
    fn name(&self) -> &str {
        "failing"
    }

    fn streams(&self) -> Vec<StreamSpec> {
        Vec::new()
    }

    fn run(&mut self, _: &mut [Sink], control: &DeviceLink) -> Result<(), DeviceError> {
        control.mark(Mark::Begin(Begin::default()));
        (self.0)(control)
    }
}

#[test]
fn a_device_that_panics_ends_in_an_event() {
    let reported = listen(Failing(|_| panic!("out of cheese")), Options::default());
    assert!(reported.lost[0].contains("out of cheese"));
    assert_eq!(reported.totals.failed[0].0, "failing");
    assert!(reported.warnings[0].contains("scan 1 was cut off"), "{:?}", reported.warnings);
}

#[test]
fn a_device_that_fails_ends_in_an_event() {
    let fail = |_: &DeviceLink| Err(DeviceError::Failed("the cable is cut".into()));
    assert_eq!(listen(Failing(fail), Options::default()).lost, ["the cable is cut"]);
}

#[test]
fn a_device_that_does_not_stop_is_left_to_itself() {
    let hang = |_: &DeviceLink| loop {
        std::thread::park();
    };
    let options = Options { stop_limit: Duration::from_millis(50), ..Options::default() };
    let session = Session::start(vec![Box::new(Failing(hang))], options).unwrap();
    session.request_stop();
    assert_eq!(session.wait().unwrap().abandoned, ["failing"]);
}

#[test]
fn a_stop_ends_a_replay_wherever_it_is() {
    for (read, speed) in [0, 1, 3, 7]
        .into_iter()
        .flat_map(|n| [Speed::Max, Speed::RealTime(1.0)].map(|speed| (n, speed)))
    {
        let trials: Vec<_> = (1..20).map(|n| whole_trial(n, 20_000)).collect();
        let options = Options {
            ring_s: 0.001,
            events: 1,
            progress_every_s: Some(0.01),
            ..Options::default()
        };
        let session =
            Session::start(vec![Box::new(Replay { speed, ..replay(&trials) })], options).unwrap();
        for _ in session.events.iter().take(read) {}
        session.request_stop();
        let totals = session.wait().unwrap();
        assert!(totals.abandoned.is_empty() && totals.failed.is_empty());
        assert!(totals.scans < 19);
    }
}

#[derive(Debug)]
struct Damaged(bool);

impl LoadTrial for Damaged {
    fn load(&self, _: &[SourceId]) -> Result<Trial, LibraryError> {
        assert!(!self.0, "a decoder gave up");
        Err(LibraryError::File { path: "mi2.wav".into(), problem: "it is truncated".into() })
    }
}

#[test]
fn a_trial_that_cannot_be_read_is_passed_over_and_said() {
    let damaged =
        |panics| Entry::new(TrialKey::new("slate", "expert", 1), vec![], Arc::new(Damaged(panics)));
    let entries = vec![damaged(false), damaged(true), Entry::in_memory(whole_trial(3, 10))];
    let reported = listen(Replay::new(&Scene::lmt108(), entries), Options::default());
    assert_eq!((reported.scans.len(), reported.warnings.len()), (1, 2));
    assert!(
        reported.warnings[0].contains("slate") && reported.warnings[0].contains("it is truncated")
    );
    assert!(reported.warnings[1].contains("the file is damaged"));
}

#[test]
fn two_streams_of_one_name_are_refused() {
    let devices: Vec<Box<dyn Device>> = vec![Box::new(replay(&[])), Box::new(replay(&[]))];
    let error = Session::start(devices, Options::default()).unwrap_err();
    assert!(error.to_string().contains("two devices have a stream called ac"));
}

#[test]
fn traces_show_every_stream_without_a_hole() {
    let trials = [whole_trial(1, 8_000)];
    let options = Options { trace_every_s: Some(0.001), ..Options::default() };
    let session = Session::start(vec![Box::new(replay(&trials))], options).unwrap();
    let mut next = 0;
    for event in &session.events {
        if let Event::Trace(trace) = event {
            for fresh in trace.fresh.iter().filter(|fresh| fresh.source == id("mi2")) {
                assert_eq!(fresh.start, next);
                next += fresh.samples.len() as u64;
            }
        }
    }
    assert!(next <= 8_000);
}

#[test]
fn a_speed_is_a_number_within_reason_or_max() {
    assert_eq!("max".parse(), Ok(Speed::Max));
    assert_eq!("2.5".parse(), Ok(Speed::RealTime(2.5)));
    for text in ["0", "-1", "1e-300", "1e300", "nan", "inf", "fast", ""] {
        assert!(text.parse::<Speed>().unwrap_err().contains("expected"), "{text}");
    }
}

#[test]
fn every_source_of_the_scene_has_a_stream() {
    let replay = Replay::new(&Scene::lmt108(), Vec::new());
    let streams = replay.streams();
    assert_eq!(streams.len(), 8);
    assert!(matches!(streams[1].kind, StreamKind::Images));
    assert!(matches!(streams[0].kind, StreamKind::Series { channels: 3, .. }));
}
