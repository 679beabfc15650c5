//! The microphone's driver, with sound systems that misbehave as real ones do.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use super::*;
use crate::device::{DeviceReport, DeviceReportKind};
use crate::ring::Stop;

/// The next step of a simulated sound system.
#[derive(Clone, Copy)]
enum MicrophoneAct {
    /// 10 ms of this value (and its negative, in turn), in real time.
    Play(f32),
    /// 10 ms of sound, at once.
    Rush,
    /// This many milliseconds of nothing.
    Pause(u64),
    /// An overrun that lost this many milliseconds.
    Overrun(u64),
    Gone,
}

type MicrophoneScript = fn(usize, usize) -> MicrophoneAct;

/// A sound system whose script gives the act for each opening and step, both counted from 0.
struct ScriptedMicrophone {
    script: MicrophoneScript,
    openings: Arc<AtomicUsize>,
    first: Option<OpenError>,
}

struct ScriptedStream(Arc<AtomicBool>);

impl Drop for ScriptedStream {
    fn drop(&mut self) {
        self.0.store(true, Ordering::SeqCst);
    }
}

impl Sound for ScriptedMicrophone {
    fn device(&self) -> String {
        "ear".into()
    }

    fn open(
        &mut self,
        mut sink: CallbackSink,
        errors: Sender<StreamError>,
    ) -> Result<Box<dyn Any>, OpenError> {
        let opening = self.openings.fetch_add(1, Ordering::SeqCst);
        if let (Some(error), 0) = (&self.first, opening) {
            return Err(error.clone());
        }
        let (end, script) = (Arc::new(AtomicBool::new(false)), self.script);
        let ended = end.clone();
        std::thread::spawn(move || {
            let mut due = Instant::now();
            let mut wait = |ms| {
                due += Duration::from_millis(ms);
                std::thread::sleep(due.saturating_duration_since(Instant::now()));
            };
            for step in 0.. {
                let act = script(opening, step);
                match act {
                    _ if ended.load(Ordering::SeqCst) => return,
                    MicrophoneAct::Gone => {
                        return drop(errors.try_send(StreamError::Gone("unplugged".into())));
                    }
                    MicrophoneAct::Pause(ms) => wait(ms),
                    MicrophoneAct::Overrun(ms) => {
                        wait(ms);
                        let _ = errors.try_send(StreamError::Overrun);
                    }
                    MicrophoneAct::Rush | MicrophoneAct::Play(_) => {
                        let value = if let MicrophoneAct::Play(value) = act { value } else { 0.1 };
                        let block: Vec<_> = (0..441).flat_map(|_| [value, -value]).collect();
                        if matches!(act, MicrophoneAct::Play(_)) {
                            wait(10);
                        }
                        // The first 441 values, as mono sound: 10 ms.
                        sink.take(&block[..441], 1);
                    }
                }
            }
        });
        Ok(Box::new(ScriptedStream(end)))
    }
}

struct RunningMicrophone {
    tap: SeriesTap,
    reports: Receiver<DeviceReport>,
    stop: Stop,
    openings: Arc<AtomicUsize>,
    thread: std::thread::JoinHandle<Result<(), DeviceError>>,
    begin: Instant,
}

fn start(script: MicrophoneScript, first: Option<OpenError>) -> RunningMicrophone {
    let openings = Arc::new(AtomicUsize::new(0));
    let sound = ScriptedMicrophone { script, openings: openings.clone(), first };
    let mut microphone = Microphone::new(SourceId::new("sound").unwrap(), Box::new(sound));
    let (sink, tap) = series(1, 60 * 44_100, Waker::new().0);
    let mut sinks = [Sink::Series(sink)];
    let (sender, reports) = crossbeam_channel::unbounded();
    let stop = Stop::default();
    let link = DeviceLink::new(0, stop.clone(), sender);
    let thread = std::thread::spawn(move || microphone.run(&mut sinks, &link));
    RunningMicrophone { tap, reports, stop, openings, thread, begin: Instant::now() }
}

impl RunningMicrophone {
    fn next(&self) -> String {
        match self.reports.recv_timeout(Duration::from_secs(10)).unwrap().kind {
            DeviceReportKind::State { state, .. } => state.to_string(),
            DeviceReportKind::Warning(text) => text,
            other => panic!("{other:?}"),
        }
    }

    #[track_caller]
    fn says(&self, parts: &[&str]) {
        for part in parts {
            let said = self.next();
            assert!(said.contains(part), "expected `{part}`: {said}");
        }
    }

    /// Frames pushed (lost ones included), frames lost, and the seconds that passed.
    fn end(mut self) -> (u64, u64, f64) {
        self.stop.request();
        self.thread.join().unwrap().unwrap();
        let seconds = self.begin.elapsed().as_secs_f64();
        self.tap.drain(|_| {});
        let counts = self.tap.meter().counts();
        (counts.pushed, counts.lost, seconds)
    }
}

fn wait(seconds: f64) {
    std::thread::sleep(Duration::from_secs_f64(seconds));
}

#[test]
fn sound_streams_without_a_loss() {
    let running = start(|_, _| MicrophoneAct::Play(0.1), None);
    running.says(&["opening", "streaming"]);
    wait(1.0);
    let (frames, lost, seconds) = running.end();
    assert_eq!(lost, 0);
    assert!((frames as f64 / 44_100.0 - seconds).abs() < 0.2, "{frames} in {seconds} s");
}

#[test]
fn a_lost_stream_is_opened_again_and_what_it_missed_is_counted() {
    let script: MicrophoneScript = |opening, step| match (opening, step) {
        (0, 50..) => MicrophoneAct::Gone,
        (1, 0) => MicrophoneAct::Pause(400),
        _ => MicrophoneAct::Play(0.1),
    };
    let running = start(script, None);
    running.says(&["opening", "streaming", "lost", "streaming"]);
    wait(0.5);
    let (frames, lost, seconds) = running.end();
    assert!((frames as f64 / 44_100.0 - seconds).abs() < 0.2, "{frames} in {seconds} s");
    assert!((0.5..1.2).contains(&(lost as f64 / 44_100.0)), "{lost}");
}

#[test]
fn an_overrun_is_counted_where_it_was() {
    let script: MicrophoneScript = |_, step| match step {
        50 => MicrophoneAct::Overrun(300),
        _ => MicrophoneAct::Play(0.1),
    };
    let running = start(script, None);
    running.says(&["opening", "streaming"]);
    wait(1.5);
    let (_, lost, _) = running.end();
    assert!((0.2..0.4).contains(&(lost as f64 / 44_100.0)), "{lost}");
}

#[test]
fn a_pause_that_nobody_reports_is_counted_unless_its_sound_was_only_late() {
    let skipped: MicrophoneScript = |_, step| match step {
        50 => MicrophoneAct::Pause(600),
        _ => MicrophoneAct::Play(0.1),
    };
    let late: MicrophoneScript = |_, step| match step {
        50 => MicrophoneAct::Pause(600),
        51..81 => MicrophoneAct::Rush,
        81 => MicrophoneAct::Pause(0),
        82..112 => MicrophoneAct::Rush,
        _ => MicrophoneAct::Play(0.1),
    };
    let later_than_is_waited_for: MicrophoneScript = |_, step| match step {
        50 => MicrophoneAct::Pause(600),
        101..161 => MicrophoneAct::Rush,
        _ => MicrophoneAct::Play(0.1),
    };
    for (script, expected_s) in [(skipped, 0.6), (late, 0.0), (later_than_is_waited_for, 0.6)] {
        let running = start(script, None);
        running.says(&["opening", "streaming"]);
        wait(2.0);
        let (frames, lost, seconds) = running.end();
        let lost_s = lost as f64 / 44_100.0;
        assert!((lost_s - expected_s).abs() < 0.1, "{lost_s}, expected {expected_s}");
        assert!((frames as f64 / 44_100.0 - seconds).abs() < 0.2, "{frames} in {seconds} s");
    }
}

#[test]
fn silence_and_clipping_are_reported_once_a_change_and_within_a_second() {
    let script: MicrophoneScript = |_, step| match step {
        0..60 => MicrophoneAct::Play(0.1),
        60..260 => MicrophoneAct::Play(0.0),
        260..400 => MicrophoneAct::Play(0.1),
        _ => MicrophoneAct::Play(1.0),
    };
    let running = start(script, None);
    let second = |step: u64| Duration::from_millis(10 * step + 1000);
    running.says(&["opening", "streaming", "pure silence"]);
    assert!(running.begin.elapsed() < second(60) + Duration::from_millis(100));
    running.says(&["level is normal again", "is clipped"]);
    assert!(running.begin.elapsed() < second(400) + Duration::from_millis(100));
    wait(1.0);
    assert!(running.reports.is_empty());
    running.end();
}

#[test]
fn a_stream_that_falls_silent_altogether_is_stalled_then_opened_anew() {
    let script: MicrophoneScript = |opening, step| match (opening, step) {
        (0, 30..) => MicrophoneAct::Pause(100),
        _ => MicrophoneAct::Play(0.1),
    };
    let running = start(script, None);
    running.says(&["opening", "streaming", "stalled", "lost", "streaming"]);
    assert_eq!(running.openings.load(Ordering::SeqCst), 2);
    running.end();
}

#[test]
fn a_microphone_without_a_pace_is_refused() {
    let running = start(|_, _| MicrophoneAct::Rush, None);
    let said = running.thread.join().unwrap().unwrap_err().to_string();
    assert!(said.contains("faster than in real time"), "{said}");
}

#[test]
fn a_microphone_that_comes_later_is_absent_at_first() {
    let first = Some(OpenError::Absent("microphone ear".into()));
    let running = start(|_, _| MicrophoneAct::Play(0.1), first);
    running.says(&["opening", "absent", "streaming"]);
    running.end();
}

#[test]
fn one_that_will_never_do_ends_with_the_reason() {
    let first = Some(OpenError::Unfit("it does not do 44100 Hz".into()));
    let running = start(|_, _| MicrophoneAct::Gone, first);
    assert!(running.thread.join().unwrap().unwrap_err().to_string().contains("44100 Hz"));
}
