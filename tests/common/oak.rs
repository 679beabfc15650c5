//! A method that names every scan oak, for tests of what its parts may do to a station.

use std::any::Any;
use std::collections::BTreeMap;
use std::sync::Arc;

use surfaced::features::FeatureVector;
use surfaced::library::Entry;
use surfaced::recognise::{Evidence, Model, Prepared, RankedSurface, Ranking, RecogniseError};
use surfaced::trial::{Trial, TrialKey};

/// Calls its function with the name of each of its parts when it is reached.
pub struct Oak<F>(pub F);

impl<F: Fn(&str) + Send + Sync + 'static> Model for Oak<F> {
    fn explain(&self, _: &Prepared) -> Result<Option<Evidence>, RecogniseError> {
        (self.0)("explain");
        Ok(None)
    }

    fn prepare(&self, entry: &Entry, _: &Trial) -> Result<Prepared, RecogniseError> {
        (self.0)("prepare");
        let (key, sources) = (entry.key.clone(), BTreeMap::new());
        Ok(Prepared::Features(Arc::new(FeatureVector { key, sources })))
    }

    fn rank(&self, _: &Prepared) -> Result<Ranking, RecogniseError> {
        (self.0)("rank");
        Ok(Ranking {
            ranked: vec![RankedSurface { surface: "oak".into(), score: 1.0 }],
            margin: 0.0,
            sources: Vec::new(),
            nearest: TrialKey::new("oak", "", 1),
            confidence: None,
            p_value: None,
        })
    }

    // A station calibrates it when the first scan is followed.
    fn as_any(self: Arc<Self>) -> Option<Arc<dyn Any + Send + Sync>> {
        (self.0)("follow");
        None
    }
}
