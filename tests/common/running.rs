//! A device on its own thread, and what it reports.

#![allow(dead_code)] // Not every test uses all of it.

use std::time::{Duration, Instant};

use surfaced::device::{Device, DeviceError, DeviceLink, DeviceReport, DeviceReportKind};
use surfaced::ring::{Sink, Stop};

/// A device that runs on its own thread.
pub struct Running {
    pub reports: crossbeam_channel::Receiver<DeviceReport>,
    pub begin: Instant,
    stop: Stop,
    thread: std::thread::JoinHandle<Result<(), DeviceError>>,
}

impl Running {
    pub fn start(mut device: impl Device + 'static, mut sinks: Vec<Sink>) -> Self {
        let (sender, reports) = crossbeam_channel::unbounded();
        let stop = Stop::default();
        let link = DeviceLink::new(0, stop.clone(), sender);
        let thread = std::thread::spawn(move || device.run(&mut sinks, &link));
        Self { reports, begin: Instant::now(), stop, thread }
    }

    /// The next state, with its reason, or the next warning.
    fn next(&self) -> String {
        match self.reports.recv_timeout(Duration::from_secs(120)).unwrap().kind {
            DeviceReportKind::State { state, detail } => format!("{state}: {detail}"),
            DeviceReportKind::Warning(warning) => warning.text,
            other => panic!("{other:?}"),
        }
    }

    /// Expects reports that hold these texts, with no other report in between.
    #[track_caller]
    pub fn says(&self, parts: &[&str]) {
        for part in parts {
            let said = self.next();
            assert!(said.contains(part), "expected `{part}`: {said}");
        }
    }

    /// Waits for a report that holds this text.
    pub fn comes_to_say(&self, part: &str) {
        while !self.next().contains(part) {}
    }

    pub fn end(self) {
        self.stop.request();
        self.ended().unwrap();
    }

    /// Waits until the device ends by itself, and returns its result.
    pub fn ended(self) -> Result<(), DeviceError> {
        self.thread.join().unwrap()
    }
}
