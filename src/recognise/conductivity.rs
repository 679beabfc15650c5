//! Only surfaces of matching conductivity are compared, as the paper suggests for large libraries:
//! a query in which the metal detector saw metal is ranked among the surfaces of which some trial
//! did, and one in which it saw none among those of which some trial did not.
//!
//! Nothing is left out for want of knowledge: a trial without the source may be either.

use std::collections::BTreeSet;
use std::sync::Arc;

use super::{Follow, FollowOptions, Method, Ranking, RecogniseError, Rejection, RejectionError};
use crate::library::Entry;
use crate::scene::{Domain, Scene, SourceId, SourceSpec};
use crate::seed;
use crate::trial::{Signal, Trial};

/// The scene's metal detector, if it has one: the first source of domain `time` that is a switch,
/// one with a fixed length scale.
pub fn metal_detector(scene: &Scene) -> Option<&SourceId> {
    let is_switch =
        |spec: &&SourceSpec| spec.sigma.is_some() && matches!(spec.domain, Domain::Time);
    scene.sources().find(is_switch).map(|spec| &spec.id)
}

/// A method that ranks surfaces of matching conductivity alone.
pub struct ByConductivity<M> {
    method: M,
    detector: SourceId,
}

/// A prepared trial, and whether metal was seen.
pub struct Sorted<P> {
    surface: String,
    conducts: Option<bool>,
    prepared: Arc<P>,
}

/// Models of the whole library and of the surfaces that may be either; those that would hold all
/// surfaces, or fewer than two, are the model of the whole.
pub struct SortedModels<M> {
    all: Arc<M>,
    without_metal: Option<M>,
    with_metal: Option<M>,
}

impl<M> ByConductivity<M> {
    /// `method`, told by a detector that reads 0 or 1.
    pub fn new(method: M, detector: SourceId) -> Self {
        Self { method, detector }
    }

    /// Whether the detector saw metal at any time.
    fn conducts(&self, trial: &Trial) -> Option<bool> {
        match trial.signals.get(&self.detector)? {
            Signal::Series(series) => Some(series.samples().iter().any(|x| *x > 0.5)),
            Signal::Image(_) => None,
        }
    }
}

impl<M: Method> ByConductivity<M> {
    fn sorted(
        &self,
        entry: &Entry,
        conducts: Option<bool>,
        prepared: M::Prepared,
    ) -> Sorted<M::Prepared> {
        Sorted { surface: entry.key.surface.clone(), conducts, prepared: Arc::new(prepared) }
    }

    /// The model of those surfaces of which some trial may be like this, if they are not all.
    fn part(&self, library: &[Arc<Sorted<M::Prepared>>], conducts: bool) -> Option<M::Model> {
        let surfaces = |wanted: &dyn Fn(&Sorted<M::Prepared>) -> bool| -> BTreeSet<&str> {
            library.iter().filter(|t| wanted(t)).map(|t| t.surface.as_str()).collect()
        };
        let alike = surfaces(&|trial| trial.conducts != Some(!conducts));
        if alike.len() < 2 || alike.len() == surfaces(&|_| true).len() {
            return None;
        }
        let of_part = library.iter().filter(|trial| alike.contains(trial.surface.as_str()));
        self.method.fit(of_part.map(|trial| trial.prepared.clone()).collect()).ok()
    }
}

impl<M: Method> Method for ByConductivity<M> {
    type Prepared = Sorted<M::Prepared>;
    type Model = SortedModels<M::Model>;

    fn name(&self) -> &'static str {
        self.method.name()
    }

    fn prepare(&self, entry: &Entry, trial: &Trial) -> Result<Self::Prepared, RecogniseError> {
        Ok(self.sorted(entry, self.conducts(trial), self.method.prepare(entry, trial)?))
    }

    fn prepare_for_library(
        &self,
        entry: &Entry,
        trial: &Trial,
    ) -> Result<Self::Prepared, RecogniseError> {
        let prepared = self.method.prepare_for_library(entry, trial)?;
        Ok(self.sorted(entry, self.conducts(trial), prepared))
    }

    fn storage_key(&self) -> Option<u64> {
        let key = self.method.storage_key()?.to_le_bytes();
        Some(seed::stable_hash(&[b"by conductivity", &key, self.detector.as_str().as_bytes()]))
    }

    fn store(&self, prepared: &Self::Prepared) -> Vec<u8> {
        let mut bytes = self.method.store(&prepared.prepared);
        bytes.push(prepared.conducts.map_or(2, u8::from));
        bytes
    }

    fn restore(&self, entry: &Entry, bytes: &[u8]) -> Option<Self::Prepared> {
        let (conducts, bytes) = bytes.split_last()?;
        let conducts = match conducts {
            0 => Some(false),
            1 => Some(true),
            2 => None,
            _ => return None,
        };
        Some(self.sorted(entry, conducts, self.method.restore(entry, bytes)?))
    }

    fn fit(&self, library: Vec<Arc<Self::Prepared>>) -> Result<Self::Model, RecogniseError> {
        let (without_metal, with_metal) = (self.part(&library, false), self.part(&library, true));
        let all = library.iter().map(|trial| trial.prepared.clone()).collect();
        Ok(SortedModels { all: Arc::new(self.method.fit(all)?), without_metal, with_metal })
    }

    fn rank(&self, model: &Self::Model, query: &Self::Prepared) -> Result<Ranking, RecogniseError> {
        let part = match query.conducts {
            Some(true) => model.with_metal.as_ref(),
            Some(false) => model.without_metal.as_ref(),
            None => None,
        };
        self.method.rank(part.unwrap_or(&model.all), &query.prepared)
    }

    /// By the whole library: metal may yet be seen.
    fn follow(&self, model: &Arc<Self::Model>, options: &FollowOptions) -> Option<Box<dyn Follow>> {
        self.method.follow(&model.all, options)
    }

    fn rejection(&self, model: &Self::Model, rate: f64) -> Result<Rejection, RejectionError> {
        self.method.rejection(&model.all, rate)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::synth::{self, Parameters};
    use crate::recognise::{Reference, ReferenceOptions};

    /// Two surfaces that conduct, two that do not, and one that does now and then.
    fn library() -> (Scene, Vec<Entry>) {
        let parameters = Parameters {
            surfaces: 5,
            trials: 2,
            users: 0,
            drag_seconds: 0.3,
            ..Parameters::default()
        };
        let made = synth::library(&parameters);
        let ids = ["ir", "me"].map(|id| SourceId::new(id).unwrap());
        let scene = made.scene.only(&ids).unwrap();
        let mut surfaces: Vec<String> =
            made.entries.iter().map(|entry| entry.key.surface.clone()).collect();
        surfaces.sort();
        surfaces.dedup();
        let change = |entry: Entry| {
            let place = surfaces.iter().position(|s| *s == entry.key.surface).unwrap();
            let metal = place < 2 || (place == 4 && entry.key.number == 1);
            entry.within(&scene).changed(move |mut trial| {
                if let Some(Signal::Series(series)) =
                    trial.signals.get_mut(&SourceId::new("me").unwrap())
                {
                    let mut samples = vec![0.0; series.samples().len()];
                    samples[7] = if metal { 1.0 } else { 0.0 };
                    *series = crate::trial::Series::new(series.rate_hz(), 1, samples).unwrap();
                }
                trial
            })
        };
        let entries = made.entries.into_iter().map(change).collect();
        (scene, entries)
    }

    fn sorted(scene: &Scene) -> ByConductivity<Reference> {
        let method = Reference::new(scene.clone(), ReferenceOptions::default());
        ByConductivity::new(method, metal_detector(scene).unwrap().clone())
    }

    fn ranked(method: &impl Method, entries: &[Entry], query: usize) -> Vec<(String, f64)> {
        let prepare = |entry: &Entry| method.prepare(entry, &entry.load().unwrap()).unwrap();
        let others = entries.iter().enumerate().filter(|(i, _)| *i != query);
        let model = method.fit(others.map(|(_, e)| Arc::new(prepare(e))).collect()).unwrap();
        let ranking = method.rank(&model, &prepare(&entries[query])).unwrap();
        ranking.ranked.into_iter().map(|r| (r.surface, r.score)).collect()
    }

    #[test]
    fn the_ranking_is_that_of_all_without_those_that_cannot_be() {
        let (scene, entries) = library();
        let plain = || Reference::new(scene.clone(), ReferenceOptions::default());
        let sorted = sorted(&scene);
        for (query, entry) in entries.iter().enumerate() {
            let conducts = sorted.conducts(&entry.load().unwrap()).unwrap();
            let may_be = |surface: &str| {
                let others = entries
                    .iter()
                    .enumerate()
                    .filter(|(i, e)| *i != query && e.key.surface == surface);
                others
                    .into_iter()
                    .any(|(_, e)| sorted.conducts(&e.load().unwrap()) == Some(conducts))
            };
            let expected: Vec<_> = (ranked(&plain(), &entries, query).into_iter())
                .filter(|(surface, _)| may_be(surface))
                .collect();
            assert!(expected.len() < 5);
            assert_eq!(ranked(&sorted, &entries, query), expected, "{}", entry.key);
        }
    }

    #[test]
    fn where_nothing_is_known_all_surfaces_are_compared() {
        let (scene, entries) = library();
        let without = scene.clone().only(&[SourceId::new("ir").unwrap()]).unwrap();
        assert_eq!(metal_detector(&without), None);
        let mut entries = entries;
        entries[0] = entries[0].clone().within(&without);
        assert_eq!(ranked(&sorted(&scene), &entries, 0).len(), 5);
    }

    #[test]
    fn what_is_stored_is_restored() {
        let (scene, entries) = library();
        let method = sorted(&scene);
        let prepared = method.prepare(&entries[0], &entries[0].load().unwrap()).unwrap();
        let bytes = method.store(&prepared);
        let again = method.restore(&entries[0], &bytes).unwrap();
        assert_eq!((again.conducts, method.store(&again)), (prepared.conducts, bytes));
        assert!(
            method.restore(&entries[0], &[]).is_none()
                && method.restore(&entries[0], &[9]).is_none()
        );
    }
}
