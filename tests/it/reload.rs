//! Commands to read the library again, faster than it can be read.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use crate::common::id;
use surfaced::device::{Device, DeviceError, DeviceLink, StreamKind, StreamSpec};
use surfaced::ring::Sink;
use surfaced::scan::Options;
use surfaced::station::{Command, Listener, Station, StationEvent};

/// A stylus that rests until the end.
struct AtRest;

impl Device for AtRest {
    fn name(&self) -> &str {
        "stylus"
    }

    fn streams(&self) -> Vec<StreamSpec> {
        let kind = StreamKind::Series { channels: 3, rate_hz: 10_000.0 };
        vec![StreamSpec { id: id("ac"), kind }]
    }

    fn run(&mut self, _: &mut [Sink], control: &DeviceLink) -> Result<(), DeviceError> {
        while !control.stopped() {
            std::thread::sleep(Duration::from_millis(5));
        }
        Ok(())
    }
}

/// Calls a function whenever a library has been read.
struct OnLibrary<F>(F);

impl<F: FnMut()> Listener for OnLibrary<F> {
    fn on_event(&mut self, event: &StationEvent) {
        if matches!(event, StationEvent::Library(_)) {
            (self.0)();
        }
    }
}

#[test]
fn a_storm_of_reloads_reads_once_at_a_time_and_once_more_at_its_end() {
    let (reading, most, reads) = (
        Arc::new(AtomicUsize::new(0)),
        Arc::new(AtomicUsize::new(0)),
        Arc::new(AtomicUsize::new(0)),
    );
    let (send_go, go) = crossbeam_channel::bounded::<()>(0);
    let load = {
        let (reading, most, reads) = (reading.clone(), most.clone(), reads.clone());
        move || {
            most.fetch_max(reading.fetch_add(1, Ordering::SeqCst) + 1, Ordering::SeqCst);
            reads.fetch_add(1, Ordering::SeqCst);
            let _ = go.recv();
            reading.fetch_sub(1, Ordering::SeqCst);
            Err("no library".to_string())
        }
    };
    let mut station = Station::new(vec![Box::new(AtRest)], Options::default());
    station.load = Some(Arc::new(load));
    let commands = station.commands();
    let quit = station.commands();
    let mut libraries = 0;
    let station = station.listener(OnLibrary(move || {
        libraries += 1;
        if libraries == 2 {
            let _ = quit.send(Command::Quit);
        }
    }));
    (0..150).for_each(|_| commands.send(Command::Reload).unwrap());
    let begun = reads.clone();
    let release = std::thread::spawn(move || {
        // The first reading lasts until the station has taken all commands.
        while begun.load(Ordering::SeqCst) == 0 || !commands.is_empty() {
            std::thread::sleep(Duration::from_millis(5));
        }
        // Until the station, and with it the reader of the library, is gone.
        while send_go.send(()).is_ok() {}
    });
    station.run().unwrap();
    release.join().unwrap();
    assert_eq!(most.load(Ordering::SeqCst), 1, "readings at one time");
    let reads = reads.load(Ordering::SeqCst);
    assert!((2..=3).contains(&reads), "{reads} readings for 150 commands");
}
