//! The microphone's driver, with sound systems that misbehave as real ones do.

use std::any::Any;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use crate::common::running::Running;
use crossbeam_channel::Sender;
use surfaced::device::OpenError;
use surfaced::device::microphone::{CallbackSink, Microphone, Pick, Sound, StreamError};
use surfaced::ring::{SeriesTap, Sink, Waker, series};
use surfaced::scene::SourceId;

#[derive(Clone, Copy)]
enum MicrophoneAct {
    /// Plays 10 ms of sound in real time, which is this value and its negative in turn.
    Play(f32),
    /// Plays 10 ms of sound, without waiting for real time.
    Rush,
    /// Makes no sound for this many milliseconds.
    Pause(u64),
    /// Reports an overrun that loses this many milliseconds.
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
                        // 441 values of one channel are 10 ms.
                        sink.take(&block[..441], 1, |x| x);
                    }
                }
            }
        });
        Ok(Box::new(ScriptedStream(end)))
    }
}

struct RunningMicrophone {
    device: Running,
    tap: SeriesTap,
    openings: Arc<AtomicUsize>,
}

fn start(script: MicrophoneScript, first: Option<OpenError>) -> RunningMicrophone {
    let openings = Arc::new(AtomicUsize::new(0));
    let sound = ScriptedMicrophone { script, openings: openings.clone(), first };
    let id = SourceId::new("sound").unwrap();
    let microphone = Microphone::new(id, "ear", Pick::Mean, Box::new(sound));
    let (sink, tap) = series(1, 60 * 44_100, Waker::new().0);
    let device = Running::start(microphone, vec![Sink::Series(sink)]);
    RunningMicrophone { device, tap, openings }
}

impl RunningMicrophone {
    /// Frames pushed (lost frames included), frames lost, and the seconds that have passed.
    fn end(mut self) -> (u64, u64, f64) {
        let begin = self.device.begin;
        self.device.end();
        let seconds = begin.elapsed().as_secs_f64();
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
    running.device.says(&["opening", "streaming"]);
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
    running.device.says(&["opening", "streaming", "lost", "streaming"]);
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
    running.device.says(&["opening", "streaming"]);
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
        running.device.says(&["opening", "streaming"]);
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
    running.device.says(&["opening", "streaming", "pure silence"]);
    assert!(running.device.begin.elapsed() < second(60) + Duration::from_millis(100));
    running.device.says(&["level is normal again", "is clipped"]);
    assert!(running.device.begin.elapsed() < second(400) + Duration::from_millis(100));
    wait(1.0);
    assert!(running.device.reports.is_empty());
    running.end();
}

#[test]
fn a_stream_that_falls_silent_altogether_is_stalled_then_opened_anew() {
    let script: MicrophoneScript = |opening, step| match (opening, step) {
        (0, 30..) => MicrophoneAct::Pause(100),
        _ => MicrophoneAct::Play(0.1),
    };
    let running = start(script, None);
    running.device.says(&["opening", "streaming", "stalled", "lost", "streaming"]);
    assert_eq!(running.openings.load(Ordering::SeqCst), 2);
    running.end();
}

#[test]
fn a_microphone_without_a_pace_is_refused() {
    let running = start(|_, _| MicrophoneAct::Rush, None);
    let said = running.device.ended().unwrap_err().to_string();
    assert!(said.contains("faster than in real time"), "{said}");
}

#[test]
fn a_microphone_that_comes_later_is_absent_at_first() {
    let first = Some(OpenError::Absent("microphone ear".into()));
    let running = start(|_, _| MicrophoneAct::Play(0.1), first);
    running.device.says(&["opening", "absent", "streaming"]);
    running.end();
}

#[test]
fn one_that_will_never_do_ends_with_the_reason() {
    let first = Some(OpenError::Unfit("it does not do 44100 Hz".into()));
    let running = start(|_, _| MicrophoneAct::Gone, first);
    assert!(running.device.ended().unwrap_err().to_string().contains("44100 Hz"));
}
