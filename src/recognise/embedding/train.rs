//! Trains one source of a library: scale, training vectors, discriminant, temperatures.

use rayon::prelude::*;

use ndarray::Array2;

use super::EmbeddingOptions;
use super::calibrate::{HeldOut, PREFIXES_S, Temperature};
use super::discriminant::{Discriminant, Scatter};
use super::source::{SourceEmbedder, Window};
use crate::recognise::features::frame_features::{Framed, SourceFrames};
use crate::recognise::features::image_features::Part;
use crate::recognise::features::normalisation::SourceScale;
use crate::scene::SourceSpec;

/// Loudness of the noise in noise copies, in dB relative to the library's median power.
const NOISE_DB: [f32; 3] = [-40.0, -30.0, -20.0];

/// At most this many groups of trials are left out in turn.
const MOST_GROUPS: usize = 10;

/// A source, ready to be compared with.
pub(super) struct SourceModel {
    pub spec: SourceSpec,
    pub embedder: SourceEmbedder,
    /// Whole-trial vector of each library trial that has the source.
    pub vectors: Vec<Option<Vec<f32>>>,
    pub discriminant: Option<Discriminant>,
    pub temperature: Temperature,
    /// Median of d/τ of left-out library trials to their own class.
    pub median_own_distance: f64,
    /// For each group of trials, the discriminant trained without it.
    pub without: Vec<Option<Discriminant>>,
    /// Distances of library trials under models trained without them; let go once they are summed
    /// over sources.
    pub held_out: Vec<Option<ByPrefix>>,
}

impl SourceModel {
    /// Adds w·f(d/τ) for the distances d to all classes of a scan of so many seconds. Where the
    /// source is `alone`, f(x) = x: all that counts is the order. Among others it is
    /// f(x) = u·ln(1 + x/u), u the usual x of a trial to its own class: up to there it is x, far
    /// beyond it only ratios count, as they do in the paper's product of scores. A source that is
    /// far from all surfaces (its lamp is out, its lens is blurred) says little then, instead of
    /// overruling all others. It is the heavy tail of Student's t (Lange, Little & Taylor 1989,
    /// "Robust statistical modeling using the t distribution"), u for both scale and freedom.
    ///
    /// A class that the source never saw counts as the median of the others: lacking it is neither
    /// an advantage nor a disadvantage.
    pub fn add_evidence(&self, sum: &mut [f64], distances: Vec<f64>, seconds: f64, alone: bool) {
        let (tau, median_own_distance) = (self.temperature.at(seconds), self.median_own_distance);
        let mut known: Vec<f64> = distances.iter().copied().filter(|d| d.is_finite()).collect();
        known.sort_by(f64::total_cmp);
        let median = known.get(known.len() / 2).copied().unwrap_or(0.0);
        for (sum, d) in sum.iter_mut().zip(distances) {
            let x = if d.is_finite() { d } else { median } / tau;
            let tailed = !alone && median_own_distance.is_finite();
            *sum += self.spec.weight
                * if tailed { median_own_distance * (x / median_own_distance).ln_1p() } else { x };
        }
    }
}

/// Lengths of a trial's beginnings in seconds, with distances to all classes; the whole comes last.
pub(super) type ByPrefix = Vec<(f64, Vec<f64>)>;

/// What training needs to know of a library: its sorted trials' classes and groups.
pub(super) struct Labels {
    /// Class of each trial.
    pub class: Vec<usize>,
    /// Number of classes.
    pub classes: usize,
    /// Group of each trial; groups are left out together.
    pub group: Vec<usize>,
}

impl Labels {
    /// Classes and groups of trials that are sorted by surface. Trials of one person and number
    /// make a group; where that makes too many, several share one.
    pub fn new<'a>(keys: impl Iterator<Item = &'a crate::trial::TrialKey> + Clone) -> Self {
        let mut surfaces: Vec<&str> = keys.clone().map(|key| key.surface.as_str()).collect();
        surfaces.dedup();
        let mut sessions: Vec<(&str, u32)> =
            keys.clone().map(|key| (key.user.as_str(), key.number)).collect();
        sessions.sort_unstable();
        sessions.dedup();
        // The lists hold every key's surface and session: they were made of them.
        let class = |key: &crate::trial::TrialKey| {
            surfaces.binary_search(&key.surface.as_str()).unwrap_or(0)
        };
        let group = |key: &crate::trial::TrialKey| {
            sessions.binary_search(&(key.user.as_str(), key.number)).unwrap_or(0) % MOST_GROUPS
        };
        Self {
            class: keys.clone().map(class).collect(),
            classes: surfaces.len(),
            group: keys.map(group).collect(),
        }
    }
}

/// Trains a source. `trials` are those of the library, in order; at least one has the source.
pub(super) fn train(
    spec: &SourceSpec,
    trials: &[Option<&SourceFrames>],
    labels: &Labels,
    options: &EmbeddingOptions,
) -> SourceModel {
    let held: Vec<&Framed> = trials.iter().flatten().map(|source| &source.data).collect();
    let scale = SourceScale::new(&held, spec.align_mean);
    let harmonics = options.harmonics.unwrap_or(if spec.channels == 1 { 4 } else { 2 });
    let embedder = SourceEmbedder::new(scale, spec.align_mean, harmonics.clamp(1, 4));
    let mut model = SourceModel {
        spec: spec.clone(),
        vectors: Vec::new(),
        discriminant: None,
        temperature: Temperature::uncalibrated(),
        median_own_distance: f64::INFINITY,
        without: Vec::new(),
        held_out: vec![None; trials.len()],
        embedder,
    };
    if options.discriminant {
        train_discriminant(&mut model, trials, labels, options);
    } else {
        let whole = |source: &Option<&SourceFrames>| {
            source.map(|source| model.embedder.embed(source, Window::Whole))
        };
        model.vectors = trials.par_iter().map(whole).collect();
    }
    model
}

fn train_discriminant(
    model: &mut SourceModel,
    trials: &[Option<&SourceFrames>],
    labels: &Labels,
    options: &EmbeddingOptions,
) {
    let embedder = &model.embedder;
    // The whole trial comes first.
    let vectors: Vec<Vec<Vec<f32>>> = (trials.par_iter())
        .map(|source| source.map_or_else(Vec::new, |s| training_vectors(embedder, s, options)))
        .collect();
    let groups = labels.group.iter().copied().max().unwrap_or(0) + 1;
    let of_group: Vec<Scatter> = (0..groups)
        .into_par_iter()
        .map(|group| {
            let members = (0..trials.len()).filter(|&i| labels.group[i] == group);
            let (mut rows, mut classes) = (Vec::new(), Vec::new());
            for i in members {
                for vector in &vectors[i] {
                    rows.extend_from_slice(vector);
                    classes.push(labels.class[i]);
                }
            }
            // Every vector has the embedder's length.
            let rows = Array2::from_shape_vec((classes.len(), embedder.dims()), rows)
                .unwrap_or_else(|_| Array2::zeros((0, embedder.dims())));
            Scatter::new(&rows, &classes, labels.classes)
        })
        .collect();
    model.vectors = vectors.into_iter().map(|of_trial| of_trial.into_iter().next()).collect();
    let mut all = Scatter::none(labels.classes, embedder.dims());
    of_group.iter().for_each(|scatter| all.add(scatter));
    model.discriminant = Discriminant::new(&all, options.shrinkage);
    if model.discriminant.is_none() || groups < 2 {
        return;
    }

    // Each trial under the model without its group: whole, and its first seconds.
    let without: Vec<Option<Discriminant>> = (of_group.par_iter())
        .map(|scatter| Discriminant::new(&all.without(scatter), options.shrinkage))
        .collect();
    let held_out: Vec<Option<ByPrefix>> = (0..trials.len())
        .into_par_iter()
        .map(|i| {
            let (source, trained) = (trials[i]?, without[labels.group[i]].as_ref()?);
            let whole = trained.distances(model.vectors[i].as_ref()?);
            if !whole[labels.class[i]].is_finite() {
                return None;
            }
            let prefixes = PREFIXES_S.iter().filter(|&&t| t < source.duration_s - 0.05);
            let mut all: ByPrefix = prefixes
                .map(|&t| {
                    let vector = embedder.embed(source, Window::Seconds(0.0, t));
                    (t, trained.distances(&vector))
                })
                .collect();
            all.push((source.duration_s, whole));
            Some(all)
        })
        .collect();
    model.temperature = temperature(&held_out, labels);
    model.median_own_distance = median_own_distance(&held_out, labels, &model.temperature);
    model.held_out = held_out;
    model.without = without;
}

fn median_own_distance(
    held_out: &[Option<ByPrefix>],
    labels: &Labels,
    temperature: &Temperature,
) -> f64 {
    let own = |(of_trial, &class): (&Option<ByPrefix>, &usize)| {
        let (seconds, distances) = of_trial.as_ref()?.last()?;
        Some(distances[class] / temperature.at(*seconds))
    };
    let mut own: Vec<f64> = held_out.iter().zip(&labels.class).filter_map(own).collect();
    own.sort_by(f64::total_cmp);
    // Where trials lie on their own means, one more unit is unusual enough.
    own.get(own.len() / 2).map_or(f64::INFINITY, |x| x.max(1.0))
}

fn temperature(held_out: &[Option<ByPrefix>], labels: &Labels) -> Temperature {
    let known = || held_out.iter().zip(&labels.class).filter_map(|(d, &c)| Some((d.as_ref()?, c)));
    let at = |t: f64| {
        let trials: Vec<HeldOut> = known()
            .filter_map(|(all, class)| {
                let found = all[..all.len() - 1].iter().find(|(prefix, _)| *prefix == t)?;
                Some((found.1.clone(), class))
            })
            .collect();
        (t, trials)
    };
    let mut lists: Vec<(f64, Vec<HeldOut>)> = PREFIXES_S.iter().map(|&t| at(t)).collect();
    let mut durations: Vec<f64> = known().filter_map(|(all, _)| Some(all.last()?.0)).collect();
    durations.sort_by(f64::total_cmp);
    if let Some(&middle) = durations.get(durations.len() / 2) {
        lists.retain(|(t, _)| *t < middle);
        let whole = known().filter_map(|(all, class)| Some((all.last()?.1.clone(), class)));
        lists.push((middle, whole.collect()));
    }
    Temperature::fit(lists)
}

/// All vectors that a library trial trains with, the whole trial first.
fn training_vectors(
    embedder: &SourceEmbedder,
    source: &SourceFrames,
    options: &EmbeddingOptions,
) -> Vec<Vec<f32>> {
    let mut vectors: Vec<Vec<f32>> =
        windows(source).into_iter().map(|window| embedder.embed(source, window)).collect();
    if let (Framed::Bands(views), true) = (&source.data, options.noise_copies) {
        let power: Vec<Vec<f32>> = (views.iter())
            .map(|view| view.values.iter().map(|a| a.exp().min(1e30)).collect())
            .collect();
        let mut noisy = power.clone();
        for db in NOISE_DB {
            let gain = 10f32.powf(db / 10.0);
            for (v, view) in views.iter().enumerate() {
                let (width, bands) = (view.view.width(), view.view.bands());
                let added: Vec<f32> =
                    (0..width).map(|column| gain * embedder.power(v, column / bands)).collect();
                let rows = noisy[v].chunks_exact_mut(width).zip(power[v].chunks_exact(width));
                for (noisy, power) in rows {
                    for ((slot, power), added) in noisy.iter_mut().zip(power).zip(&added) {
                        *slot = (power + added).max(1e-30).ln();
                    }
                }
            }
            let values: Vec<&[f32]> = noisy.iter().map(|values| &values[..]).collect();
            for window in seconds(source, 1.0, 1.0, 3.0) {
                let mut vector = vec![0.0; embedder.dims()];
                embedder.embed_bands(source, &values, window, &mut vector);
                vectors.push(vector);
            }
        }
    }
    vectors
}

/// The whole, seconds at every half second up to 3.5, half seconds up to 4.0; a picture and its
/// quarters. A trial shorter than a second has its whole alone.
fn windows(source: &SourceFrames) -> Vec<Window> {
    if let Framed::Pixels(_) = source.data {
        let quarters = [(false, false), (false, true), (true, false), (true, true)];
        let quarters = quarters.map(|(lower, right)| Window::Picture(Part::Quarter(lower, right)));
        return std::iter::once(Window::Whole).chain(quarters).collect();
    }
    let mut windows = seconds(source, 1.0, 0.5, 3.5);
    windows.extend(seconds(source, 0.5, 0.5, 4.0).into_iter().skip(1));
    windows
}

/// The whole, and windows of `length_s` that begin every `step_s` up to `last_s`, as they fit.
fn seconds(source: &SourceFrames, length_s: f64, step_s: f64, last_s: f64) -> Vec<Window> {
    let starts = (0..=(last_s / step_s).round() as usize).map(|i| i as f64 * step_s);
    let fits = starts
        .filter(|start| source.duration_s >= 1.0 && start + length_s <= source.duration_s + 1e-9);
    let windows = fits.map(|start| Window::Seconds(start, start + length_s));
    std::iter::once(Window::Whole).chain(windows).collect()
}
