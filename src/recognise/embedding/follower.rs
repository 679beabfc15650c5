//! Follows a scan with a trained model, and renews the guess at each look (step of [`LOOK_S`]).
//!
//! A growing scan is kept as sums to which new samples are added, so that a look costs the same in
//! the hundredth second as in the first. Its vector equals that of a trial of the same samples,
//! except for moments about the mean; these are exact once the finished trial is given.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use super::band_sums::BandSums;
use super::frames::{PackedFrames, SourceViews};
use super::joint::{JointEmbedder, Present, SourceEmbedder};
use super::model::{EmbeddingModel, Posterior};
use super::moments::GrowingMoments;
use super::series::{SeriesEmbedder, counted};
use super::tiles::{Part, PictureTiles};
use crate::recognise::decide::conformal::Rejection;
use crate::recognise::decide::dead_sensor::left_out;
use crate::recognise::decide::settle::{Look, Settling, Watch};
use crate::recognise::error::RecogniseError;
use crate::recognise::features::windowed_frames::ViewFrames;
use crate::recognise::follow::{FollowOptions, FreshFrames, GuessSoFar, LOOK_S};
use crate::recognise::rank::Ranking;
use crate::recognise::shape::LibraryShape;
use crate::scene::{Phase, SourceId};
use crate::trial::{Flaw, Image, SeriesFlaws, Signal, Trial, is_plain};

/// How many surfaces a guess names at most.
const NAMED: usize = 5;

/// Follows one scan after the other.
pub struct Follower {
    model: Arc<EmbeddingModel>,
    rejection: Option<Rejection>,
    settling: Settling,
    scan: ScanSoFar,
}

/// The current scan so far.
struct ScanSoFar {
    sums: ScanSums,
    waiting: BTreeMap<SourceId, Waiting>,
    /// Sources whose picture has come.
    pictures: BTreeSet<SourceId>,
    /// Sources whose picture is of one colour.
    plain: BTreeSet<SourceId>,
    looks: u64,
    watch: Option<Watch>,
    /// Samples did not fit: there are no more guesses for this scan.
    failed: bool,
}

/// Frames of a source that wait for the look that uses them.
struct Waiting {
    rate_hz: f64,
    channels: usize,
    drag: bool,
    samples: Vec<f32>,
    passed_on: u64,
    /// Flaws of the frames that were passed on.
    flaws: SeriesFlaws,
    /// Whether it had NaN or infinite samples.
    broken: bool,
}

impl Waiting {
    /// Number of frames received, passed on or not.
    fn frames(&self) -> usize {
        self.passed_on as usize + self.samples.len() / self.channels
    }
}

impl Follower {
    pub(super) fn new(model: &Arc<EmbeddingModel>, options: &FollowOptions) -> Self {
        let settling = model.settling(options);
        let scan = ScanSoFar::new(model, &settling);
        let (model, rejection) = (model.clone(), options.rejection.clone());
        Self { model, rejection, settling, scan }
    }

    /// Takes what is missing of a finished trial; `None` if the scan so far is not part of it.
    fn take_rest(&mut self, trial: &Trial) -> Option<()> {
        let in_trial = |id: &SourceId| trial.signals.contains_key(id);
        let series = self.scan.waiting.iter().filter(|(_, waiting)| !waiting.broken);
        if !series.map(|(id, _)| id).chain(&self.scan.pictures).all(in_trial) {
            return None;
        }
        for (id, signal) in &trial.signals {
            match signal {
                Signal::Image(picture) if !self.scan.pictures.contains(id) => {
                    self.add_picture(id, picture);
                }
                Signal::Image(_) => {}
                Signal::Series(series) => {
                    let channels = series.channels();
                    let known = self.scan.waiting.get(id).map_or(0, Waiting::frames);
                    let samples = series.samples().get(known * channels..)?;
                    let rate_hz = series.rate_hz();
                    self.add(FreshFrames { source: id, rate_hz, channels, samples }).ok()?;
                }
            }
        }
        Some(())
    }

    fn guess(&mut self, scan_s: f64) -> Option<GuessSoFar> {
        let sound = self.scan.sound(&self.model);
        let keep = |id: &SourceId| sound.contains(id);
        let (vector, present) = self.scan.sums.vector(&self.model.joint, keep, None);
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
}

/// The most probable surfaces, in alphabetical order in a tie.
fn named(surfaces: &[String], posterior: &Posterior) -> Vec<(String, f64)> {
    let mut order: Vec<usize> = (0..surfaces.len()).collect();
    order.sort_by(|&a, &b| posterior.log_posterior[b].total_cmp(&posterior.log_posterior[a]));
    let name = |&i: &usize| (surfaces[i].clone(), posterior.probabilities[i]);
    order.iter().take(NAMED).map(name).collect()
}

impl ScanSoFar {
    fn new(model: &EmbeddingModel, settling: &Settling) -> Self {
        Self {
            sums: ScanSums::new(&model.joint, &model.shape),
            waiting: BTreeMap::new(),
            pictures: BTreeSet::new(),
            plain: BTreeSet::new(),
            looks: 0,
            watch: settling.rule.map(Watch::new),
            failed: false,
        }
    }

    fn is_flawed(&self, model: &EmbeddingModel, id: &SourceId) -> bool {
        let stuck = |waiting: &Waiting| {
            waiting.flaws.dead().any(|flaw| model.joint.moves(id, flaw.channel() - 1))
        };
        self.plain.contains(id) || self.waiting.get(id).is_some_and(stuck)
    }

    /// The sources received, without those that are dead or stuck so far, as for whole scans: see
    /// [`crate::recognise::without_flawed`].
    fn sound(&self, model: &EmbeddingModel) -> BTreeSet<SourceId> {
        let flaw = |id| self.is_flawed(model, id).then_some(());
        let came = self.waiting.iter().filter(|(_, w)| !w.broken && w.passed_on > 0);
        let known: BTreeSet<&SourceId> = came.map(|(id, _)| id).chain(&self.pictures).collect();
        let flawed = left_out(&model.scene, known.iter().map(|id| (*id, flaw(*id))));
        let is_sound = |id: &&&SourceId| !flawed.iter().any(|(f, ())| f == **id);
        known.iter().filter(is_sound).map(|id| (*id).clone()).collect()
    }

    /// Adds what each source had by `scan_s` seconds of drag to the sums; of taps, everything.
    fn pass_on(&mut self, model: &EmbeddingModel, scan_s: f64) -> Result<(), RecogniseError> {
        for (id, waiting) in self.waiting.iter_mut().filter(|(_, waiting)| !waiting.broken) {
            let there = waiting.samples.len() / waiting.channels;
            let frames = if waiting.drag {
                let due = (scan_s * waiting.rate_hz - 1e-6).ceil() as u64;
                there.min(due.saturating_sub(waiting.passed_on) as usize)
            } else {
                there
            };
            if frames == 0 {
                continue;
            }
            let samples: Vec<f32> = waiting.samples.drain(..frames * waiting.channels).collect();
            waiting.passed_on += frames as u64;
            waiting.flaws.add(&samples);
            if samples.iter().all(|x| x.is_finite()) {
                self.sums.push(&model.joint, id, waiting.rate_hz, &samples)?;
            } else {
                waiting.broken = true;
            }
        }
        Ok(())
    }
}

impl Follower {
    /// Forgets the scan so far: another one begins.
    pub fn begin(&mut self) {
        self.scan = ScanSoFar::new(&self.model, &self.settling);
    }

    /// Takes the next frames of a source. Sources that the library lacks are ignored, and so are
    /// those with NaN or infinite samples, until the next scan begins.
    ///
    /// # Errors
    /// If the frames do not fit the scene or those before them.
    pub fn add(&mut self, fresh: FreshFrames<'_>) -> Result<(), RecogniseError> {
        let FreshFrames { source, rate_hz, channels, samples } = fresh;
        let stretches = &self.model.joint.stretches;
        let Some(stretch) = stretches.iter().find(|s| s.spec.id == *source) else { return Ok(()) };
        if stretch.spec.channels != channels {
            self.scan.failed = true;
            return Err(RecogniseError::Channels {
                source_name: source.clone(),
                found: channels,
                expected: stretch.spec.channels,
                trial: "the scan".into(),
            });
        }
        let drag = stretch.spec.phase == Phase::Drag;
        let begin = || Waiting {
            rate_hz,
            channels,
            drag,
            samples: Vec::new(),
            passed_on: 0,
            flaws: SeriesFlaws::new(channels),
            broken: false,
        };
        let waiting = self.scan.waiting.entry(source.clone()).or_insert_with(begin);
        waiting.samples.extend_from_slice(samples);
        Ok(())
    }

    /// Takes a picture.
    pub fn add_picture(&mut self, source: &SourceId, picture: &Image) {
        if is_plain(picture) {
            self.scan.plain.insert(source.clone());
        } else {
            self.scan.plain.remove(source);
        }
        self.scan.sums.push_picture(&self.model.joint, source, picture);
        self.scan.pictures.insert(source.clone());
    }

    /// Renews the guess at each step of [`LOOK_S`] up to `scan_s` seconds of drag that is still
    /// due, from the frames received for that time. Returns the last of these guesses; `None` if no
    /// step was due or nothing can be said yet.
    ///
    /// # Errors
    /// If received samples cannot be compared with the library.
    pub fn look(&mut self, scan_s: f64) -> Result<Option<GuessSoFar>, RecogniseError> {
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

    /// The ranking of the finished scan `trial`, equal to that of
    /// [`Model::rank`](crate::recognise::Model::rank) without the flawed sources
    /// ([`crate::recognise::without_flawed`]). Only what was not followed yet is computed. `None`
    /// if what was followed is not a beginning of the trial, or the trial cannot be named.
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
        let keep = |id: &SourceId| sound.contains(id);
        if !self.scan.sums.says_something(&self.model.joint, keep) {
            return None;
        }
        let (vector, present) = self.scan.sums.vector(&self.model.joint, keep, Some(trial));
        Some(self.model.ranking(&vector, &present, self.model.ended_s(drag_s)))
    }

    /// The flaws of a source in the scan so far ([`crate::trial::flaws`]); of the whole scan, once
    /// it is finished. `None` if the source was not followed, or had NaN or infinite samples.
    pub fn flaws(&self, source: &SourceId) -> Option<Vec<Flaw>> {
        let whole = self.scan.waiting.get(source).filter(|waiting| !waiting.broken);
        whole.map(|waiting| waiting.flaws.flaws())
    }

    /// When answers count as settled, and how that was found.
    pub fn settling(&self) -> &Settling {
        &self.settling
    }
}

/// Sums of the scan so far.
struct ScanSums {
    shape: Arc<LibraryShape>,
    /// Sources in the order of the vector; `None` until they are received.
    sources: Vec<Option<SourceSums>>,
}

enum SourceSums {
    Series(Box<SeriesScan>),
    /// Its columns of the vector.
    Picture(Vec<f32>),
}

struct SeriesScan {
    views: SourceViews,
    /// Samples so far.
    samples: usize,
    frames: [BandSums; 2],
    moments: GrowingMoments,
    /// For each view, the samples that later frames need: all, until the first frame is complete.
    pending: [Vec<f32>; 2],
}

impl ScanSums {
    /// A scan without samples.
    pub fn new(joint: &JointEmbedder, shape: &Arc<LibraryShape>) -> Self {
        let sources = joint.stretches.iter().map(|_| None).collect();
        Self { shape: shape.clone(), sources }
    }

    /// Takes the next samples of a source, interleaved. Sources that the library lacks are ignored.
    ///
    /// # Errors
    /// If the rate cannot be compared with the library's, or changes during the scan.
    pub fn push(
        &mut self,
        joint: &JointEmbedder,
        id: &SourceId,
        rate_hz: f64,
        samples: &[f32],
    ) -> Result<(), RecogniseError> {
        let Some(place) = joint.stretches.iter().position(|s| s.spec.id == *id) else {
            return Ok(());
        };
        let stretch = &joint.stretches[place];
        let SourceEmbedder::Series(embedder) = &stretch.embedder else { return Ok(()) };
        let slot = &mut self.sources[place];
        if slot.is_none() {
            let views = SourceViews::new(&stretch.spec, (rate_hz, 0), &self.shape);
            *slot = Some(SourceSums::Series(Box::new(SeriesScan::new(views))));
        }
        let Some(SourceSums::Series(scan)) = slot else { return Ok(()) };
        let own_hz = scan.views.0[0].rate_hz;
        if own_hz != rate_hz || !scan.views.comparable(&embedder.views) {
            return Err(RecogniseError::Rates {
                source_name: id.clone(),
                query_hz: rate_hz,
                library_hz: if own_hz == rate_hz { embedder.views.0[0].rate_hz } else { own_hz },
                trial: "the scan's library".into(),
            });
        }
        scan.push(samples);
        Ok(())
    }

    /// Takes a picture.
    pub fn push_picture(&mut self, joint: &JointEmbedder, id: &SourceId, picture: &Image) {
        let place = joint.stretches.iter().position(|s| s.spec.id == *id);
        if let Some(place) = place
            && let SourceEmbedder::Picture(embedder) = &joint.stretches[place].embedder
        {
            let vector = embedder.vector(&PictureTiles::new(picture), Part::Whole, 0.0);
            self.sources[place] = Some(SourceSums::Picture(vector));
        }
    }

    /// As [`JointEmbedder::says_something`], for those sources that `keep` wants.
    pub fn says_something(&self, joint: &JointEmbedder, keep: impl Fn(&SourceId) -> bool) -> bool {
        let mut sources = joint.stretches.iter().zip(&self.sources);
        sources.any(|(stretch, source)| match source {
            Some(SourceSums::Series(scan)) if keep(&stretch.spec.id) => {
                scan.samples >= scan.views.0[1].points
                    && (stretch.has_switch() || !scan.moments.so_far().is_constant())
            }
            Some(SourceSums::Picture(_)) => keep(&stretch.spec.id),
            _ => false,
        })
    }

    /// The standardised vector so far, of those sources that were received and that `keep` wants;
    /// exact if `trial` is given, which must consist of these samples.
    pub fn vector(
        &self,
        joint: &JointEmbedder,
        keep: impl Fn(&SourceId) -> bool,
        trial: Option<&Trial>,
    ) -> (Vec<f32>, Present) {
        let mut vector = vec![0.0; joint.dims()];
        let mut present = vec![false; self.sources.len()];
        for (place, (stretch, source)) in joint.stretches.iter().zip(&self.sources).enumerate() {
            let Some(source) = source.as_ref().filter(|_| keep(&stretch.spec.id)) else { continue };
            let of_source = match (source, &stretch.embedder) {
                (SourceSums::Series(scan), SourceEmbedder::Series(embedder)) => {
                    let signal = trial.and_then(|trial| trial.signals.get(&stretch.spec.id));
                    scan.vector(embedder, signal)
                }
                (SourceSums::Picture(of_picture), _) => of_picture.clone(),
                _ => continue,
            };
            vector[stretch.columns.clone()].copy_from_slice(&of_source);
            present[place] = true;
        }
        joint.standardise(&mut vector, &present);
        (vector, present)
    }
}

impl SeriesScan {
    fn new(views: SourceViews) -> Self {
        Self {
            frames: [0, 1].map(|view| counted(&views, &PackedFrames::default(), view)),
            moments: GrowingMoments::new(views.0[0].channels, views.block()),
            pending: Default::default(),
            samples: 0,
            views,
        }
    }

    fn push(&mut self, samples: &[f32]) {
        self.samples += samples.len() / self.views.0[0].channels;
        self.moments.extend(samples);
        for (v, view) in self.views.0.iter().enumerate() {
            let pending = &mut self.pending[v];
            pending.extend_from_slice(samples);
            let mut fresh = ViewFrames { view: view.clone(), values: Vec::new() };
            let used = fresh.extend(pending) * view.channels;
            pending.drain(..used);
            self.frames[v].add(&PackedFrames::new(&fresh.values).values());
        }
    }

    fn vector(&self, embedder: &SeriesEmbedder, whole: Option<&Signal>) -> Vec<f32> {
        let mut frames = self.frames.clone();
        for (v, view) in self.views.0.iter().enumerate() {
            if frames[v].frames() == 0 {
                let padded = ViewFrames::new(view.clone(), &self.pending[v]);
                frames[v].add(&PackedFrames::new(&padded.values).values());
            }
        }
        let moments = match whole {
            Some(Signal::Series(series)) => self.moments.whole(series.samples()),
            _ => self.moments.so_far(),
        };
        embedder.vector(&frames, &moments, self.views.0[0].rate_hz, 0.0)
    }
}
