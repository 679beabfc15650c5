//! The camera's driver, with cameras that misbehave as real ones do.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::Frames;
use super::frame::FrameFormat;
use super::*;
use crate::device::{DeviceReport, DeviceReportKind};
use crate::ring::{ImageTap, Waker, images};

/// The next step of a simulated camera.
enum CameraAct {
    Frame(Frame),
    Hang,
    End,
}

type CameraScript = dyn Fn(usize, usize) -> CameraAct + Send + Sync;

/// A camera whose script gives the act for each opening and frame, both counted from 0.
struct ScriptedCamera {
    script: Arc<CameraScript>,
    openings: AtomicUsize,
    /// Values that its control was set to; shared with the frames.
    light: Arc<Mutex<Vec<i64>>>,
    first: Option<OpenError>,
}

struct Playing(Arc<CameraScript>, usize, usize, Arc<Mutex<Vec<i64>>>);

impl Video for ScriptedCamera {
    fn device(&self) -> String {
        "eye".into()
    }

    fn open(&self) -> Result<Box<dyn Frames>, OpenError> {
        let opening = self.openings.fetch_add(1, Ordering::SeqCst);
        match &self.first {
            Some(error) if opening == 0 => Err(error.clone()),
            _ => Ok(Box::new(Playing(self.script.clone(), opening, 0, self.light.clone()))),
        }
    }
}

impl Frames for Playing {
    fn next(&mut self) -> Result<Frame, String> {
        std::thread::sleep(Duration::from_millis(5));
        self.2 += 1;
        match (self.0)(self.1, self.2 - 1) {
            CameraAct::Frame(mut frame) => {
                // With its light on, the camera gives red frames.
                if self.3.lock().unwrap().last() == Some(&1) {
                    frame.bytes.iter_mut().step_by(3).for_each(|byte| *byte = 255);
                }
                Ok(frame)
            }
            CameraAct::End => Err("No such device (os error 19)".into()),
            CameraAct::Hang => loop {
                std::thread::park();
            },
        }
    }

    fn control(&mut self, id: u32, value: i64) -> Result<(), String> {
        self.3.lock().unwrap().push(value);
        if id == 7 { Ok(()) } else { Err("no such control".into()) }
    }
}

fn grey() -> Frame {
    Frame { format: FrameFormat::Rgb, width: 320, height: 480, bytes: vec![90; 320 * 480 * 3] }
}

fn short() -> Frame {
    Frame { bytes: vec![0; 9], ..grey() }
}

fn scripted(script: impl Fn(usize, usize) -> CameraAct + Send + Sync + 'static) -> ScriptedCamera {
    let openings = AtomicUsize::new(0);
    ScriptedCamera { script: Arc::new(script), openings, light: Arc::default(), first: None }
}

fn camera(video: ScriptedCamera) -> Camera {
    Camera::new(SourceId::new("ca1").unwrap(), Arc::new(video)).every(Duration::ZERO)
}

/// A camera that runs on a thread of its own.
struct RunningCamera {
    taps: Vec<ImageTap>,
    reports: crossbeam_channel::Receiver<DeviceReport>,
    stop: Stop,
    thread: std::thread::JoinHandle<Result<(), DeviceError>>,
}

fn start(mut camera: Camera) -> RunningCamera {
    let (mut sinks, mut taps) = (Vec::new(), Vec::new());
    for _ in camera.streams() {
        let (sink, tap) = images(1000, Waker::new().0);
        sinks.push(Sink::Images(sink));
        taps.push(tap);
    }
    let (sender, reports) = crossbeam_channel::unbounded();
    let stop = Stop::default();
    let control = DeviceLink::new(0, stop.clone(), sender);
    let thread = std::thread::spawn(move || camera.run(&mut sinks, &control));
    RunningCamera { taps, reports, stop, thread }
}

impl RunningCamera {
    /// Waits for the next state that is reported, and gives it with its reason; skips warnings.
    fn state(&self) -> (DeviceState, String) {
        loop {
            let report = self.reports.recv_timeout(Duration::from_secs(10)).unwrap();
            if let DeviceReportKind::State { state, detail } = report.kind {
                return (state, detail);
            }
        }
    }

    fn warning(&self) -> String {
        loop {
            let report = self.reports.recv_timeout(Duration::from_secs(10)).unwrap();
            if let DeviceReportKind::Warning(text) = report.kind {
                return text;
            }
        }
    }

    #[track_caller]
    fn states(&self, expected: &[DeviceState]) {
        for state in expected {
            assert_eq!(self.state().0, *state);
        }
    }

    fn end(self) -> (Vec<ImageTap>, Duration) {
        let begin = Instant::now();
        self.stop.request();
        self.thread.join().unwrap().unwrap();
        (self.taps, begin.elapsed())
    }
}

use DeviceState::{Absent, Lost, Opening, Stalled, Streaming};

#[test]
fn frames_become_pictures() {
    let running = start(camera(scripted(|_, _| CameraAct::Frame(grey()))));
    running.states(&[Opening, Streaming]);
    std::thread::sleep(Duration::from_millis(200));
    let (mut taps, took) = running.end();
    let mut count = 0;
    taps[0].drain(|_, image| {
        assert_eq!(image.pixel(240, 160), [90, 90, 90]);
        count += 1;
    });
    assert!(count >= 5 && took < Duration::from_millis(500), "{count} pictures, {took:?}");
}

#[test]
fn a_wedged_camera_is_stalled_and_does_not_hold_up_the_end() {
    let running = start(camera(scripted(|_, frame| match frame {
        0..5 => CameraAct::Frame(grey()),
        _ => CameraAct::Hang,
    })));
    running.states(&[Opening, Streaming, Stalled]);
    assert!(running.end().1 < Duration::from_secs(1));
}

#[test]
fn a_camera_that_is_unplugged_is_lost_and_opened_again() {
    let running = start(camera(scripted(|opening, frame| match (opening, frame) {
        (0, 3) => CameraAct::End,
        _ => CameraAct::Frame(grey()),
    })));
    running.states(&[Opening, Streaming]);
    let (state, why) = running.state();
    assert!(state == Lost && why.contains("No such device"), "{why}");
    running.states(&[Streaming]);
    running.end();
}

#[test]
fn a_camera_that_is_not_there_yet_is_absent_and_tried_again() {
    let mut video = scripted(|_, _| CameraAct::Frame(grey()));
    video.first = Some(OpenError::Absent("camera eye".into()));
    let running = start(camera(video));
    running.states(&[Opening]);
    let (state, why) = running.state();
    assert!(state == Absent && why.contains("surfaced devices"), "{why}");
    running.states(&[Streaming]);
    running.end();
}

#[test]
fn a_camera_that_will_never_do_ends_with_the_reason() {
    let mut video = scripted(|_, _| CameraAct::End);
    video.first = Some(OpenError::Unfit("camera eye has no format".into()));
    let running = start(camera(video));
    let ended = running.thread.join().unwrap();
    assert!(ended.unwrap_err().to_string().contains("no format"));
}

#[test]
fn a_reader_that_panics_is_a_lost_camera() {
    let running = start(camera(scripted(|opening, _| match opening {
        0 => panic!("a driver's bug"),
        _ => CameraAct::Frame(grey()),
    })));
    running.states(&[Opening, Lost, Streaming]);
    running.end();
}

#[test]
fn damaged_frames_are_summed_up_and_only_damaged_ones_are_a_stall() {
    let running = start(camera(scripted(|_, frame| match frame % 2 {
        0 => CameraAct::Frame(short()),
        _ => CameraAct::Frame(grey()),
    })));
    let said = running.warning();
    assert!(said.contains("1 frames were damaged") && said.contains("expected 460800"), "{said}");
    running.states(&[Streaming]);
    std::thread::sleep(Duration::from_millis(200));
    assert!(running.reports.is_empty());
    running.end();

    let running = start(camera(scripted(|_, _| CameraAct::Frame(short()))));
    running.states(&[Opening, Stalled]);
    running.end();
}

#[test]
fn a_flash_picture_is_taken_in_the_light_and_no_plain_one_is() {
    let video = scripted(|_, _| CameraAct::Frame(grey()));
    let light = video.light.clone();
    let control = Flash::Control(FlashControl { id: 7, on: 1, off: 0 });
    let ca2 = SourceId::new("ca2").unwrap();
    let camera = camera(video).flash(ca2, control, Duration::from_millis(80));
    let (shutter, finder) = (camera.shutter(), camera.viewfinder());
    let mut running = start(camera);
    running.states(&[Opening, Streaming]);
    assert_eq!(finder.view().flash, FlashState::Off);
    shutter.flash();
    let mut lit = Vec::new();
    let mut shown_on = false;
    let begin = Instant::now();
    while lit.is_empty() && begin.elapsed() < Duration::from_secs(5) {
        shown_on |= finder.view().flash == FlashState::On;
        running.taps[1].drain(|_, image| lit.push(image.pixel(0, 0)));
        std::thread::sleep(Duration::from_millis(5));
    }
    std::thread::sleep(Duration::from_millis(200));
    let (mut taps, _) = running.end();
    assert_eq!(lit, [[255, 90, 90]]);
    assert!(shown_on && finder.view().flash == FlashState::Off);
    assert!(finder.view().region.is_some() && finder.jpeg().is_some());
    taps[0].drain(|_, image| assert_eq!(image.pixel(0, 0), [90, 90, 90]));
    assert_eq!(*light.lock().unwrap(), [1, 0]);
}

#[test]
fn a_flash_that_does_not_work_is_said_and_leaves_the_camera_alone() {
    struct BrokenLight;
    impl FlashLine for BrokenLight {
        fn switch(&mut self, _: bool) -> Result<(), String> {
            Err("the stylus does not answer".into())
        }
    }
    let ca2 = || SourceId::new("ca2").unwrap();
    let wrong = Flash::Control(FlashControl { id: 8, on: 1, off: 0 });
    for (flash, part) in
        [(Flash::Line(Box::new(BrokenLight)), "does not answer"), (wrong, "no such control")]
    {
        let video = scripted(|_, _| CameraAct::Frame(grey()));
        let camera = camera(video).flash(ca2(), flash, Duration::from_millis(50));
        camera.shutter().flash();
        let finder = camera.viewfinder();
        let running = start(camera);
        let said = running.warning();
        assert!(said.contains(part), "{said}");
        assert_eq!(finder.view().flash, FlashState::Failed);
        let (mut taps, _) = running.end();
        assert!(!taps[1].drain(|_, _| {}));
    }
}
