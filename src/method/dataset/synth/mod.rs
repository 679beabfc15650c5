//! A synthetic scene: simulated trials of invented surfaces and users.
//!
//! The scene serves tests, demonstrations and stress tests, never published accuracies; every
//! library made here is marked as synthetic. A trial is generated when it is loaded. It depends on
//! the seed, the surface, the user and the trial's number alone, so trials can be made in any order
//! and on any thread. One machine gives the same bytes each time. Another processor may differ in
//! the last bits of a Fourier transform, and so sometimes in the last bit of a sample.
//!
//! [`Difficulty`] holds every constant of the model; `parameters` says how the constants make a trial.
//!
//! [`Difficulty::lmt108`] is calibrated on Table II of the paper: each source is within 12 points of
//! the paper, and all eight within 3. `cargo run --release --example synth_pattern -- --users 10` prints
//! the comparison, which must not be used to rank methods.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use contact::{Contact, Hand};
use parameters::Draws;

use crate::library::{Entry, Library, LibraryError, LoadTrial, Outline, Outlines};
use crate::scene::{Scene, SourceId};
use crate::trial::{EXPERT, Image, Series, Signal, SignalError, Trial, TrialKey};

mod contact;
mod parameters;
mod picture;

pub use parameters::{Difficulty, Effect, Parameters, Twins};

/// The materials of the surfaces, in turn, named as in LMT108.
const MATERIALS: [&str; 9] =
    ["Mesh", "Stone", "Glossy", "Wood", "Rubber", "Carpet", "Foam", "Plastic", "Textile"];
/// The materials of which some surfaces conduct electricity.
const CONDUCTORS: [&str; 2] = ["Mesh", "Glossy"];
const SOUND_RATE_HZ: f64 = 44_100.0;
const SERIAL_RATE_HZ: f64 = 10_000.0;
/// Sound samples per second of a drag. As in dataset LMT108, sound ends just before the drag.
const SOUND_FRAMES_A_SECOND: f64 = 211_611.0 / 4.8;
/// Number of sound samples of a tap, as in the dataset LMT108.
const TAP_FRAMES: usize = 10_501;

/// A synthetic library. The expert makes `trials` trials of each surface, and user u makes trial u.
/// A trial is generated only when its entry is loaded.
pub fn library(parameters: &Parameters) -> Library {
    let scene = Scene::lmt108();
    let sources: Vec<SourceId> = scene.sources().map(|spec| spec.id.clone()).collect();
    let shared = Arc::new((parameters.clone(), scene.clone()));
    let mut entries = Vec::new();
    for index in 0..parameters.surfaces {
        let surface = surface_name(index);
        let by_expert = (1..=parameters.trials).map(|n| TrialKey::new(&surface, EXPERT, n));
        let by_users =
            (1..=parameters.users).map(|u| TrialKey::new(&surface, format!("user{u}"), u));
        for key in by_expert.chain(by_users) {
            let loader = Generated { shared: Arc::clone(&shared), key: key.clone() };
            entries.push(Entry::new(key, sources.clone(), Arc::new(loader)));
        }
    }
    entries.sort_by(|a, b| a.key.cmp(&b.key));
    Library {
        name: format!("synthetic scene, seed {}", parameters.seed),
        scene,
        entries,
        synthetic: true,
        remarks: Vec::new(),
    }
}

fn surface_name(index: usize) -> String {
    format!("Synth{:03}{}", index + 1, MATERIALS[index % MATERIALS.len()])
}

#[derive(Debug)]
struct Generated {
    shared: Arc<(Parameters, Scene)>,
    key: TrialKey,
}

impl LoadTrial for Generated {
    fn load(&self, wanted: &[SourceId]) -> Result<Trial, LibraryError> {
        let (parameters, scene) = &*self.shared;
        let mut signals = BTreeMap::new();
        for id in wanted.iter().filter(|id| scene.get(id.as_str()).is_some()) {
            let signal = generate(parameters, &self.key, id.as_str()).map_err(|error| {
                let path = format!("synthetic trial {}, {id}", self.key);
                LibraryError::file(Path::new(&path), error)
            })?;
            signals.insert(id.clone(), signal);
        }
        Ok(Trial { key: self.key.clone(), signals })
    }

    fn outlines(&self, wanted: &[SourceId]) -> Result<Outlines, LibraryError> {
        let (parameters, scene) = &*self.shared;
        let known = wanted.iter().filter(|id| scene.get(id.as_str()).is_some());
        let outline = |id: &SourceId| Some((id.clone(), outline(parameters, id.as_str())?));
        Ok(known.filter_map(outline).collect())
    }
}

/// Rate, channels and length of a source; `None` for a picture.
fn outline(p: &Parameters, source: &str) -> Option<Outline> {
    let seconds = p.drag_seconds.clamp(0.0, parameters::LONGEST_DRAG_S);
    // `max` ignores a NaN, so there is at least one frame even if `seconds` is NaN.
    let frames = |rate_hz: f64| (seconds * rate_hz).round().max(1.0) as usize;
    let (rate_hz, channels, frames) = match source {
        "ca1" | "ca2" => return None,
        "mi1" => (SOUND_RATE_HZ, 1, TAP_FRAMES),
        "mi2" => (SOUND_RATE_HZ, 1, frames(SOUND_FRAMES_A_SECOND)),
        "ac" => (SERIAL_RATE_HZ, 3, frames(SERIAL_RATE_HZ)),
        "fr" => (SERIAL_RATE_HZ, 2, frames(SERIAL_RATE_HZ)),
        _ => (SERIAL_RATE_HZ, 1, frames(SERIAL_RATE_HZ)),
    };
    Some(Outline { rate_hz, channels, frames })
}

/// Fails if a number in [`Difficulty`] is so extreme that samples are infinite or NaN.
fn generate(p: &Parameters, key: &TrialKey, source: &str) -> Result<Signal, SignalError> {
    let original = p.twins.filter(|twins| key.surface == surface_name(twins.twin));
    let original = original.map(|twins| (surface_name(twins.original), twins.distance));
    let like = original.as_ref().map(|(name, distance)| (name.as_str(), *distance));
    let draws = &Draws { seed: p.seed, d: &p.difficulty, key, like };
    let hand = &Hand::draw(draws);
    let Some(Outline { rate_hz, channels, frames }) = outline(p, source) else {
        let rgb = picture::picture(draws, source == "ca2");
        return Image::new(Image::COLS, Image::ROWS, rgb).map(Signal::Image);
    };
    let contact = &Contact { draws, hand, frames, rate_hz };
    let samples = match source {
        "mi1" => contact::tap_sound(contact),
        "mi2" => contact::drag_sound(contact),
        "ac" => contact::acceleration(contact),
        "fr" => contact::friction(contact),
        "ir" => contact::reflectance(contact),
        // The remaining one of the eight sources is `me`.
        _ => contact::metal(contact, conducts(draws)),
    };
    Series::new(rate_hz, channels, samples).map(Signal::Series)
}

fn conducts(draws: &Draws<'_>) -> bool {
    CONDUCTORS.iter().any(|kind| draws.key.surface.ends_with(kind))
        && draws.surface_uniform("metal", 0) < draws.d.metal_fraction
}

/// Number of surfaces in the embedded scene. The last one is missing from the expert's trials.
const SURFACES: usize = 13;
/// Two surfaces that are almost alike, and of one material.
const TWINS: Twins = Twins { original: 1, twin: 10, distance: 0.05 };
const UNKNOWN: usize = 12;
/// The scan with a dead accelerometer: its surface (from 0) and user (from 1).
const DEAD: (usize, u32) = (5, 2);
const DEAD_SOURCE: &str = "ac";

/// The synthetic scene that `surfaced replay` plays if no data are given.
///
/// It holds four trials by the expert of each surface but one, to compare with; and one trial of every
/// surface by each of three users, to be named. Its thirteen surfaces are easy to distinguish, with
/// three difficulties that stations meet and that its remarks name: two surfaces are almost alike, one
/// is not in the library, and a sensor is dead in one scan.
pub fn embedded() -> Library {
    let size = Parameters { surfaces: SURFACES, trials: 4, users: 3, ..Parameters::default() };
    let mut library = library(&Parameters { twins: Some(TWINS), ..size });
    let [original, twin, unknown] = [TWINS.original, TWINS.twin, UNKNOWN].map(surface_name);
    library.entries.retain(|entry| entry.key.surface != unknown || entry.key.user != EXPERT);
    let dead = TrialKey::new(surface_name(DEAD.0), format!("user{}", DEAD.1), DEAD.1);
    let silence = |entry: Entry| match entry.key == dead {
        true => entry.changed(with_a_dead_line),
        false => entry,
    };
    library.entries = library.entries.into_iter().map(silence).collect();
    library.remarks = vec![
        format!("{original} and {twin} are almost alike"),
        format!("{unknown} is not in the library"),
        format!("the accelerometer is dead in the scan of {} by {}", dead.surface, dead.user),
    ];
    library
}

fn with_a_dead_line(mut trial: Trial) -> Trial {
    if let Some(Signal::Series(series)) = trial.signals.get_mut(DEAD_SOURCE) {
        series.view_mut().fill(0.0);
    }
    trial
}
