//! A negative control, not a method to name surfaces by: how loud a trial is, and nothing else.
//!
//! What it gets right, a session's gain or a hand's pressure may give away as well as a surface.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::library::Entry;
use crate::recognise::{Candidate, Method, Ranking, RecogniseError, rank};
use crate::scene::{Domain, Scene, SourceId};
use crate::trial::{Signal, Trial, TrialKey};

/// Level of silence: far below a 16-bit step, and its logarithm is a number.
const SILENCE: f64 = 1e-12;

/// One nearest trial by the level of each source with a spectrum: ln of its root mean square over
/// time and channels, after its mean is taken out. Differences add up over sources.
#[derive(Clone, Debug)]
pub struct Loudness {
    scene: Scene,
}

impl Loudness {
    /// The control for a scene. `None` if no source has a spectrum.
    pub fn new(scene: &Scene) -> Option<Self> {
        let heard = |spec: &&_| is_heard(spec);
        let ids: Vec<SourceId> = scene.sources().filter(heard).map(|s| s.id.clone()).collect();
        // The scene's own sources, so there is no error to be had.
        let scene = scene.clone().only(&ids).ok()?;
        (!ids.is_empty()).then_some(Self { scene })
    }

    /// The sources that are heard.
    pub fn sources(&self) -> impl Iterator<Item = &SourceId> {
        self.scene.sources().map(|spec| &spec.id)
    }
}

fn is_heard(spec: &crate::scene::SourceSpec) -> bool {
    matches!(spec.domain, Domain::Spectrum { .. })
}

/// A trial's levels.
#[derive(Clone, Debug)]
pub struct Levels {
    key: TrialKey,
    levels: BTreeMap<SourceId, f64>,
}

impl Method for Loudness {
    type Prepared = Levels;
    type Model = Vec<Arc<Levels>>;

    fn name(&self) -> &'static str {
        "control"
    }

    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<Levels, RecogniseError> {
        let level = |(id, signal): (&SourceId, &Signal)| {
            let Signal::Series(series) = signal else { return None };
            self.scene.get(id.as_str())?;
            Some((id.clone(), level_of(series.samples(), series.channels())))
        };
        Ok(Levels {
            key: entry.key.clone(),
            levels: trial.signals.iter().filter_map(level).collect(),
        })
    }

    fn fit(&self, library: Vec<Arc<Levels>>) -> Result<Self::Model, RecogniseError> {
        Ok(library)
    }

    fn rank(&self, model: &Self::Model, query: &Levels) -> Result<Ranking, RecogniseError> {
        let candidate = |y: &Arc<Levels>| {
            let apart = query.levels.iter().map(|(id, z)| match y.levels.get(id) {
                Some(y) => (z - y).abs(),
                None => f64::MAX.ln(),
            });
            Candidate { key: y.key.clone(), log_ds: apart.sum() }
        };
        let sources: Vec<SourceId> = query.levels.keys().cloned().collect();
        let nothing = || RecogniseError::NothingInCommon {
            query: "no series with a spectrum".into(),
            library: self.sources().map(SourceId::as_str).collect::<Vec<_>>().join(", "),
        };
        if sources.is_empty() {
            return Err(nothing());
        }
        rank(model.iter().map(candidate).collect(), 1, sources).ok_or_else(nothing)
    }
}

/// ln of the root mean square over time and channels, each channel's mean taken out.
fn level_of(samples: &[f32], channels: usize) -> f64 {
    let power: f64 = (0..channels)
        .map(|channel| {
            let of_channel = || samples[channel..].iter().step_by(channels).map(|&x| f64::from(x));
            let n = of_channel().count() as f64;
            let mean = of_channel().sum::<f64>() / n;
            of_channel().map(|x| (x - mean).powi(2)).sum::<f64>() / n
        })
        .sum();
    (power / channels as f64).sqrt().max(SILENCE).ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_level_is_that_of_the_root_mean_square_without_the_mean() {
        let samples: Vec<f32> =
            (0..1000).flat_map(|i| [5.0 + if i % 2 == 0 { 0.3 } else { -0.3 }, 0.0]).collect();
        // Of two channels one is silent: 0.3/√2.
        assert!((level_of(&samples, 2).exp() - 0.3 / 2f64.sqrt()).abs() < 1e-6);
        assert_eq!(level_of(&[1.0; 8], 2), SILENCE.ln());
    }

    #[test]
    fn a_scene_without_spectra_has_no_loudness() {
        let scene = Scene::lmt108();
        let heard: Vec<_> = Loudness::new(&scene).unwrap().sources().cloned().collect();
        assert_eq!(heard.iter().map(SourceId::as_str).collect::<Vec<_>>(), ["ac", "mi1", "mi2"]);
        let images = scene.only(&[SourceId::new("ca1").unwrap()]).unwrap();
        assert!(Loudness::new(&images).is_none());
    }
}
