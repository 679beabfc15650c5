//! Builds and starts a station.

use std::sync::Arc;

use crossbeam_channel::{Receiver, Sender};

use super::event::{Command, Listener, StationEvent};
use super::orders::Keep;
use super::recogniser::{Load, Recogniser};
use super::store::ScanStore;
use crate::device::Device;
use crate::scan::Options;

pub struct Station<'a> {
    pub(super) devices: Vec<Box<dyn Device>>,
    /// Options of the session.
    pub options: Options,
    pub(super) recogniser: Option<Arc<Recogniser>>,
    pub(super) load: Option<Load>,
    pub(super) store: Option<ScanStore>,
    pub(super) keep: Option<Keep>,
    pub(super) listeners: Vec<Box<dyn Listener + 'a>>,
    pub(super) commands: (Sender<Command>, Receiver<Command>),
}

impl<'a> Station<'a> {
    /// Creates a station without a library.
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

    pub fn recogniser(mut self, recogniser: Arc<Recogniser>) -> Self {
        self.recogniser = Some(recogniser);
        self
    }

    /// Sets the function that reads the library. It runs at each [`Command::Reload`], and at the
    /// start unless a recogniser was given.
    pub fn load(mut self, load: Load) -> Self {
        self.load = Some(load);
        self
    }

    pub fn store(mut self, store: ScanStore) -> Self {
        self.store = Some(store);
        self
    }

    /// Keeps every scan as a trial while no [`Command::Enroll`] is in force. Needs a
    /// [`store`](Self::store).
    pub fn keep(mut self, keep: Keep) -> Self {
        self.keep = Some(keep);
        self
    }

    pub fn listener(mut self, listener: impl Listener + 'a) -> Self {
        self.listeners.push(Box::new(listener));
        self
    }

    /// Sends an event to all listeners added so far. It is meant for the time before the station runs.
    pub fn emit(&mut self, event: &StationEvent) {
        self.listeners.iter_mut().for_each(|listener| listener.on_event(event));
    }

    /// The sender of commands. It may be used before the station runs and while it runs.
    pub fn commands(&self) -> Sender<Command> {
        self.commands.0.clone()
    }
}
