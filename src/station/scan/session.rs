//! Runs devices and their collector, each on its own thread, and stops them.

use std::any::Any;
use std::collections::{BTreeSet, VecDeque};
use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread::JoinHandle;

use crossbeam_channel::{Receiver, Sender};

use super::collect::Collector;
use super::event_queue::EventQueue;
use super::recent_frames::Stream;
use super::scan_detector::ScanDetector;
use super::{Event, Options, ScanCommand, Totals};
use crate::device::{Device, DeviceError, DeviceLink};
use crate::ring::{Counts, Meter, Sink, Stop, Waker};
use crate::scene::SourceId;

/// Capacity of the queue of reports; a device whose report does not fit has to wait.
const REPORTS: usize = 1024;

#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    #[error("two devices have a stream called {0}; rename one of them in the configuration")]
    SameStream(SourceId),
    #[error("{what} = {value}; expected a positive number of seconds")]
    Seconds { what: &'static str, value: f64 },
    #[error("cannot start the thread {name}: {error}")]
    Thread { name: String, error: std::io::Error },
    #[error("the collector panicked: {0}; please report this")]
    Collector(String),
}

/// The numbers of pushed and lost frames of one stream, readable at any time.
#[derive(Clone, Debug)]
pub struct StreamMeter {
    pub id: SourceId,
    pub device: String,
    meter: Arc<Meter>,
}

impl StreamMeter {
    pub fn counts(&self) -> Counts {
        self.meter.counts()
    }
}

/// Running devices and their collector. Dropping the session asks them to stop, and does not wait.
#[derive(Debug)]
pub struct Session {
    /// The events; the last is [`Event::Finished`]. All clones of the receiver draw from one queue.
    pub events: Receiver<Event>,
    commands: Sender<ScanCommand>,
    stop: Stop,
    waker: Waker,
    begun: Arc<AtomicU32>,
    pub meters: Vec<StreamMeter>,
    devices: Vec<(String, JoinHandle<()>)>,
    collector: Option<JoinHandle<Totals>>,
}

impl Session {
    /// Starts the devices and their collector.
    ///
    /// # Errors
    /// If two streams have the same name, an option is not a positive time, or a thread cannot be
    /// started. A device that fails is no error here, since an event reports it.
    pub fn start(devices: Vec<Box<dyn Device>>, options: Options) -> Result<Self, SessionError> {
        check(&options)?;
        let stop = Stop::default();
        let (waker, woken) = Waker::new();
        let (report, reports) = crossbeam_channel::bounded(REPORTS);
        let (send, events) = crossbeam_channel::bounded(options.events.max(1));
        let (commands, cued) = crossbeam_channel::unbounded();
        let waits = devices.iter().all(|device| device.waits());
        let event_queue = EventQueue::new(send, stop.clone(), waits);
        let (mut streams, mut meters, mut names) = (Vec::new(), Vec::new(), BTreeSet::new());
        let mut ready = Vec::new();
        for (number, device) in devices.into_iter().enumerate() {
            let mut sinks = Vec::new();
            for spec in device.streams() {
                if !names.insert(spec.id.clone()) {
                    return Err(SessionError::SameStream(spec.id));
                }
                let (sink, stream) = Stream::open(&spec, number, &options, waker.clone());
                let (device, meter) = (device.name().to_string(), stream.meter().clone());
                meters.push(StreamMeter { id: spec.id, device, meter });
                sinks.push(sink);
                streams.push(stream);
            }
            ready.push((device, sinks));
        }
        let names = ready.iter().map(|(device, _)| (device.name().to_string(), false)).collect();
        let detector = options
            .detection
            .clone()
            .map(|detection| ScanDetector::new(detection, &streams, options.longest_scan_s));
        let begun = Arc::<AtomicU32>::default();
        let collector = Collector {
            options,
            streams,
            reports,
            woken,
            stop: stop.clone(),
            event_queue,
            devices: names,
            scans: VecDeque::new(),
            begun: begun.clone(),
            detector,
            commands: cued,
        };
        let collector = spawn("collector", move || collector.run())?;
        let mut session = Self {
            events,
            commands,
            stop,
            waker,
            begun,
            meters,
            devices: vec![],
            collector: Some(collector),
        };
        for (index, (device, sinks)) in ready.into_iter().enumerate() {
            let name = device.name().to_string();
            let link = DeviceLink::new(index, session.stop.clone(), report.clone());
            // If a thread cannot be started, dropping the session stops those that run.
            let thread = spawn(&name, move || run(device, sinks, &link))?;
            session.devices.push((name, thread));
        }
        Ok(session)
    }

    pub fn next_scan(&self) -> u32 {
        self.begun.load(Ordering::Acquire).saturating_add(1)
    }

    pub fn command(&self, command: ScanCommand) {
        // Sending fails only if the session has ended, and then there is no scan to command.
        let _ = self.commands.send(command);
        self.waker.wake();
    }

    /// Asks all devices to end, without waiting; events go on until [`Event::Finished`].
    pub fn request_stop(&self) {
        self.stop.request();
        self.waker.wake();
    }

    /// Waits until all devices and the collector have ended; drops events that were not read. If a
    /// device does not end soon after a stop, it is abandoned and named in the totals.
    ///
    /// # Errors
    /// If the collector panicked.
    pub fn wait(mut self) -> Result<Totals, SessionError> {
        let Some(collector) = self.collector.take() else { return Ok(Totals::default()) };
        // Reads until the collector ends, so that it never waits for a reader.
        while self.events.recv().is_ok() {}
        let totals =
            collector.join().map_err(|panic| SessionError::Collector(what(panic.as_ref())))?;
        for (name, thread) in self.devices.drain(..) {
            if !totals.abandoned.contains(&name) {
                // A panic was caught and reported before the thread ended, so this result is ignored.
                let _ = thread.join();
            }
        }
        Ok(totals)
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        self.request_stop();
    }
}

fn check(options: &Options) -> Result<(), SessionError> {
    let seconds = [
        ("ring_s", Some(options.ring_s)),
        ("progress_every_s", options.progress_every_s),
        ("trace_every_s", options.trace_every_s),
        ("longest_scan_s", Some(options.longest_scan_s)),
    ];
    for (what, value) in seconds {
        if let Some(value) = value.filter(|x| !(x.is_finite() && *x > 0.0)) {
            return Err(SessionError::Seconds { what, value });
        }
    }
    Ok(())
}

fn spawn<T: Send + 'static>(
    name: &str,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<JoinHandle<T>, SessionError> {
    // Leaves NUL out, since a thread's name must not hold it.
    let builder = std::thread::Builder::new().name(name.replace('\0', ""));
    builder.spawn(work).map_err(|error| SessionError::Thread { name: name.into(), error })
}

fn run(mut device: Box<dyn Device>, mut sinks: Vec<Sink>, link: &DeviceLink) {
    let ran = std::panic::catch_unwind(AssertUnwindSafe(|| device.run(&mut sinks, link)));
    let result = ran.unwrap_or_else(|panic| {
        let problem = format!("it panicked: {}; please report this", what(panic.as_ref()));
        Err(DeviceError::Failed(problem))
    });
    // The streams are closed before the end is reported, so that the report comes after all data.
    drop(sinks);
    link.ended(result);
}

fn what(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_string());
    text.or_else(|| panic.downcast_ref::<String>().cloned())
        .unwrap_or_else(|| "for an unknown reason".into())
}
