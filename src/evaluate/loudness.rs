//! A negative control, no method for use: names surfaces by the loudness of a trial alone.
//!
//! Its right answers may come from the gain of a session or the pressure of a hand.

use std::sync::Arc;

use crate::library::Entry;
use crate::recognise::features::{FeatureVector, SourceFeatures};
use crate::recognise::{
    Candidate, LibraryShape, Method, Model, Prepared, Ranking, RecogniseError, rank,
};
use crate::scene::{Domain, Scene, SourceId};
use crate::seed;
use crate::trial::{Signal, Trial};

/// Root mean square that stands for silence: far below a 16-bit step, with a finite logarithm.
const SILENCE: f64 = 1e-12;

/// Finds the nearest trial by the level of each source with a spectrum: ln of the root mean square
/// over time and channels, without the mean of each channel. Differences are summed over sources.
#[derive(Clone, Debug)]
pub struct Loudness {
    scene: Scene,
}

impl Loudness {
    /// The control for a scene. `None` if no source has a spectrum.
    pub fn new(scene: &Scene) -> Option<Self> {
        let spectra = scene.sources().filter(|spec| matches!(spec.domain, Domain::Spectrum { .. }));
        let ids: Vec<SourceId> = spectra.map(|spec| spec.id.clone()).collect();
        // The scene has these sources, so this cannot fail.
        let scene = scene.clone().only(&ids).ok()?;
        (!ids.is_empty()).then_some(Self { scene })
    }

    /// The level of each source, as the source's only feature.
    fn levels(&self, entry: &Entry, trial: &Trial) -> Prepared {
        let level = |(id, signal): (&SourceId, &Signal)| {
            let Signal::Series(series) = signal else { return None };
            self.scene.get(id.as_str())?;
            let values = vec![level_of(series.samples(), series.channels())];
            Some((id.clone(), SourceFeatures { values, rate_hz: series.rate_hz() }))
        };
        let sources = trial.signals.iter().filter_map(level).collect();
        Prepared::Features(Arc::new(FeatureVector { key: entry.key.clone(), sources }))
    }

    /// The sources with a spectrum.
    pub fn sources(&self) -> impl Iterator<Item = &SourceId> {
        self.scene.sources().map(|spec| &spec.id)
    }
}

const NAME: &str = "control";

impl Method for Loudness {
    fn name(&self) -> &'static str {
        NAME
    }

    fn settings_key(&self, _: &LibraryShape) -> u64 {
        let sources: Vec<_> = self.sources().map(|id| id.as_str().as_bytes()).collect();
        seed::stable_hash(&sources)
    }

    fn prepare(
        &self,
        entry: &Entry,
        trial: &Trial,
        _: &LibraryShape,
    ) -> Result<Prepared, RecogniseError> {
        Ok(self.levels(entry, trial))
    }

    fn fit(
        &self,
        library: Vec<Prepared>,
        _: &Arc<LibraryShape>,
    ) -> Result<Arc<dyn Model>, RecogniseError> {
        let levels = library.iter().map(|trial| trial.features(NAME).cloned());
        Ok(Arc::new(Levels { method: self.clone(), library: levels.collect::<Result<_, _>>()? }))
    }
}

/// The levels of a library.
struct Levels {
    method: Loudness,
    library: Vec<Arc<FeatureVector>>,
}

impl Model for Levels {
    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<Prepared, RecogniseError> {
        Ok(self.method.levels(entry, trial))
    }

    fn rank(&self, query: &Prepared) -> Result<Ranking, RecogniseError> {
        let query = query.features(NAME)?;
        let candidate = |y: &Arc<FeatureVector>| {
            let apart = query.sources.iter().map(|(id, z)| match y.sources.get(id) {
                Some(y) => (z.values[0] - y.values[0]).abs(),
                None => f64::MAX.ln(),
            });
            Candidate { key: y.key.clone(), log_ds: apart.sum() }
        };
        let sources: Vec<SourceId> = query.sources.keys().cloned().collect();
        let nothing = || RecogniseError::NothingInCommon {
            query: "no series with a spectrum".into(),
            library: self.method.sources().map(SourceId::as_str).collect::<Vec<_>>().join(", "),
        };
        if sources.is_empty() {
            return Err(nothing());
        }
        rank(self.library.iter().map(candidate).collect(), 1, sources).ok_or_else(nothing)
    }
}

/// ln of the root mean square over time and channels, without the mean of each channel.
pub(super) fn level_of(samples: &[f32], channels: usize) -> f64 {
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
        let sounds: Vec<_> = Loudness::new(&scene).unwrap().sources().cloned().collect();
        assert_eq!(sounds.iter().map(SourceId::as_str).collect::<Vec<_>>(), ["ac", "mi1", "mi2"]);
        let images = scene.only(&[SourceId::new("ca1").unwrap()]).unwrap();
        assert!(Loudness::new(&images).is_none());
    }
}
