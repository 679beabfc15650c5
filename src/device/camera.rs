//! The camera: upright pictures of 320 × 480 pixels, without and with flash.
//!
//! Reading may block for ever if the camera hangs. So a separate thread reads, and the device's
//! thread watches over it, judges the light of each frame, and makes pictures. While the reader
//! hangs, the state is "stalled"; nothing waits for it to end. The trait `Video` hides V4L2, whose
//! implementation comes with the crate's feature `camera`.

mod flash;
mod frame;
mod upright;
#[cfg(feature = "camera")]
mod v4l;
mod viewfinder;

use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender};

use self::flash::{Cycle, FrameLight};
use super::open::{LONGEST_RETRY, OpenError, RETRY, Retry};
use super::{Device, DeviceError, DeviceLink, DeviceState, StreamKind, StreamSpec};
use crate::ring::{Sink, Stop};
use crate::scene::SourceId;

pub use frame::Rgb;
pub use upright::Turn;
pub use viewfinder::{FlashState, Viewfinder};

pub(crate) use flash::{Flash, FlashControl, FlashLine, Shutter};
pub(crate) use frame::{Frame, FrameError};
pub(crate) use upright::upright;
#[cfg(feature = "camera")]
pub(crate) use v4l::{V4l, cameras};
pub(crate) use viewfinder::CameraView;

/// The longest time that the device's thread waits for news of the reader.
const LOOK: Duration = Duration::from_millis(50);
/// No picture for this long is a stall; cameras take their time to start.
const STALLED: Duration = Duration::from_secs(2);
/// The time that the reader has to close the camera at a stop.
const STOP_TIMEOUT: Duration = Duration::from_millis(300);
/// Least time between two reports of damaged frames.
const SUM_UP: Duration = Duration::from_secs(10);

/// A camera, as one stream of pictures, and a second one with flash if it has a flash.
pub struct Camera {
    plain: SourceId,
    flash: Option<(SourceId, Flash)>,
    video: Arc<dyn Video>,
    turn: Turn,
    every: Duration,
    settle: Duration,
    shutter: Shutter,
    viewfinder: Viewfinder,
    name: String,
}

/// The reason why a reader has ended.
enum CameraEnd {
    Stop,
    Failed(OpenError),
    Lost(String),
}

/// The state that lasts from one reader to the next.
struct CameraWatch<'a> {
    camera: &'a mut Camera,
    sinks: &'a mut [Sink],
    link: &'a DeviceLink,
    cycle: Cycle,
    /// Whether a usable frame has ever come.
    seen: bool,
    /// When the last plain picture was pushed.
    pushed: Option<Instant>,
    damaged: u64,
    summed_up: Option<Instant>,
}

impl Camera {
    /// The camera that `video` opens, as the stream `plain` of five pictures a second.
    pub fn new(plain: SourceId, video: Arc<dyn Video>) -> Self {
        let name = format!("camera {}", video.device());
        let viewfinder = Viewfinder::new(plain.clone());
        Self {
            plain,
            flash: None,
            video,
            turn: Turn::None,
            every: Duration::from_millis(200),
            settle: Duration::from_millis(300),
            shutter: Shutter::default(),
            viewfinder,
            name,
        }
    }

    /// Sets how the picture is turned to stand upright.
    pub fn turn(mut self, turn: Turn) -> Self {
        self.turn = turn;
        self
    }

    /// Sets the time between two plain pictures; what the camera delivers in between is dropped.
    pub fn every(mut self, every: Duration) -> Self {
        self.every = every;
        self
    }

    /// Adds the stream `stream` of pictures with flash, one each time that [`Camera::shutter`] is
    /// released. `settle` is the time from switching the light until frames show it, with the
    /// camera's own exposure control; while it passes, frames are dropped.
    pub fn flash(mut self, stream: SourceId, flash: Flash, settle: Duration) -> Self {
        self.flash = Some((stream, flash));
        self.settle = settle;
        self.viewfinder.light(FlashState::Off);
        self
    }

    /// Requests pictures with flash, from any thread.
    pub fn shutter(&self) -> Shutter {
        self.shutter.clone()
    }

    /// Shows what the camera sees, to any thread.
    pub fn viewfinder(&self) -> Viewfinder {
        self.viewfinder.clone()
    }
}

impl Device for Camera {
    fn name(&self) -> &str {
        &self.name
    }

    fn streams(&self) -> Vec<StreamSpec> {
        let flash = self.flash.as_ref().map(|(stream, _)| stream);
        let images = |id: &SourceId| StreamSpec { id: id.clone(), kind: StreamKind::Images };
        [Some(&self.plain), flash].into_iter().flatten().map(images).collect()
    }

    fn run(&mut self, sinks: &mut [Sink], link: &DeviceLink) -> Result<(), DeviceError> {
        link.state(DeviceState::Opening, "");
        let cycle = Cycle::new(self.settle);
        let mut watch = CameraWatch {
            camera: self,
            sinks,
            link,
            cycle,
            seen: false,
            pushed: None,
            damaged: 0,
            summed_up: None,
        };
        let mut retry = Retry::new(LONGEST_RETRY);
        while !link.stopped() {
            let stop = Stop::default();
            let (orders, news) = start_reader(watch.camera.video.clone(), stop.clone())?;
            let end = watch.follow(&orders, &news);
            watch.light_off(&orders);
            stop.request();
            drop(orders);
            // The reader closes the camera at its next frame. One that hangs is not waited for.
            let until = Instant::now() + STOP_TIMEOUT;
            while news.recv_deadline(until).is_ok() {}
            match end {
                CameraEnd::Stop => break,
                CameraEnd::Failed(error) => {
                    retry.failed(error, watch.seen, link)?;
                }
                CameraEnd::Lost(why) => {
                    retry.opened();
                    link.state(DeviceState::Lost, why);
                    link.sleep_until(Instant::now() + RETRY);
                }
            }
        }
        Ok(())
    }
}

impl CameraWatch<'_> {
    /// Makes pictures of the reader's frames, until the reader ends or a stop is requested.
    fn follow(&mut self, orders: &Sender<ControlRequest>, news: &Receiver<News>) -> CameraEnd {
        let mut last = Instant::now();
        while !self.link.stopped() {
            match news.recv_timeout(LOOK) {
                Ok(News::Opened) => last = Instant::now(),
                Ok(News::Failed(error)) => return CameraEnd::Failed(error),
                Ok(News::Ended(why)) => return CameraEnd::Lost(why),
                Ok(News::Obeyed(Ok(()))) => {}
                Ok(News::Obeyed(Err(why))) => self.no_light(&why),
                Ok(News::Frame(frame, at)) => {
                    if self.frame(&frame, at, orders) {
                        last = Instant::now();
                        self.seen = true;
                        self.link.state(DeviceState::Streaming, "");
                    }
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => {
                    return CameraEnd::Lost("the thread that reads it has ended".into());
                }
            }
            if last.elapsed() > STALLED {
                let why =
                    "no usable frame arrives; if this persists, unplug it and plug it in again";
                self.link.state(DeviceState::Stalled, why);
            }
        }
        CameraEnd::Stop
    }

    /// Handles a frame. False if it was damaged.
    fn frame(&mut self, frame: &Frame, at: Instant, orders: &Sender<ControlRequest>) -> bool {
        let has_flash = self.camera.flash.is_some();
        let shutter = &self.camera.shutter;
        let verdict = self.cycle.judge(at, || has_flash && shutter.take());
        let due = self.pushed.is_none_or(|pushed| at >= pushed + self.camera.every);
        let sink = match verdict.light {
            FrameLight::Plain if due => Some(0),
            FrameLight::Flash => Some(1),
            FrameLight::Plain | FrameLight::Between => None,
        };
        let mut good = true;
        if let Some(index) = sink {
            good = self.picture(frame, index);
            if index == 0 && good {
                self.pushed = Some(at);
            }
            if index == 1 && !good {
                // The frame with flash was damaged: take another one.
                self.camera.shutter.flash();
            }
        }
        if let Some(on) = verdict.switch {
            self.switch(on, orders);
        }
        good
    }

    fn picture(&mut self, frame: &Frame, index: usize) -> bool {
        let rgb = match frame.to_rgb() {
            Ok(rgb) => rgb,
            Err(error) => {
                self.damaged(&error);
                return false;
            }
        };
        let Some(picture) = upright(&rgb, self.camera.turn) else { return false };
        if index == 0 {
            self.camera.viewfinder.show(rgb, self.camera.turn);
        }
        if let Some(sink) = self.sinks.get_mut(index).and_then(Sink::images) {
            sink.push(Arc::new(picture));
        }
        true
    }

    fn damaged(&mut self, error: &FrameError) {
        self.damaged += 1;
        if self.summed_up.is_none_or(|at| at.elapsed() >= SUM_UP) {
            let count = self.damaged;
            self.link.warn(format!("{count} frames were damaged; the last: {error}"));
            (self.damaged, self.summed_up) = (0, Some(Instant::now()));
        }
    }

    fn switch(&mut self, on: bool, orders: &Sender<ControlRequest>) {
        let switched = match &mut self.camera.flash {
            None => Ok(()),
            Some((_, Flash::Line(line))) => line.switch(on),
            Some((_, Flash::Control(control))) => {
                let value = if on { control.on } else { control.off };
                let order = ControlRequest { control: control.id, value };
                orders.try_send(order).map_err(|_| "the camera does not take orders".into())
            }
        };
        match switched {
            Ok(()) if on => self.camera.viewfinder.light(FlashState::On),
            Ok(()) => self.camera.viewfinder.light(FlashState::Off),
            Err(why) => self.no_light(&why),
        }
    }

    fn no_light(&mut self, why: &str) {
        self.cycle.cancel();
        self.camera.viewfinder.light(FlashState::Failed);
        self.link.warn(format!("the flash cannot be switched: {why}"));
    }

    /// Switches the light off, if it is on.
    fn light_off(&mut self, orders: &Sender<ControlRequest>) {
        if self.cycle.lit() {
            self.switch(false, orders);
            self.cycle.cancel();
        }
    }
}

#[cfg(test)]
mod tests;

/// A camera that can be opened, again and again.
pub trait Video: Send + Sync {
    /// The name of the camera that it opens.
    fn device(&self) -> String;

    /// Opens the camera, and starts its stream. Called on the thread that reads.
    ///
    /// # Errors
    /// If it cannot be opened.
    fn open(&self) -> Result<Box<dyn Frames>, OpenError>;
}

pub trait Frames {
    /// The next frame; waits for it without limit.
    ///
    /// # Errors
    /// If there will be no more frames: the reason, for people.
    fn next(&mut self) -> Result<Frame, String>;

    /// Sets a control of the camera.
    ///
    /// # Errors
    /// If the camera has no such control, or refuses the value: the reason, for people.
    fn control(&mut self, id: u32, value: i64) -> Result<(), String>;
}

enum News {
    Opened,
    Failed(OpenError),
    /// A frame, and when it came.
    Frame(Frame, Instant),
    Obeyed(Result<(), String>),
    Ended(String),
}

struct ControlRequest {
    pub control: u32,
    pub value: i64,
}

/// Starts the reader. Frames that cannot be taken at once are dropped: the next one is fresher.
fn start_reader(
    video: Arc<dyn Video>,
    stop: Stop,
) -> Result<(Sender<ControlRequest>, Receiver<News>), DeviceError> {
    let (orders, ordered) = crossbeam_channel::bounded(4);
    let (send, news) = crossbeam_channel::bounded(1);
    std::thread::Builder::new()
        .name("camera-read".into())
        .spawn(move || {
            let last = match video.open() {
                Ok(frames) => read(frames, &stop, &ordered, &send),
                Err(error) => Some(News::Failed(error)),
            };
            if let Some(last) = last {
                let _ = send.send(last);
            }
        })
        .map_err(|error| {
            DeviceError::Failed(format!("cannot start a thread to read the camera: {error}"))
        })?;
    Ok((orders, news))
}

/// Reads until the camera ends, and returns the last news; `None` after a request to stop, or if
/// nobody receives any more.
fn read(
    mut frames: Box<dyn Frames>,
    stop: &Stop,
    ordered: &Receiver<ControlRequest>,
    send: &Sender<News>,
) -> Option<News> {
    send.send(News::Opened).ok()?;
    loop {
        // Orders come first, and also after a request to stop: the last one switches the light off.
        for ControlRequest { control, value } in ordered.try_iter() {
            let obeyed = frames.control(control, value);
            let _ = send.send(News::Obeyed(obeyed));
        }
        if stop.requested() {
            return None;
        }
        match frames.next() {
            Ok(frame) => drop(send.try_send(News::Frame(frame, Instant::now()))),
            Err(why) => return Some(News::Ended(why)),
        }
    }
}
