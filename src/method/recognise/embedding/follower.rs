//! Follows a scan with a trained model, and renews the guess at each look (step of [`LOOK_S`]).
//!
//! The scan so far is kept as sums, and new samples are added to them. So a look costs the same at any
//! time of the scan. The vector equals that of a trial of the same samples. Scan time is counted in
//! samples, not read from a clock, so the answer depends neither on the block size in which samples
//! arrive nor on the playback speed.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use super::joint::{Present, SourceEmbedder, Stretch};
use super::model::{EmbeddingModel, Posterior};
use crate::features::counts::Counts;
use crate::features::frames::{LOOK_S, samples_by};
use crate::features::growing::Growing;
use crate::features::sources::SourceError;
use crate::features::tiles::PictureTiles;
use crate::features::views::SourceViews;
use crate::recognise::decide::conformal::Rejection;
use crate::recognise::decide::dead_sensor::left_out;
use crate::recognise::decide::settle::{FollowOptions, Look, Settling, Watch};
use crate::recognise::error::Result;
use crate::recognise::rank::Ranking;
use crate::scene::{Phase, SourceId};
use crate::trial::{Doubt, Image, SeriesFlaws, Signal, Trial, is_plain};

const NAMED: usize = 5;

/// The next frames of one source of a scan.
#[derive(Clone, Copy, Debug)]
pub struct FreshFrames<'a> {
    pub source: &'a SourceId,
    pub rate_hz: f64,
    pub channels: usize,
    /// Interleaved samples that directly follow those given before.
    pub samples: &'a [f32],
}

/// The best guess at the surface of a scan in progress.
#[derive(Clone, Debug, PartialEq)]
pub struct GuessSoFar {
    /// Scan time at which the guess was made, in seconds.
    pub scan_s: f64,
    /// Up to five surfaces with their probabilities, the most probable first.
    pub named: Vec<(String, f64)>,
    pub p_value: Option<f64>,
    /// The settled answer, if any: its surface, and the scan time at which it was settled.
    pub settled: Option<(String, f64)>,
}

/// Follows scans, one after another.
pub struct Follower {
    model: Arc<EmbeddingModel>,
    rejection: Option<Rejection>,
    settling: Settling,
    scan: ScanSoFar,
}

struct ScanSoFar {
    series: BTreeMap<SourceId, GrowingSeries>,
    pictures: BTreeMap<SourceId, TakenPicture>,
    looks: u64,
    watch: Option<Watch>,
    /// True once samples did not fit; there are no more guesses for this scan.
    failed: bool,
}

struct TakenPicture {
    /// The columns of the picture in the vector; `None` if the library lacks the source.
    vector: Option<Vec<f32>>,
    is_plain: bool,
}

/// A source of the scan up to the last look, and its frames that wait for the next look.
struct GrowingSeries {
    drag: bool,
    waiting: Vec<f32>,
    views: SourceViews,
    /// Number of frames up to the last look.
    samples: usize,
    flaws: SeriesFlaws,
    /// Whether the source has had NaN or infinite samples.
    broken: bool,
    growing: Growing,
    frames: [Counts; 2],
}

impl EmbeddingModel {
    /// Follows scans in progress. The first call calibrates the stopping rule, which takes a while.
    pub fn follow(self: Arc<Self>, options: &FollowOptions) -> Follower {
        let settling = self.settling(options);
        let scan = ScanSoFar::new(&settling);
        Follower { model: self, rejection: options.rejection.clone(), settling, scan }
    }
}

impl Follower {
    /// Adds the missing rest of a finished trial; `None` if it does not begin like the scan so far.
    fn take_rest(&mut self, trial: &Trial) -> Option<()> {
        let series = self.scan.series.iter().filter(|(_, series)| !series.broken);
        let mut came = series.map(|(id, _)| id).chain(self.scan.pictures.keys());
        if !came.all(|id| trial.signals.contains_key(id)) {
            return None;
        }
        for (id, signal) in &trial.signals {
            match signal {
                Signal::Image(picture) if !self.scan.pictures.contains_key(id) => {
                    self.add_picture(id, picture);
                }
                Signal::Image(_) => {}
                Signal::Series(series) => {
                    let channels = series.channels();
                    let received =
                        |known: &GrowingSeries| known.samples * channels + known.waiting.len();
                    let known = self.scan.series.get(id).map_or(0, received);
                    let samples = series.samples().get(known..)?;
                    let rate_hz = series.rate_hz();
                    self.add(FreshFrames { source: id, rate_hz, channels, samples }).ok()?;
                }
            }
        }
        Some(())
    }

    fn guess(&mut self, scan_s: f64) -> Option<GuessSoFar> {
        let sound = self.scan.sound(&self.model);
        let (vector, present) = self.scan.vector(&self.model, &sound);
        if !present.contains(&true) {
            return None;
        }
        let posterior = self.model.posterior(&vector, &present, scan_s);
        let label = posterior.best();
        let rejection = self.rejection.as_ref();
        let rejected = posterior.p_value.zip(rejection).is_some_and(|(p, r)| r.rejects(p));
        let probability = posterior.log_posterior[label].exp();
        let look = Look { scan_s, label, probability, fits: !rejected };
        let settled = self.scan.watch.as_mut().and_then(|watch| watch.see(look));
        Some(GuessSoFar {
            scan_s,
            named: named(&self.model.labels.surfaces, &posterior),
            p_value: posterior.p_value,
            settled: settled.map(|(label, at)| (self.model.labels.surfaces[label].clone(), at)),
        })
    }

    /// Forgets the scan so far, since another scan begins.
    pub fn begin(&mut self) {
        self.scan = ScanSoFar::new(&self.settling);
    }

    /// Takes the next frames of a source. Sources that the library lacks are ignored. A source with
    /// NaN or infinite samples is ignored until the next scan begins.
    ///
    /// # Errors
    /// If the frames do not fit the scene or the frames before them.
    pub fn add(&mut self, fresh: FreshFrames<'_>) -> Result<()> {
        let FreshFrames { source, rate_hz, channels, samples } = fresh;
        let Some(stretch) = self.model.joint.stretch(source) else { return Ok(()) };
        if stretch.spec.channels != channels {
            self.scan.failed = true;
            let error = SourceError::Channels {
                source_name: source.clone(),
                found: channels,
                expected: stretch.spec.channels,
                trial: "the scan".into(),
            };
            return Err(error.into());
        }
        let series = self.scan.series.entry(source.clone()).or_insert_with(|| {
            let views = SourceViews::new(&stretch.spec, (rate_hz, 0), &self.model.shape);
            GrowingSeries::new(views, stretch.spec.phase == Phase::Drag)
        });
        series.waiting.extend_from_slice(samples);
        Ok(())
    }

    pub fn add_picture(&mut self, source: &SourceId, picture: &Image) {
        let vector = match self.model.joint.stretch(source).map(|stretch| &stretch.embedder) {
            Some(SourceEmbedder::Picture(embedder)) => {
                Some(embedder.vector(&PictureTiles::new(picture), None, 0.0))
            }
            _ => None,
        };
        let taken = TakenPicture { vector, is_plain: is_plain(picture) };
        self.scan.pictures.insert(source.clone(), taken);
    }

    /// Renews the guess at each step of [`LOOK_S`] that is still due up to `scan_s` seconds of drag,
    /// from the frames received for that time. Returns the last guess; `None` if no step was due, or
    /// nothing can be said yet.
    ///
    /// # Errors
    /// If received samples cannot be compared with the library.
    pub fn look(&mut self, scan_s: f64) -> Result<Option<GuessSoFar>> {
        let mut said = None;
        while !self.scan.failed && (self.scan.looks + 1) as f64 * LOOK_S <= scan_s + 1e-9 {
            self.scan.looks += 1;
            let at = self.scan.looks as f64 * LOOK_S;
            if let Err(error) = self.scan.pass_on(&self.model, at) {
                self.scan.failed = true;
                return Err(error);
            }
            said = self.guess(at).or(said);
        }
        Ok(said)
    }

    /// The ranking of the finished scan `trial`. It equals
    /// [`Model::rank`](crate::recognise::Model::rank) without the flawed sources
    /// ([`crate::recognise::without_flawed`]). Only the part not yet followed is computed. `None` if
    /// the part followed is not a beginning of `trial`, or `trial` cannot be named.
    pub fn finish(&mut self, trial: &Trial) -> Option<Ranking> {
        if self.scan.failed {
            return None;
        }
        self.take_rest(trial)?;
        let drag_s = trial.longest_s(|id| self.model.scene.is_dragged(id));
        // In the same steps as looks, so that a missed look does not change rounding.
        let steps = drag_s.map_or(0, |drag_s| (drag_s / LOOK_S) as u64);
        for step in self.scan.looks + 1..=steps {
            self.scan.pass_on(&self.model, step as f64 * LOOK_S).ok()?;
        }
        self.scan.pass_on(&self.model, f64::INFINITY).ok()?;
        let sound = self.scan.sound(&self.model);
        if !self.model.joint.stretches.iter().any(|stretch| self.scan.says(stretch, &sound)) {
            return None;
        }
        let (vector, present) = self.scan.vector(&self.model, &sound);
        Some(self.model.ranking(&vector, &present, self.model.left_out.ended_s(drag_s)))
    }

    /// The flaws of a source in the scan so far ([`SeriesFlaws::doubts`]), or in the whole scan once
    /// it is finished. `None` if the source was not followed, or had NaN or infinite samples.
    pub fn doubts(&self, source: &SourceId) -> Option<Vec<Doubt>> {
        let whole = self.scan.series.get(source).filter(|series| !series.broken);
        whole.map(|series| series.flaws.doubts(source, self.model.rests(source)))
    }

    /// The stopping rule for answers, and its results on left-out trials.
    pub fn settling(&self) -> &Settling {
        &self.settling
    }
}

/// The most probable surfaces with their probabilities; ties are in alphabetical order.
fn named(surfaces: &[String], posterior: &Posterior) -> Vec<(String, f64)> {
    let mut order: Vec<usize> = (0..surfaces.len()).collect();
    order.sort_by(|&a, &b| posterior.log_posterior[b].total_cmp(&posterior.log_posterior[a]));
    let name = |&i: &usize| (surfaces[i].clone(), posterior.probabilities[i]);
    order.iter().take(NAMED).map(name).collect()
}

impl ScanSoFar {
    fn new(settling: &Settling) -> Self {
        Self {
            series: BTreeMap::new(),
            pictures: BTreeMap::new(),
            looks: 0,
            watch: settling.rule.map(Watch::new),
            failed: false,
        }
    }

    /// The sources received, without those that are dead or stuck so far. The rule is that of whole
    /// scans, see [`crate::recognise::without_flawed`].
    fn sound(&self, model: &EmbeddingModel) -> BTreeSet<SourceId> {
        let is_flawed = |id: &SourceId| {
            let stuck = |series: &GrowingSeries| series.flaws.is_dead(id, model.rests(id));
            self.pictures.get(id).is_some_and(|picture| picture.is_plain)
                || self.series.get(id).is_some_and(stuck)
        };
        let came = self.series.iter().filter(|(_, series)| !series.broken && series.samples > 0);
        let mut sound: BTreeSet<SourceId> =
            came.map(|(id, _)| id).chain(self.pictures.keys()).cloned().collect();
        let known = sound.iter().map(|id| (id, is_flawed(id).then_some(())));
        for (flawed, ()) in left_out(&model.scene, known) {
            sound.remove(&flawed);
        }
        sound
    }

    /// Adds the frames due by `scan_s` seconds of drag to the sums; frames of taps are always due.
    fn pass_on(&mut self, model: &EmbeddingModel, scan_s: f64) -> Result<()> {
        for (id, series) in self.series.iter_mut().filter(|(_, series)| !series.broken) {
            let view = &series.views.frames[0];
            let there = series.waiting.len() / view.channels;
            let due = samples_by(scan_s, view.rate_hz).saturating_sub(series.samples);
            let frames = if series.drag { there.min(due) } else { there };
            if frames > 0 {
                if let Some(stretch) = model.joint.stretch(id) {
                    stretch.check_rate(&series.views, &"the scan's library")?;
                }
                series.pass_on(frames);
            }
        }
        Ok(())
    }

    /// Whether one of the `sound` sources has anything to compare, like
    /// [`JointEmbedder::says_something`](super::joint::JointEmbedder::says_something) for a trial.
    fn says(&self, stretch: &Stretch, sound: &BTreeSet<SourceId>) -> bool {
        let id = &stretch.spec.id;
        let of_series = |series: &GrowingSeries| {
            stretch.compares(&series.views, series.samples, &series.growing.end().moments)
        };
        let of_picture = |picture: &TakenPicture| picture.vector.is_some();
        sound.contains(id)
            && (self.series.get(id).is_some_and(of_series)
                || self.pictures.get(id).is_some_and(of_picture))
    }

    /// The standardised vector of the samples so far, from the sources named in `sound`.
    fn vector(&self, model: &EmbeddingModel, sound: &BTreeSet<SourceId>) -> (Vec<f32>, Present) {
        let of_source = |stretch: &Stretch| {
            let id = &stretch.spec.id;
            match &stretch.embedder {
                _ if !sound.contains(id) => None,
                SourceEmbedder::Series(embedder) => {
                    let GrowingSeries { frames, growing, views, .. } = self.series.get(id)?;
                    Some(embedder.growing(frames, &growing.end(), views.moments_hz()))
                }
                SourceEmbedder::Picture(_) => self.pictures.get(id)?.vector.clone(),
            }
        };
        let parts = model.joint.stretches.iter().map(of_source);
        model.joint.joined(parts)
    }
}

impl GrowingSeries {
    fn new(views: SourceViews, drag: bool) -> Self {
        let channels = views.channels();
        Self {
            drag,
            waiting: Vec::new(),
            samples: 0,
            flaws: SeriesFlaws::new(channels),
            broken: false,
            frames: views.frames.each_ref().map(|view| Counts::new(view.channels, view.width())),
            growing: Growing::new(&views),
            views,
        }
    }

    /// Adds the first `frames` waiting frames to the sums.
    fn pass_on(&mut self, frames: usize) {
        let samples: Vec<f32> = self.waiting.drain(..frames * self.views.channels()).collect();
        self.samples += frames;
        self.flaws.add(&samples);
        self.broken = !samples.iter().all(|x| x.is_finite());
        if self.broken {
            return;
        }
        for (sums, fresh) in self.frames.iter_mut().zip(self.growing.add(&samples)) {
            sums.add(&fresh.values());
        }
    }
}
