//! A camera, which makes upright pictures of 320 × 480 pixels, without and with flash.
//!
//! Reading blocks forever if a camera hangs, so a separate thread (the reader) reads the frames.
//! The device's thread watches the reader, judges the light of each frame, and makes pictures.
//! While the reader hangs, the state is "stalled", and nothing waits for it. The trait `Video`
//! hides V4L2 (video for Linux); the crate's feature `camera` adds the implementation.

mod compared_region;
mod frame;
#[cfg(feature = "camera")]
mod v4l;
mod viewfinder;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender};

use self::compared_region::compared;
use super::serial::Light;
use super::{
    Device, DeviceError, DeviceLink, DeviceState, Disconnected, LONGEST_RETRY, OpenError,
    StreamSpec, WarningKind, keep_connected,
};
use crate::printable::counted;
use crate::ring::{Sink, Stop};
use crate::scene::SourceId;

pub use compared_region::Turn;
#[cfg(feature = "camera")]
pub use v4l::{V4l, cameras};
pub use viewfinder::{CameraView, FlashState, Viewfinder};

pub(crate) use frame::Frame;

/// The longest time that the device's thread waits for a message of the reader thread.
const LOOK: Duration = Duration::from_millis(50);
/// Time without a picture after which the state is "stalled"; long, since cameras start slowly.
const STALLED: Duration = Duration::from_secs(2);
/// How long a stop waits for the reader thread to close the camera.
const STOP_TIMEOUT: Duration = Duration::from_millis(300);
/// Shortest time between two reports of damaged frames.
const SUM_UP: Duration = Duration::from_secs(10);

/// A camera as a device: a stream of pictures and, if it has a flash, a stream of flash pictures.
pub struct Camera {
    plain: SourceId,
    flash: Option<(SourceId, Flash)>,
    video: Arc<dyn Video>,
    turn: Turn,
    every: Duration,
    /// The time after which all frames show a switch of the light: light and exposure control need
    /// time, and some frames are on their way.
    settle: Duration,
    pub shutter: Shutter,
    pub viewfinder: Viewfinder,
    name: String,
}

/// The state that survives when the camera is reopened with a new reader.
struct CameraWatch<'a> {
    camera: &'a mut Camera,
    sinks: &'a mut [Sink],
    link: &'a DeviceLink,
    phase: FlashPhase,
    /// Time at which the last picture without flash was pushed; `None` before the first one.
    pushed: Option<Instant>,
    damaged: usize,
    summed_up: Option<Instant>,
    /// Whether the camera's own light is to be on; the reader switches it.
    torch: Arc<AtomicBool>,
}

impl Camera {
    /// The camera called `id`, which `video` opens. Its stream `plain` gets one picture in each period
    /// `every`; other frames are dropped. `turn` makes the pictures upright.
    pub fn new(
        plain: SourceId,
        id: &str,
        video: Arc<dyn Video>,
        turn: Turn,
        every: Duration,
    ) -> Self {
        let name = format!("camera {id}");
        let viewfinder = Viewfinder::new(plain.clone());
        Self {
            plain,
            flash: None,
            video,
            turn,
            every,
            settle: Duration::ZERO,
            shutter: Shutter::default(),
            viewfinder,
            name,
        }
    }

    /// Adds the stream `stream` of pictures with flash; its `shutter` requests each picture.
    /// Frames are dropped for the time `settle` after a switch of the light, until light and
    /// exposure are stable.
    pub fn flash(mut self, stream: SourceId, flash: Flash, settle: Duration) -> Self {
        self.flash = Some((stream, flash));
        self.settle = settle;
        self.viewfinder.light(FlashState::Off);
        self
    }
}

impl Device for Camera {
    fn name(&self) -> &str {
        &self.name
    }

    fn streams(&self) -> Vec<StreamSpec> {
        let flash = self.flash.as_ref().map(|(stream, _)| stream);
        [Some(&self.plain), flash].into_iter().flatten().map(StreamSpec::images).collect()
    }

    fn run(&mut self, sinks: &mut [Sink], link: &DeviceLink) -> Result<(), DeviceError> {
        link.state(DeviceState::Opening, "");
        let mut watch = CameraWatch {
            camera: self,
            sinks,
            link,
            phase: FlashPhase::Off,
            pushed: None,
            damaged: 0,
            summed_up: None,
            torch: Arc::default(),
        };
        keep_connected(link, LONGEST_RETRY, || {
            let stop = Stop::default();
            watch.torch.store(false, Ordering::Release);
            let video = watch.camera.video.clone();
            let news = start_reader(video, stop.clone(), watch.torch.clone())?;
            let end = watch.follow(&news);
            if matches!(watch.phase, FlashPhase::Rising(_)) {
                watch.switch(false);
                watch.phase = FlashPhase::Off;
            }
            stop.request();
            // Waits until the reader has closed the camera; a hanging reader costs `STOP_TIMEOUT`.
            let until = Instant::now() + STOP_TIMEOUT;
            while news.recv_deadline(until).is_ok() {}
            end
        })
    }
}

impl CameraWatch<'_> {
    /// Makes pictures from frames until the reader ends or a stop is requested.
    fn follow(&mut self, news: &Receiver<News>) -> Result<(), Disconnected> {
        let mut last = Instant::now();
        while !self.link.stopped() {
            match news.recv_timeout(LOOK) {
                Ok(News::Opened) => last = Instant::now(),
                Ok(News::Ended(why)) => return Err(why),
                Ok(News::Disobeyed(why)) => self.no_light(&why),
                Ok(News::Frame(frame, at)) => {
                    if self.frame(&frame, at) {
                        last = Instant::now();
                        self.link.state(DeviceState::Streaming, "");
                    }
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => {
                    let why = "the thread that reads it has ended";
                    return Err(Disconnected::Lost(why.into()));
                }
            }
            if last.elapsed() > STALLED {
                let why =
                    "no usable frame arrives; if this persists, unplug it and plug it in again";
                self.link.state(DeviceState::Stalled, why);
            }
        }
        Ok(())
    }

    /// Makes a picture from a frame if one is due. Returns false if the frame is damaged.
    fn frame(&mut self, frame: &Frame, at: Instant) -> bool {
        let Camera { flash, settle, shutter, every, .. } = &*self.camera;
        let wanted = || flash.is_some() && shutter.take();
        let (light, switch) = self.phase.judge(at, *settle, wanted);
        let due = self.pushed.is_none_or(|pushed| at >= pushed + *every);
        let sink = match light {
            FrameLight::Plain if due => Some(0),
            FrameLight::Flash => Some(1),
            FrameLight::Plain | FrameLight::Between => None,
        };
        let good = sink.is_none_or(|index| self.picture(frame, index));
        match sink {
            Some(0) if good => self.pushed = Some(at),
            // Requests another picture with flash, since this one's frame was damaged.
            Some(1) if !good => self.camera.shutter.flash(),
            _ => {}
        }
        if let Some(on) = switch {
            self.switch(on);
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
        let upright = self.camera.turn.turn(rgb);
        let Some(picture) = compared(&upright) else { return false };
        if index == 0 {
            self.camera.viewfinder.show(upright);
        }
        if let Some(sink) = self.sinks.get_mut(index).and_then(Sink::images) {
            sink.push(&[Arc::new(picture)]);
        }
        true
    }

    fn damaged(&mut self, error: &str) {
        self.damaged += 1;
        if self.summed_up.is_none_or(|at| at.elapsed() >= SUM_UP) {
            let frames = counted(self.damaged, "damaged frame");
            let text = format!("{frames}; the last: {error}");
            self.link.warn(WarningKind::Damaged, text);
            (self.damaged, self.summed_up) = (0, Some(Instant::now()));
        }
    }

    fn switch(&mut self, on: bool) {
        let switched = match &self.camera.flash {
            None => Ok(()),
            Some((_, Flash::Stylus(light))) => light.switch(on),
            Some((_, Flash::Camera)) => {
                self.torch.store(on, Ordering::Release);
                Ok(())
            }
        };
        match switched {
            Ok(()) => {
                self.camera.viewfinder.light(if on { FlashState::On } else { FlashState::Off })
            }
            Err(why) => self.no_light(&why),
        }
    }

    fn no_light(&mut self, why: &str) {
        // The next frames count as taken without light.
        self.phase = FlashPhase::Off;
        self.camera.viewfinder.light(FlashState::Failed);
        self.link.warn(WarningKind::Light, format!("the flash cannot be switched: {why}"));
    }
}

/// A camera that can be opened any number of times.
pub trait Video: Send + Sync {
    /// Opens the camera and starts its stream. Runs on the reader's thread.
    fn open(&self) -> Result<Box<dyn Frames>, OpenError>;
}

/// An open camera that delivers frames. Its errors are messages for users.
pub trait Frames {
    /// Waits for the next frame, without a time limit. Fails if no more frames will come.
    fn next(&mut self) -> Result<Frame, String>;

    /// Switches the camera's own light. Fails if the camera has none.
    fn torch(&mut self, on: bool) -> Result<(), String>;
}

enum News {
    Opened,
    Frame(Frame, Instant),
    Disobeyed(String),
    Ended(Disconnected),
}

/// Starts the reader thread. It drops a frame that is not taken at once, since a newer one follows.
fn start_reader(
    video: Arc<dyn Video>,
    stop: Stop,
    torch: Arc<AtomicBool>,
) -> Result<Receiver<News>, OpenError> {
    let (send, news) = crossbeam_channel::bounded(1);
    std::thread::Builder::new()
        .name("camera-read".into())
        .spawn(move || {
            let last = match video.open() {
                Ok(frames) => read(frames, &stop, &torch, &send),
                Err(error) => Some(News::Ended(error.into())),
            };
            if let Some(last) = last {
                let _ = send.send(last);
            }
        })
        .map_err(|error| {
            OpenError::Unfit(format!("cannot start a thread to read the camera: {error}"))
        })?;
    Ok(news)
}

/// Reads frames until the camera ends or a stop; returns the last message to send, if any.
fn read(
    mut frames: Box<dyn Frames>,
    stop: &Stop,
    torch: &AtomicBool,
    send: &Sender<News>,
) -> Option<News> {
    send.send(News::Opened).ok()?;
    let mut lit = false;
    loop {
        // The light comes first, even after a request to stop, which also switches the light off.
        let on = torch.load(Ordering::Acquire);
        if on != lit {
            match frames.torch(on) {
                Ok(()) => lit = on,
                Err(why) => {
                    torch.store(lit, Ordering::Release);
                    let _ = send.send(News::Disobeyed(why));
                }
            }
        }
        if stop.requested() {
            return None;
        }
        match frames.next() {
            Ok(frame) => drop(send.try_send(News::Frame(frame, Instant::now()))),
            Err(why) => return Some(News::Ended(Disconnected::Lost(why))),
        }
    }
}

pub enum Flash {
    /// The stylus switches its light.
    Stylus(Light),
    /// The camera switches its own light, by its control V4L2_CID_FLASH_LED_MODE (video for Linux).
    Camera,
}

/// A button that requests pictures with flash. All clones belong to the same camera.
#[derive(Clone, Debug, Default)]
pub struct Shutter(Arc<AtomicBool>);

impl Shutter {
    /// Requests a picture with flash. Further requests before it is taken change nothing.
    pub fn flash(&self) {
        self.0.store(true, Ordering::Release);
    }

    fn take(&self) -> bool {
        self.0.swap(false, Ordering::AcqRel)
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum FrameLight {
    Plain,
    Flash,
    /// A frame taken while the light was changing, which is useless.
    Between,
}

enum FlashPhase {
    Off,
    Rising(Instant),
    Falling(Instant),
}

impl FlashPhase {
    /// Judges the light of a frame that arrived at `now`. Also returns whether to switch the light
    /// on or off now (`None`: leave it). `wanted` tells whether a picture with flash is requested.
    fn judge(
        &mut self,
        now: Instant,
        settle: Duration,
        wanted: impl FnOnce() -> bool,
    ) -> (FrameLight, Option<bool>) {
        let settled = |since: Instant| now.saturating_duration_since(since) >= settle;
        match *self {
            Self::Rising(since) if settled(since) => {
                *self = Self::Falling(now);
                (FrameLight::Flash, Some(false))
            }
            Self::Falling(since) if settled(since) => {
                *self = Self::Off;
                (FrameLight::Plain, None)
            }
            Self::Rising(_) | Self::Falling(_) => (FrameLight::Between, None),
            Self::Off if wanted() => {
                *self = Self::Rising(now);
                (FrameLight::Plain, Some(true))
            }
            Self::Off => (FrameLight::Plain, None),
        }
    }
}

#[cfg(test)]
mod tests;
