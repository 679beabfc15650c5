//! Tests of the camera's driver, with simulated cameras that fail like real ones.

use std::sync::Mutex;
use std::sync::atomic::AtomicUsize;

use super::frame::FrameFormat;
use super::*;
use crate::device::running::Running;
use crate::ring::{ImageTap, Waker, images};

enum CameraAct {
    Frame(Frame),
    Hang,
    End,
}

type CameraScript = dyn Fn(usize, usize) -> CameraAct + Send + Sync;

/// A simulated camera. For each opening and frame (from 0), its script says what happens.
#[derive(Clone)]
struct ScriptedCamera {
    script: Arc<CameraScript>,
    openings: Arc<AtomicUsize>,
    /// All states that the camera's light was switched to; the open stream shares this list.
    light: Arc<Mutex<Vec<bool>>>,
    has_torch: bool,
    first: Option<OpenError>,
}

struct Playing {
    camera: ScriptedCamera,
    opening: usize,
    frame: usize,
}

impl Video for ScriptedCamera {
    fn open(&self) -> Result<Box<dyn Frames>, OpenError> {
        let opening = self.openings.fetch_add(1, Ordering::SeqCst);
        match &self.first {
            Some(error) if opening == 0 => Err(error.clone()),
            _ => Ok(Box::new(Playing { camera: self.clone(), opening, frame: 0 })),
        }
    }
}

impl Frames for Playing {
    fn next(&mut self) -> Result<Frame, String> {
        std::thread::sleep(Duration::from_millis(5));
        self.frame += 1;
        match (self.camera.script)(self.opening, self.frame - 1) {
            CameraAct::Frame(mut frame) => {
                // Frames are red while the camera's light is on.
                if self.camera.light.lock().unwrap().last() == Some(&true) {
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

    fn torch(&mut self, on: bool) -> Result<(), String> {
        self.camera.light.lock().unwrap().push(on);
        if self.camera.has_torch { Ok(()) } else { Err("no such control".into()) }
    }
}

fn grey() -> Frame {
    Frame { format: FrameFormat::Rgb, width: 320, height: 480, bytes: vec![90; 320 * 480 * 3] }
}

fn short() -> Frame {
    Frame { bytes: vec![0; 9], ..grey() }
}

fn scripted(script: impl Fn(usize, usize) -> CameraAct + Send + Sync + 'static) -> ScriptedCamera {
    let (openings, light) = (Arc::default(), Arc::default());
    ScriptedCamera { script: Arc::new(script), openings, light, has_torch: true, first: None }
}

fn camera(video: ScriptedCamera) -> Camera {
    let plain = SourceId::new("ca1").unwrap();
    Camera::new(plain, "eye", Arc::new(video), Turn::None, Duration::ZERO)
}

fn start(camera: Camera) -> (Running, Vec<ImageTap>) {
    let rings = camera.streams().into_iter().map(|_| images(1000, Waker::new().0));
    let (sinks, taps): (Vec<_>, Vec<_>) = rings.unzip();
    (Running::start(camera, sinks.into_iter().map(Sink::Images).collect()), taps)
}

fn time_to_end(running: Running) -> Duration {
    let begin = Instant::now();
    running.end();
    begin.elapsed()
}

#[test]
fn frames_become_pictures() {
    let (running, mut taps) = start(camera(scripted(|_, _| CameraAct::Frame(grey()))));
    running.says(&["opening", "streaming"]);
    let (mut count, begin) = (0, Instant::now());
    while count < 5 && begin.elapsed() < Duration::from_secs(60) {
        taps[0].drain_images(|_, image| {
            assert_eq!(image.pixel(240, 160), [90, 90, 90]);
            count += 1;
        });
        std::thread::sleep(Duration::from_millis(5));
    }
    let took = time_to_end(running);
    assert!(count >= 5 && took < Duration::from_secs(5), "{count} pictures, {took:?}");
}

#[test]
fn a_wedged_camera_is_stalled_and_does_not_hold_up_the_end() {
    let (running, _) = start(camera(scripted(|_, frame| match frame {
        0..5 => CameraAct::Frame(grey()),
        _ => CameraAct::Hang,
    })));
    running.says(&["opening", "streaming", "stalled"]);
    assert!(time_to_end(running) < Duration::from_secs(5));
}

#[test]
fn a_camera_that_is_not_there_yet_or_is_lost_is_opened_again() {
    let unplugged = scripted(|opening, frame| match (opening, frame) {
        (0, 3) => CameraAct::End,
        _ => CameraAct::Frame(grey()),
    });
    let panics = scripted(|opening, _| match opening {
        0 => panic!("a driver's bug"),
        _ => CameraAct::Frame(grey()),
    });
    let mut comes_later = scripted(|_, _| CameraAct::Frame(grey()));
    comes_later.first = Some(OpenError::Absent("camera eye".into()));
    let absent = "absent: camera eye is not there; plug it in, or look for its name with \
                  `surfaced devices`";
    let of_unplugged: &[&str] = &["opening", "streaming", "lost: No such device", "streaming"];
    let of_panics: &[&str] = &["opening", "lost", "streaming"];
    let of_later: &[&str] = &["opening", absent, "streaming"];
    for (video, said) in [(unplugged, of_unplugged), (panics, of_panics), (comes_later, of_later)] {
        let (running, _) = start(camera(video));
        running.says(said);
        running.end();
    }
}

#[test]
fn a_camera_that_will_never_do_ends_with_the_reason() {
    let mut video = scripted(|_, _| CameraAct::End);
    video.first = Some(OpenError::Unfit("camera eye has no format".into()));
    let (running, _) = start(camera(video));
    assert!(running.ended().unwrap_err().to_string().contains("no format"));
}

#[test]
fn damaged_frames_are_summed_up_and_only_damaged_ones_are_a_stall() {
    // A busy machine drops any frame, so the script changes only once the report has been seen.
    let reported = Arc::new(AtomicBool::new(false));
    let seen = reported.clone();
    let (running, _) = start(camera(scripted(move |_, frame| {
        let good = seen.load(Ordering::SeqCst) && frame % 4 != 0;
        CameraAct::Frame(if good { grey() } else { short() })
    })));
    running.says(&["opening", "1 damaged frame; the last: a frame of 9 bytes; expected 460800"]);
    reported.store(true, Ordering::SeqCst);
    running.says(&["streaming"]);
    std::thread::sleep(Duration::from_millis(200));
    assert!(running.reports.is_empty());
    running.end();

    let (running, _) = start(camera(scripted(|_, _| CameraAct::Frame(short()))));
    running.says(&["opening", "damaged frame", "stalled"]);
    running.end();
}

#[test]
fn a_flash_picture_is_taken_in_the_light_and_no_plain_one_is() {
    let video = scripted(|_, _| CameraAct::Frame(grey()));
    let light = video.light.clone();
    let ca2 = SourceId::new("ca2").unwrap();
    // Long enough for a loaded machine to see the light on.
    let camera = camera(video).flash(ca2, Flash::Camera, Duration::from_millis(400));
    let (shutter, finder) = (camera.shutter.clone(), camera.viewfinder.clone());
    let (running, mut taps) = start(camera);
    running.says(&["opening", "streaming"]);
    assert_eq!(finder.view().flash, FlashState::Off);
    shutter.flash();
    let mut lit = Vec::new();
    let mut shown_on = false;
    let begin = Instant::now();
    while lit.is_empty() && begin.elapsed() < Duration::from_secs(60) {
        shown_on |= finder.view().flash == FlashState::On;
        taps[1].drain_images(|_, image| lit.push(image.pixel(0, 0)));
        std::thread::sleep(Duration::from_millis(5));
    }
    std::thread::sleep(Duration::from_millis(200));
    running.end();
    assert_eq!(lit, [[255, 90, 90]]);
    assert!(shown_on && finder.view().flash == FlashState::Off);
    assert!(finder.view().region.is_some() && finder.jpeg().is_some());
    taps[0].drain_images(|_, image| assert_eq!(image.pixel(0, 0), [90, 90, 90]));
    assert_eq!(*light.lock().unwrap(), [true, false]);
}

#[test]
fn a_flash_that_does_not_work_is_said_and_leaves_the_camera_alone() {
    let ca2 = || SourceId::new("ca2").unwrap();
    let stylus = Flash::Stylus(Light::default());
    for (flash, part) in [(stylus, "does not answer"), (Flash::Camera, "no such control")] {
        let mut video = scripted(|_, _| CameraAct::Frame(grey()));
        video.has_torch = false;
        let camera = camera(video).flash(ca2(), flash, Duration::from_millis(50));
        camera.shutter.flash();
        let finder = camera.viewfinder.clone();
        let (running, mut taps) = start(camera);
        running.comes_to_say(part);
        assert_eq!(finder.view().flash, FlashState::Failed);
        running.end();
        assert!(!taps[1].drain_images(|_, _| {}));
    }
}

#[test]
fn a_picture_with_flash_is_one_taken_after_the_light_has_settled() {
    let (mut phase, settle) = (FlashPhase::Off, Duration::from_millis(100));
    let begin = Instant::now();
    let judge = |i: u64| phase.judge(begin + Duration::from_millis(40 * i), settle, || i == 2);
    let seen: Vec<_> = (0..12).map(judge).collect();
    let plain = (FrameLight::Plain, None);
    let between = (FrameLight::Between, None);
    let (on, flash) = ((FrameLight::Plain, Some(true)), (FrameLight::Flash, Some(false)));
    let expected = [plain, plain, on, between, between, flash, between, between, plain];
    assert_eq!(seen[..9], expected);
    assert!(seen[9..].iter().all(|frame| *frame == plain));
}
