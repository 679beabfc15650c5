//! A negative control, not a method to use: it names surfaces by the loudness of a trial alone.
//!
//! Its accuracy shows how much the gain of a session or the pressure of a hand reveals.

use std::sync::Arc;

use crate::library::Entry;
use crate::recognise::features::{FeatureVector, SourceFeatures};
use crate::recognise::{
    Candidate, LibraryShape, Method, Model, Prepared, Ranking, RecogniseError, rank,
};
use crate::scene::{Scene, SourceId};
use crate::seed;
use crate::trial::{Signal, Trial};

/// Least root mean square, to keep the logarithm of silence finite; far below a 16-bit step.
const SILENCE: f64 = 1e-12;

/// Compares trials by the level of each source ([`level_of`]). The nearest library trial has the
/// smallest sum, over sources, of absolute differences of level.
#[derive(Clone, Debug)]
pub struct Loudness {
    /// The sources to compare, each with domain `spectrum`.
    scene: Scene,
    /// The levels of the library, once fitted.
    library: Vec<Arc<FeatureVector>>,
}

impl Loudness {
    pub fn new(scene: Scene) -> Self {
        Self { scene, library: Vec::new() }
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
}

const NAME: &str = "control";

impl Method for Loudness {
    fn name(&self) -> &'static str {
        NAME
    }

    fn settings_key(&self, _: &LibraryShape) -> u64 {
        let ids = self.scene.sources().map(|spec| spec.id.as_str().as_bytes());
        seed::stable_hash(&ids.collect::<Vec<_>>())
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
        let library = levels.collect::<Result<_, _>>()?;
        Ok(Arc::new(Self { scene: self.scene.clone(), library }))
    }
}

impl Model for Loudness {
    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<Prepared, RecogniseError> {
        Ok(self.levels(entry, trial))
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
        let comparable = self.library.iter().filter(|_| !sources.is_empty());
        let candidates = comparable.map(candidate).collect();
        rank(candidates, 1, sources).ok_or_else(|| RecogniseError::NothingInCommon {
            query: "no series with a spectrum".into(),
            library: self
                .scene
                .sources()
                .map(|spec| spec.id.as_str())
                .collect::<Vec<_>>()
                .join(", "),
        })
    }
}

/// Level of a series: ln of the root mean square over time and channels, after the mean of each
/// channel was subtracted.
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
        // One channel has level 0.3 and the other is silent, so the root mean square is 0.3/√2.
        assert!((level_of(&samples, 2).exp() - 0.3 / 2f64.sqrt()).abs() < 1e-6);
        assert_eq!(level_of(&[1.0; 8], 2), SILENCE.ln());
    }
}
