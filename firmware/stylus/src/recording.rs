//! In emulation only: samples of a recording, read by semihosting, replace the converter's.
//!
//! QEMU's arguments: `arg=stylus,arg=FILE[,arg=exit]`. FILE holds little-endian i16, 7 per sample.
//! Sampling stops at the end of FILE; with `exit`, the emulation ends once all is sent.

use core::sync::atomic::{AtomicBool, Ordering};

use cortex_m_semihosting::{debug, hprintln, nr, syscall, syscall1};
use surfaced_stylus_core::{ByteRing, Sample, SampleRing, Sampling, Stylus};
use surfaced_wire::STYLUS_CHANNELS;

/// Samples that were read from the file but not sampled yet.
static READ: SampleRing<ROOM> = SampleRing::new();
/// Whether the whole file was read.
static ENDED: AtomicBool = AtomicBool::new(false);

const ROOM: usize = 1024;
const BLOCK: usize = 256;

/// Whether the next sample is there, and room for it.
pub fn is_ready() -> bool {
    crate::SAMPLING.has_room() && (READ.free() < ROOM || ENDED.load(Ordering::Relaxed))
}

/// The recording's next sample; called by the sampling interrupt.
pub fn next() -> Option<[i16; STYLUS_CHANNELS]> {
    let sample = READ.pop()?;
    if READ.free() == ROOM && ENDED.load(Ordering::Relaxed) {
        // This was the last sample, so the ticks that follow are no overruns.
        crate::SAMPLING.stop();
    }
    Some(sample.values)
}

/// Keeps the recording's ring filled and notices its end.
pub struct Feed {
    file: usize,
    exit: bool,
    reported: bool,
    printed: bool,
}

impl Feed {
    /// Opens the file named on QEMU's command line; without a file, there is nothing to sample.
    pub fn open() -> Self {
        let mut line = [0u8; 1024];
        let mut block = [line.as_mut_ptr() as usize, line.len()];
        // SAFETY: SYS_GET_CMDLINE writes at most the given length, and stores the actual length.
        let failed = unsafe { syscall1(nr::GET_CMDLINE, block.as_mut_ptr() as usize) };
        let len = if failed == 0 { block[1].min(line.len() - 1) } else { 0 };
        // The words are the program's name, the file and "exit". A file's name must hold no space.
        let word = |from: usize| {
            let len = line[from..len].iter().position(|b| matches!(b, b' ' | 0));
            len.map_or(1023, |n| from + n)
        };
        let start = word(0).min(1022) + 1;
        let end = word(start.min(len)).min(len.max(start));
        let exit = line[end..].starts_with(b" exit");
        line[end] = 0; // the call wants a zero at the end
        // SAFETY: SYS_OPEN reads a path of the given length; mode 1 is "rb".
        let file = unsafe { syscall!(OPEN, line.as_ptr().wrapping_add(start), 1, end - start) };
        let mut feed = Self { file, exit, reported: false, printed: false };
        if end == start || file == usize::MAX {
            hprintln!("no recording");
            ENDED.store(true, Ordering::Relaxed);
            feed.printed = true;
        }
        feed.refill();
        feed
    }

    /// One round of the main loop, after [`Stylus::poll`], which returned `idle`.
    pub fn attend<const T: usize>(
        &mut self,
        stylus: &mut Stylus<'_>,
        idle: bool,
        sampling: &Sampling,
        line: &ByteRing<T>,
    ) {
        self.refill();
        let ended = ENDED.load(Ordering::Relaxed) && READ.free() == ROOM && !sampling.is_on();
        if self.printed || !ended {
            return;
        }
        if !self.reported {
            // The next poll sends the remaining samples and then this status.
            self.reported = true;
            stylus.report();
        } else if idle && line.free() == T {
            self.printed = true;
            hprintln!(
                "frames_sent={} messages_sent={} overruns={} dropped={}",
                stylus.samples_sent(),
                stylus.frames_sent(),
                sampling.overruns(),
                sampling.dropped()
            );
            if self.exit {
                debug::exit(debug::EXIT_SUCCESS);
            }
        }
    }

    fn refill(&mut self) {
        while READ.free() >= BLOCK && !ENDED.load(Ordering::Relaxed) {
            let mut bytes = [0u8; BLOCK * 2 * STYLUS_CHANNELS];
            // SAFETY: SYS_READ writes at most the given length, and returns the length not written.
            let rest = unsafe { syscall!(READ, self.file, bytes.as_mut_ptr(), bytes.len()) };
            let len = bytes.len().saturating_sub(rest);
            for sample in bytes[..len].as_chunks::<{ 2 * STYLUS_CHANNELS }>().0 {
                let pairs = sample.as_chunks::<2>().0;
                let values = core::array::from_fn(|c| i16::from_le_bytes(pairs[c]));
                READ.push(Sample { tick: 0, values }); // there is room for a block
            }
            if len < bytes.len() {
                ENDED.store(true, Ordering::Relaxed);
            }
        }
    }
}
