//! The thread that reads a camera, and may hang in doing so.

use std::sync::Arc;
use std::time::Instant;

use crossbeam_channel::{Receiver, Sender};

use super::Frame;
use crate::device::DeviceError;
use crate::device::open::OpenError;
use crate::ring::Stop;

/// A camera that can be opened, again and again.
pub trait Video: Send + Sync {
    /// For people: the camera that it opens.
    fn device(&self) -> String;

    /// Opens the camera, and starts its stream. Called on the thread that reads.
    ///
    /// # Errors
    /// If it cannot be opened.
    fn open(&self) -> Result<Box<dyn Frames>, OpenError>;
}

/// The frames of an open camera.
pub trait Frames {
    /// The next frame; waits for it, for ever if need be.
    ///
    /// # Errors
    /// If there will be no more: why, for people.
    fn next(&mut self) -> Result<Frame, String>;

    /// Sets a control of the camera.
    ///
    /// # Errors
    /// If it has no such control, or refuses the value: why, for people.
    fn control(&mut self, id: u32, value: i64) -> Result<(), String>;
}

/// News from the reader.
pub(super) enum News {
    Opened,
    Failed(OpenError),
    /// A frame, and when it came.
    Frame(Frame, Instant),
    Obeyed(Result<(), String>),
    Ended(String),
}

/// A control to be set.
pub(super) struct ControlRequest {
    pub control: u32,
    pub value: i64,
}

/// Starts to read. Frames that cannot be taken at once are dropped: the next one is fresher.
pub(super) fn start(
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
        .map_err(|error| DeviceError::Failed(format!("no thread to read the camera: {error}")))?;
    Ok((orders, news))
}

/// Reads until the end, and gives the last news; none if there is no receiver any more.
fn read(
    mut frames: Box<dyn Frames>,
    stop: &Stop,
    ordered: &Receiver<ControlRequest>,
    send: &Sender<News>,
) -> Option<News> {
    send.send(News::Opened).ok()?;
    loop {
        // Orders come first, and also after a request to stop: the last one puts out the light.
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
