//! Builds and starts a station.

use std::sync::Arc;

use crossbeam_channel::{Receiver, Sender};

use super::event::{Command, Listener, StationEvent};
use super::orders::Keep;
use super::recogniser::{Load, Recogniser};
use super::run::{Parts, StationRun};
use super::store::{RecordingThread, ScanStore};
use super::worker::Worker;
use crate::device::Device;
use crate::scan::{Options, Session, SessionError, Totals};

/// The parts of a station.
pub struct Station<'a> {
    devices: Vec<Box<dyn Device>>,
    options: Options,
    recogniser: Option<Arc<Recogniser>>,
    load: Option<Load>,
    store: Option<ScanStore>,
    keep: Option<Keep>,
    listeners: Vec<Box<dyn Listener + 'a>>,
    commands: (Sender<Command>, Receiver<Command>),
}

impl<'a> Station<'a> {
    /// A station that knows no library yet.
    pub fn new(devices: Vec<Box<dyn Device>>, options: Options) -> Self {
        Self {
            devices,
            options,
            recogniser: None,
            load: None,
            store: None,
            keep: None,
            listeners: Vec::new(),
            commands: crossbeam_channel::unbounded(),
        }
    }

    /// Sets the recogniser that names scans from the start.
    pub fn recogniser(mut self, recogniser: Arc<Recogniser>) -> Self {
        self.recogniser = Some(recogniser);
        self
    }

    /// Sets the function that reads the library: at the start, unless there is a recogniser
    /// already, and at each [`Command::Reload`].
    pub fn load(mut self, load: Load) -> Self {
        self.load = Some(load);
        self
    }

    /// Keeps the scans that are enrolled in this library.
    pub fn store(mut self, store: ScanStore) -> Self {
        self.store = Some(store);
        self
    }

    /// Keeps scans from the first one on, whenever no [`Command::Enroll`] is in force. Needs a
    /// [`store`](Self::store).
    pub fn keep(mut self, keep: Keep) -> Self {
        self.keep = Some(keep);
        self
    }

    /// Adds a listener, which gets every event.
    pub fn listener(mut self, listener: impl Listener + 'a) -> Self {
        self.listeners.push(Box::new(listener));
        self
    }

    /// Reports progress within scans this often, in seconds of drag.
    pub fn progress_every(mut self, seconds: f64) -> Self {
        self.options.progress_every_s = Some(seconds);
        self
    }

    /// Sends an event to the listeners added so far, before the station runs.
    pub fn emit(&mut self, event: &StationEvent) {
        self.listeners.iter_mut().for_each(|listener| listener.on_event(event));
    }

    /// The sender of commands, valid before the station runs and while it does.
    pub fn commands(&self) -> Sender<Command> {
        self.commands.0.clone()
    }

    /// Runs until all devices have ended, or [`Command::Quit`].
    ///
    /// # Errors
    /// If two streams have one name, an option is impossible, or a thread cannot be started. A
    /// device that fails is no error here: [`Totals`] names it.
    pub fn run(self) -> Result<Totals, SessionError> {
        let thread = |name: &str| {
            let name = name.to_string();
            move |error| SessionError::Thread { name, error }
        };
        let waits = self.devices.iter().all(|device| device.waits());
        let worker = Worker::start(waits).map_err(thread("recognition"))?;
        let by_t_star = self.store.as_ref().map_or_else(Vec::new, |store| store.by_t_star.clone());
        let recording = match self.store {
            Some(store) => Some(RecordingThread::start(store).map_err(thread("recording"))?),
            None => None,
        };
        let session = Session::start(self.devices, self.options)?;
        let (load, keep) = (self.load, self.keep);
        let parts = Parts { session, worker, recording, by_t_star, waits, load, keep };
        let mut run = StationRun::new(parts, self.listeners);
        run.announce();
        match self.recogniser {
            Some(recogniser) => run.loaded(Ok(recogniser)),
            None if run.can_load() => run.reload(),
            None => {}
        }
        // The channel stays open, since `self.commands` also holds a sender.
        run.until_finished(&self.commands.1);
        run.finish()
    }
}
