//! The library of a station: read at the start and on command, beside the loop.

use super::{LoadedRecogniser, Naming, StationRun};
use crate::station::event::StationEvent;
use crate::station::library_state::LibraryState;

impl StationRun<'_> {
    /// Whether there is a library to read.
    pub fn can_load(&self) -> bool {
        self.load.is_some()
    }

    /// Names scans with what was read from now on, if it could be read.
    pub fn loaded(&mut self, loaded: LoadedRecogniser) {
        match loaded {
            Ok(recogniser) => {
                self.emit(StationEvent::Library(recogniser.library()));
                self.naming = Naming::Ready(recogniser);
            }
            Err(problem) => {
                // The library that was read before stays in use.
                let mut state = match &self.naming {
                    Naming::Ready(recogniser) => recogniser.library(),
                    _ => {
                        self.naming = Naming::None(problem.clone());
                        LibraryState::default()
                    }
                };
                state.problem = Some(problem.clone());
                self.emit(StationEvent::Library(state));
                self.warn(problem);
            }
        }
    }

    /// Reads the library; meanwhile the one before stays in use, or scans wait.
    pub fn reload(&mut self) {
        let Some(load) = self.load.clone() else {
            return self.warn("there is no library to read again");
        };
        // One at a time: each takes a thread and the memory of a library.
        if self.loading.is_some() {
            self.load_again = true;
            return;
        }
        if !matches!(self.naming, Naming::Ready(_)) {
            self.naming = Naming::Loading;
        }
        self.emit(StationEvent::Reading);
        let (send, loaded) = crossbeam_channel::bounded(1);
        let work = move || {
            let _ = send.send(load());
        };
        match std::thread::Builder::new().name("load-library".into()).spawn(work) {
            Ok(_) => self.loading = Some(loaded),
            Err(error) => self.loaded(Err(format!("no thread to read the library: {error}"))),
        }
    }
}
