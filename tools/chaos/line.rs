//! The emulated stylus and its serial line, and counts of the samples that it sent.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use crate::Failure;
use crate::dice::Dice;
use crate::disk::Disk;
use crate::scripted::{Noise, Sample, scan};
use crate::stylus::Fake;

/// Most samples on their way, which may be lost unnoticed when a line breaks.
const TAIL: u64 = 4000;
/// Number of samples in a frame.
const FRAME: u64 = 32;

/// The samples that the stylus repeats: a scan of each surface.
pub struct Tape(Arc<Vec<Sample>>);

impl Tape {
    pub fn new(disk: &Disk) -> Result<Self, Failure> {
        let mut samples = Vec::new();
        for entry in disk.data.entries.iter().filter(|entry| entry.key.number == 4) {
            samples.extend(scan(&entry.load()?, 1.0, &mut Noise(1)));
        }
        Ok(Self(Arc::new(samples)))
    }
}

/// A stylus that can be unplugged and plugged in again.
pub struct Line<'a> {
    link: PathBuf,
    tape: &'a Tape,
    fake: Fake,
    /// Number of samples that were put on the line.
    put: Arc<AtomicU64>,
    /// Number of samples that were taken but not put on the line.
    skipped: u64,
    /// Number of samples of which nobody can know whether they were lost.
    pub unknowable: u64,
    /// Number of samples in the last loss, and number of samples put on the line before it.
    lost: (u64, u64),
}

impl<'a> Line<'a> {
    pub fn new(dir: &Path, tape: &'a Tape) -> Self {
        let link = dir.join("stylus");
        let put = Arc::default();
        let fake = plug(&link, tape, &put);
        Self { link, tape, fake, put, skipped: 0, unknowable: 0, lost: (0, 0) }
    }

    /// Number of samples taken so far, sent or not.
    pub fn sent(&self) -> u64 {
        self.put.load(Ordering::Relaxed) + self.skipped
    }

    /// Number of lost samples that no sample follows, so that the station cannot notice the loss.
    pub fn lost_at_the_end(&self) -> u64 {
        let (count, put) = self.lost;
        if put == self.put.load(Ordering::Relaxed) { count } else { 0 }
    }

    pub fn serve(&mut self, seconds: f64) {
        self.fake.serve(seconds);
    }

    pub fn obey(&mut self) {
        self.fake.obey();
    }

    /// Waits until the station starts the stylus; false if that does not happen in 15 s.
    pub fn is_started(&mut self) -> bool {
        let begin = Instant::now();
        while self.fake.next.is_none() {
            self.fake.obey();
            if begin.elapsed() > Duration::from_secs(15) {
                return false;
            }
        }
        true
    }

    /// Stalls the line: samples wait in the stylus, and come late.
    pub fn stall(&mut self, dice: &mut Dice) {
        std::thread::sleep(Duration::from_secs_f64(dice.between(0.05, 1.5)));
    }

    /// Loses some frames, which never arrive.
    pub fn lose(&mut self, dice: &mut Dice) {
        if let Some(next) = self.fake.next {
            let count = FRAME * (1 + dice.below(200));
            self.fake.next = Some(next + count);
            self.lost = (self.lost_at_the_end() + count, self.put.load(Ordering::Relaxed));
            self.skipped += count;
        }
    }

    /// Puts bytes on the line that the stylus did not send; they may hit a frame.
    pub fn garbage(&mut self, dice: &mut Dice) {
        let count = 1 + dice.below(4000) as usize;
        self.fake.put(&dice.bytes(count));
        self.unknowable += 2 * FRAME;
    }

    /// Lets the stylus introduce itself over and over.
    pub fn hellos(&mut self, dice: &mut Dice) {
        (0..1 + dice.below(30)).for_each(|_| self.fake.hello());
    }

    /// Unplugs the stylus, and plugs it in again later.
    pub fn replug(&mut self, dice: &mut Dice) {
        self.unknowable += TAIL;
        self.fake.next = None;
        let _ = std::fs::remove_file(&self.link);
        std::thread::sleep(Duration::from_secs_f64(dice.between(0.0, 1.0)));
        // Replacing the old stylus unplugs it.
        self.fake = plug(&self.link, self.tape, &self.put);
    }

    /// Cuts the stylus's power for a moment; it does not sample until it is started again.
    pub fn restart(&mut self) {
        self.unknowable += TAIL;
        self.fake.next = None;
    }
}

fn plug(link: &Path, tape: &Tape, put: &Arc<AtomicU64>) -> Fake {
    let (tape, put) = (tape.0.clone(), put.clone());
    let values = move |index: u64, channel: usize| {
        put.fetch_add(u64::from(channel == 0), Ordering::Relaxed);
        tape[index as usize % tape.len()][channel]
    };
    let mut fake = Fake::with(link, Box::new(values));
    fake.scales[6] = 1.0 / 32_767.0;
    fake
}
