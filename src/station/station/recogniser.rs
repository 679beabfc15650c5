//! Names scans by comparing them with a library, using any method.

use std::cell::LazyCell;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use serde::{Serialize, Serializer};

use super::account;
use super::answer::{Answer, levels};
use super::certainty::{judge, lost_in, unknown_share};
use crate::library::Entry;
use crate::recognise::{
    Evidence, FollowOptions, Follower, Model, Prepared, RankedSurface, Ranking, RecogniseError,
    Rejection, RejectionError, Settling, SourceEvidence, without_flawed,
};
use crate::scan::Scan;
use crate::scene::{Scene, SourceId};
use crate::trial::{Doubt, Signal, TrialKey, flaws_of};

/// The flaws of a scan's series.
pub(super) type FlawsBySource = BTreeMap<SourceId, Vec<Doubt>>;

/// A function that reads the library from disk each time it is called.
pub type Load = Arc<dyn Fn() -> Result<Arc<Recogniser>, String> + Send + Sync>;

/// A library with its models, ready to name scans.
pub struct Recogniser {
    models: Vec<Arc<dyn Model>>,
    model_of: BTreeMap<TrialKey, usize>,
    following: Vec<FollowOptions>,
    /// How long a drag should last, in seconds; `None` if that is not known.
    pub needed_s: Option<f64>,
    pub(super) scene: Scene,
    pub library: LibraryState,
    /// The library's trials, which are read when the one nearest to a scan is shown.
    pub(crate) trials: BTreeMap<TrialKey, Entry>,
}

impl Recogniser {
    pub fn new(model: Arc<dyn Model>, scene: Scene, library: LibraryState) -> Self {
        Self::with_folds(vec![model], BTreeMap::new(), scene, library)
    }

    /// Names each recorded scan by the model of its fold, as listed in `model_of`. The first model
    /// names all other scans.
    ///
    /// # Panics
    /// If there is no model, or an index in `model_of` is out of range.
    pub fn with_folds(
        models: Vec<Arc<dyn Model>>,
        model_of: BTreeMap<TrialKey, usize>,
        scene: Scene,
        library: LibraryState,
    ) -> Self {
        assert!(!models.is_empty() && model_of.values().all(|at| *at < models.len()));
        let following = vec![FollowOptions::default(); models.len()];
        let (needed_s, trials) = (None, BTreeMap::new());
        Self { models, model_of, following, needed_s, scene, library, trials }
    }

    pub fn with_trials(mut self, entries: &[Entry]) -> Self {
        self.trials = entries.iter().map(|entry| (entry.key.clone(), entry.clone())).collect();
        self
    }

    /// From now on, calls a scan unknown if it fits no surface, at this rate of false alarms
    /// (`None` for the default rate). Returns the threshold of each model.
    ///
    /// # Errors
    /// If the method gives no p-value, or a library has too few trials.
    pub fn reject_unknown(&mut self, rate: Option<f64>) -> Result<Vec<Rejection>, RejectionError> {
        let rejection = |model: &Arc<dyn Model>| {
            model.clone().embedding().ok_or(RejectionError::NoPValue)?.rejection(rate)
        };
        let rejections = self.models.iter().map(rejection);
        let rejections: Vec<Rejection> = rejections.collect::<Result<_, _>>()?;
        for (following, rejection) in self.following.iter_mut().zip(&rejections) {
            following.rejection = Some(rejection.clone());
        }
        Ok(rejections)
    }

    /// Finds for each model, before any scan, when an answer counts as settled, given this loss of
    /// accuracy. The result is empty if the method cannot follow scans.
    pub fn calibrate(&mut self, loss: f64) -> Vec<Settling> {
        self.following.iter_mut().for_each(|following| following.loss = loss);
        let with_options = self.models.iter().zip(&self.following);
        let settling = with_options.filter_map(|(model, options)| {
            Some(model.clone().embedding()?.follow(options).settling().clone())
        });
        let settling = settling.collect();
        // With folds, each model has a library of its own.
        if let [model] = &self.models[..] {
            let each = model.clone().embedding().map(|model| model.left_out_of_each());
            self.library.left_out = each.unwrap_or_default();
        }
        settling
    }

    /// A scan's model, made without the scan if `truth` names a trial, and the options to follow it.
    fn model(&self, truth: Option<&TrialKey>) -> (&Arc<dyn Model>, &FollowOptions) {
        let at = truth.and_then(|key| self.model_of.get(key)).copied().unwrap_or(0);
        (&self.models[at], &self.following[at])
    }

    /// The rule by which a scan with this [`Scan::truth`] is called unknown, if there is one.
    pub(super) fn rejection(&self, truth: Option<&TrialKey>) -> Option<&Rejection> {
        self.model(truth).1.rejection.as_ref()
    }

    /// The flaws of a scan's signals, except of switches, which often rest; `known` flaws are reused.
    fn flaws(&self, scan: &Scan, mut known: FlawsBySource) -> Vec<Doubt> {
        let signals = scan.trial.signals.iter().filter(|(id, _)| !self.scene.is_switch(id));
        let of = |(id, signal): (&SourceId, &Signal)| {
            let known = known.remove(id);
            known.unwrap_or_else(|| self.flaws_of(scan.truth.as_ref(), id, signal))
        };
        signals.flat_map(of).collect()
    }

    /// The flaws of one source in a scan of this [`Scan::truth`], judged by the library that names it.
    pub(crate) fn flaws_of(
        &self,
        truth: Option<&TrialKey>,
        id: &SourceId,
        signal: &Signal,
    ) -> Vec<Doubt> {
        let embedding = self.model(truth).0.clone().embedding();
        let rests = embedding.as_ref().map_or(&[][..], |embedding| embedding.rests(id));
        flaws_of(id, signal, rests)
    }

    /// The flaws in the part of a scan that was followed.
    pub(super) fn flaws_so_far(&self, follower: &Follower) -> Vec<Doubt> {
        let sources = self.library.sources.iter().filter(|id| !self.scene.is_switch(id));
        sources.filter_map(|id| follower.doubts(id)).flatten().collect()
    }

    /// Ranks the surfaces of the library by their similarity to a scan.
    ///
    /// # Errors
    /// If the scan has no source in common with the library, or does not fit the scene.
    pub fn rank(&self, scan: &Scan) -> Result<Ranking, RecogniseError> {
        self.model(scan.truth.as_ref()).0.rank(&self.query(scan)?.0)
    }

    /// Prepares a scan as a query for its model. Sources with flaws are left out; there is a doubt for
    /// each of them.
    fn query(&self, scan: &Scan) -> Result<(Prepared, Vec<Doubt>), RecogniseError> {
        let (model, _) = self.model(scan.truth.as_ref());
        let embedding = LazyCell::new(|| model.clone().embedding());
        let rests = |id: &SourceId| (*embedding).as_ref().map_or(&[][..], |model| model.rests(id));
        let (trial, left_out) = without_flawed(scan.trial.clone(), &self.scene, rests);
        let trial = Arc::new(trial);
        Ok((model.prepare(&Entry::in_memory(trial.clone()), &trial)?, left_out))
    }

    /// Explains the name of a scan: what each source says, and the nearest trial. Takes about as
    /// long as naming the scan.
    ///
    /// # Errors
    /// Those of [`Recogniser::rank`].
    pub fn explain(&self, scan: &Scan) -> Result<Why, RecogniseError> {
        let (model, following) = self.model(scan.truth.as_ref());
        let (query, mut left_out) = self.query(scan)?;
        let (ranking, evidence) = (model.rank(&query)?, model.explain(&query)?);
        left_out.extend(self.missing(scan));
        Ok(Why::new(ranking, evidence.as_ref(), following.rejection.as_ref(), left_out))
    }

    /// A doubt for each source of the library that a scan does not have.
    fn missing(&self, scan: &Scan) -> impl Iterator<Item = Doubt> {
        let lacks = |id: &&SourceId| !scan.trial.signals.contains_key(*id);
        let lacking = self.library.sources.iter().filter(lacks);
        lacking.map(|id| Doubt::SourceMissing { source: id.clone() })
    }

    /// The answer to a scan with this ranking; `known` are the flaws found while the scan was followed,
    /// and `settled_s` is when the answer was settled.
    pub(super) fn answer(
        &self,
        scan: &Scan,
        ranking: Ranking,
        known: FlawsBySource,
        settled_s: Option<f64>,
    ) -> Answer {
        let rejection = self.rejection(scan.truth.as_ref());
        let mut doubts = lost_in(scan);
        doubts.extend(self.flaws(scan, known));
        let held = self.library.sources.iter().filter(|id| scan.trial.signals.contains_key(*id));
        let not_compared = held.filter(|id| !ranking.sources.contains(id));
        doubts.extend(not_compared.map(|id| Doubt::NotCompared { source: id.clone() }));
        doubts.extend(self.missing(scan));
        let mut answer = Answer {
            margin: ranking.margin,
            confidence: ranking.confidence,
            p_value: ranking.p_value,
            unknown: unknown_share(ranking.p_value, rejection),
            settled_s,
            sources: ranking.sources,
            levels: if self.library.reference.is_empty() { Vec::new() } else { levels(scan) },
            needed_s: self.needed_s,
            doubts,
            ranked: ranking.ranked,
            ..Answer::of(scan, 0.0)
        };
        judge(&mut answer, rejection);
        answer
    }

    /// Starts to follow a scan with this [`Scan::truth`]; `None` if the method cannot follow scans.
    pub fn follow(&self, truth: Option<&TrialKey>) -> Option<Follower> {
        let (model, following) = self.model(truth);
        Some(model.clone().embedding()?.follow(following))
    }
}

fn as_left_out<S: Serializer>(
    left_out: &BTreeMap<String, (usize, usize)>,
    to: S,
) -> Result<S::Ok, S::Error> {
    let row = |(surface, (trials, right)): (_, &_)| serde_json::json!({ "surface": surface, "trials": trials, "right": right });
    to.collect_seq(left_out.iter().map(row))
}

fn as_rows<S: Serializer>(surfaces: &[(String, usize)], to: S) -> Result<S::Ok, S::Error> {
    let row = |(surface, trials): &_| serde_json::json!({ "surface": surface, "trials": trials });
    to.collect_seq(surfaces.iter().map(row))
}

#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct LibraryState {
    /// The name of the library, or of its folder.
    pub name: String,
    /// The surfaces, sorted, each with its number of trials.
    #[serde(serialize_with = "as_rows")]
    pub surfaces: Vec<(String, usize)>,
    pub sources: Vec<SourceId>,
    /// The reference surfaces, each with the moment from which its scans count, in milliseconds since 1970.
    /// JSON lacks it if there are none.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub reference: BTreeMap<String, u64>,
    /// Of each surface, how many of its trials were left out, one group after another, and how many of
    /// these the rest of the library named right. JSON lacks it if none could be.
    #[serde(skip_serializing_if = "BTreeMap::is_empty", serialize_with = "as_left_out")]
    pub left_out: BTreeMap<String, (usize, usize)>,
    pub synthetic: bool,
    /// The reason why scans cannot be named, if there is one.
    pub problem: Option<String>,
    /// The basis of answers, a line each.
    pub remarks: Vec<String>,
}

impl LibraryState {
    pub fn of(name: &str, entries: &[Entry], synthetic: bool) -> Self {
        let (mut surfaces, mut sources) = (BTreeMap::new(), BTreeSet::new());
        for entry in entries {
            *surfaces.entry(entry.key.surface.clone()).or_insert(0) += 1;
            sources.extend(entry.sources.iter().cloned());
        }
        Self {
            name: name.to_string(),
            surfaces: surfaces.into_iter().collect(),
            sources: sources.into_iter().collect(),
            synthetic,
            ..Self::default()
        }
    }

    pub(super) fn trials_of(&self, surface: &str) -> usize {
        self.surfaces.iter().find(|(name, _)| name == surface).map_or(0, |(_, trials)| *trials)
    }
}

/// Explains the name of a scan by the vote of each source, the threshold, and the nearest trial.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Why {
    pub winner: String,
    pub runner_up: Option<String>,
    /// The sources, those that favour the winner most first; empty if the method cannot separate them.
    pub sources: Vec<SourceSays>,
    /// Why sources were not compared; in JSON also as lines, `left_out`.
    #[serde(flatten, serialize_with = "account::of_left_out")]
    pub left_out: Vec<Doubt>,
    pub p_value: Option<f64>,
    /// The p-value at or below which a scan is unknown; `None` if unknown surfaces are not detected.
    pub threshold: Option<f64>,
    /// Number of left-out trials from which the threshold was computed.
    pub threshold_trials: Option<usize>,
    pub surfaces: usize,
    pub nearest: TrialKey,
    pub ranked: Vec<RankedSurface>,
}

/// How one source judges the winner and the runner-up (the second surface).
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SourceSays {
    pub source: SourceId,
    /// Natural logarithm of the odds for the winner against the runner-up, by this source alone;
    /// negative if it favours the runner-up. `None` if either surface lacks the source.
    pub for_winner: Option<f64>,
    /// The surface that this source alone would name.
    pub alone: Option<String>,
}

impl Why {
    pub(crate) fn new(
        ranking: Ranking,
        evidence: Option<&Evidence>,
        rejection: Option<&Rejection>,
        left_out: Vec<Doubt>,
    ) -> Self {
        let winner = ranking.surface().to_string();
        let runner_up = ranking.ranked.get(1).map(|second| second.surface.clone());
        let mut sources: Vec<SourceSays> =
            evidence.map_or_else(Vec::new, |all| says(all, &winner, runner_up.as_deref()));
        sources.sort_by(|a, b| {
            let order = |says: &SourceSays| says.for_winner.unwrap_or(f64::NEG_INFINITY);
            order(b).total_cmp(&order(a))
        });
        Self {
            winner,
            runner_up,
            sources,
            left_out,
            p_value: ranking.p_value,
            threshold: rejection.map(|rejection| rejection.rate),
            threshold_trials: rejection.map(|rejection| rejection.trials),
            surfaces: ranking.ranked.len(),
            nearest: ranking.nearest,
            ranked: ranking.ranked,
        }
    }
}

fn says(evidence: &Evidence, winner: &str, runner_up: Option<&str>) -> Vec<SourceSays> {
    let Evidence { surfaces, sources } = evidence;
    let at = |surface: &str| surfaces.iter().position(|other| other == surface);
    let (first, second) = (at(winner), runner_up.and_then(at));
    let of = |source: &SourceEvidence| {
        let term = |index: Option<usize>| index.map(|i| source.terms[i]).filter(|t| t.is_finite());
        let finite = (0..surfaces.len()).filter(|&i| source.terms[i].is_finite());
        let alone = finite.min_by(|&a, &b| source.terms[a].total_cmp(&source.terms[b]));
        SourceSays {
            source: source.source.clone(),
            for_winner: term(second).zip(term(first)).map(|(second, first)| second - first),
            alone: alone.map(|i| surfaces[i].clone()),
        }
    };
    sources.iter().map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sources_speak_for_the_winner_or_the_runner_up() {
        let source = |id: &str, terms: [f64; 3]| SourceEvidence {
            source: SourceId::new(id).unwrap(),
            terms: terms.into(),
        };
        let evidence = Evidence {
            surfaces: ["ash", "elm", "oak"].map(String::from).into(),
            sources: vec![
                source("ir", [1.0, f64::INFINITY, 2.0]),
                source("mi2", [7.0, 0.5, 1.0]),
                source("ac", [9.0, f64::INFINITY, f64::INFINITY]),
            ],
        };
        let ranked = ["oak", "ash"].map(|s| RankedSurface { surface: s.into(), score: 1.0 });
        let ranking = Ranking {
            ranked: ranked.into(),
            margin: 1.0,
            sources: Vec::new(),
            nearest: TrialKey::new("oak", "expert", 1),
            confidence: None,
            p_value: None,
        };
        let why = Why::new(ranking, Some(&evidence), None, Vec::new());
        let said: Vec<_> = why
            .sources
            .iter()
            .map(|s| (s.source.as_str(), s.for_winner, s.alone.as_deref().unwrap()))
            .collect();
        let expected = [("mi2", Some(6.0), "elm"), ("ir", Some(-1.0), "ash"), ("ac", None, "ash")];
        assert_eq!(said, expected);
    }
}
