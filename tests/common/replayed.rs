//! Trials that are played, and what a session reported of them.

use std::collections::BTreeMap;
use std::sync::Arc;

use surfaced::device::{Device, DeviceState, Replay};
use surfaced::library::Entry;
use surfaced::scan::{Event, Options, Progress, Scan, Session, Totals};
use surfaced::scene::{Scene, SourceId};
use surfaced::trial::{Image, Series, Signal, Trial, TrialKey};

use super::id;

/// A series, different for every `salt`.
pub fn series(rate_hz: f64, channels: usize, frames: usize, salt: u32) -> Signal {
    let sample = |i: u32| (i.wrapping_mul(2_654_435_761) ^ salt.wrapping_mul(97)) as f32 * 1e-9;
    let samples = (0..(frames * channels) as u32).map(sample).collect();
    Signal::Series(Series::new(rate_hz, channels, samples).unwrap())
}

/// A picture of one grey.
pub fn picture(value: u8) -> Signal {
    let rgb = vec![value; Image::ROWS * Image::COLS * 3];
    Signal::Image(Image::new(Image::COLS, Image::ROWS, rgb).unwrap())
}

/// A trial by the expert.
pub fn trial(number: u32, signals: Vec<(&str, Signal)>) -> Trial {
    let signals = signals.into_iter().map(|(name, signal)| (id(name), signal)).collect();
    Trial { key: TrialKey::new("slate", "expert", number), signals }
}

/// A trial with sources of every phase; `frames` of sound.
pub fn whole_trial(number: u32, frames: usize) -> Trial {
    trial(
        number,
        vec![
            ("ca1", picture(number as u8)),
            ("mi1", series(44_100.0, 1, frames / 3 + 1, number)),
            ("mi2", series(44_100.0, 1, frames, number)),
            ("ac", series(10_000.0, 3, frames / 4 + 1, number)),
            ("me", series(100.0, 1, 1 + frames / 400, number)),
        ],
    )
}

/// A device that plays trials.
pub fn replay(trials: &[Trial]) -> Replay {
    let entries = trials.iter().cloned().map(Entry::in_memory).collect();
    Replay::new(&Scene::lmt108(), entries)
}

/// Adds up the snapshots of a scan.
#[derive(Default)]
struct PartialScan {
    number: u32,
    series: BTreeMap<SourceId, (f64, usize, Vec<f32>)>,
    images: BTreeMap<SourceId, Arc<Image>>,
}

impl PartialScan {
    /// Adds a snapshot; one of another scan starts again.
    fn add(&mut self, progress: &Progress) {
        if self.number != progress.number {
            *self = Self { number: progress.number, ..Self::default() };
        }
        for fresh in &progress.fresh {
            let begin = || (fresh.rate_hz, fresh.channels, Vec::new());
            let (_, _, samples) = self.series.entry(fresh.source.clone()).or_insert_with(begin);
            samples.extend_from_slice(&fresh.samples);
        }
        self.images.extend(progress.images.iter().cloned());
    }

    /// The scan so far. Sources without usable data are left out.
    fn trial(&self) -> Trial {
        let series = self.series.iter().filter_map(|(id, (rate_hz, channels, samples))| {
            let series = Series::new(*rate_hz, *channels, samples.clone()).ok()?;
            Some((id.clone(), Signal::Series(series)))
        });
        let images = self.images.iter().map(|(id, image)| {
            let image = Arc::unwrap_or_clone(image.clone());
            (id.clone(), Signal::Image(image))
        });
        let key = TrialKey::new("", "", self.number);
        Trial { key, signals: series.chain(images).collect() }
    }
}

/// The reports of a session.
pub struct Reported {
    pub scans: Vec<Scan>,
    pub so_far: Vec<(u32, f64, Trial)>,
    pub warnings: Vec<String>,
    pub lost: Vec<String>,
    pub totals: Totals,
}

/// Runs a device to its end.
pub fn listen(device: impl Device + 'static, options: Options) -> Reported {
    let session = Session::start(vec![Box::new(device)], options).unwrap();
    let (mut sum, mut scans, mut so_far) = (PartialScan::default(), Vec::new(), Vec::new());
    let (mut warnings, mut lost) = (Vec::new(), Vec::new());
    let mut finished = false;
    for event in &session.events {
        assert!(!finished, "nothing follows the end");
        match event {
            Event::Scan(scan) => scans.push(*scan),
            Event::Progress(progress) => {
                sum.add(&progress);
                so_far.push((progress.number, progress.scan_s, sum.trial()));
            }
            Event::Warning(warning) => warnings.push(warning.text),
            Event::Device { state: DeviceState::Lost, detail, .. } => lost.push(detail),
            Event::Finished(_) => finished = true,
            Event::Device { .. } | Event::Phase { .. } | Event::Trace(_) => {}
        }
    }
    assert!(finished);
    Reported { scans, so_far, warnings, lost, totals: session.wait().unwrap() }
}

/// Whether scans hold the data of trials, and nothing else.
pub fn same_signals(scans: &[Scan], trials: &[Trial]) -> bool {
    scans.len() == trials.len()
        && scans.iter().zip(trials).all(|(scan, trial)| scan.trial.signals == trial.signals)
}
