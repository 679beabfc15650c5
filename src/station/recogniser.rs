//! Names scans by comparing them with a library, with any method.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use serde::Serialize;

use super::answer::{AnswerState, Damage};
use super::certainty::so_far;
use super::why::Why;
use crate::library::Entry;
use crate::recognise::{
    FollowOptions, Follower, GuessSoFar, LOOK_S, Model, Prepared, Ranking, RecogniseError,
    Rejection, RejectionError, Settling, without_flawed,
};
use crate::scan::Scan;
use crate::scene::{Scene, SourceId};
use crate::trial::{Flaw, Signal, TrialKey, flaws};

/// The result of comparing a scan with a library.
#[derive(Clone, Debug, PartialEq)]
pub struct Verdict {
    /// The library's surfaces, the most similar first.
    pub ranking: Ranking,
    /// The p-value at or below which the scan is unknown; `None` without such a threshold.
    pub rejection: Option<Rejection>,
    /// Sources that were not compared, and the reasons, a line each.
    pub left_out: Vec<String>,
    /// Sources of the library that the scan does not have.
    pub lacking: Vec<SourceId>,
    /// How long the drag should last, in seconds, where that is known.
    pub needed_s: Option<f64>,
    /// Imperfections of the scan.
    pub remarks: Vec<Remark>,
    /// Damage of its sources.
    pub damage: Vec<Damage>,
}

impl Verdict {
    /// Whether the scan fits no surface of the library.
    pub fn is_unknown(&self) -> bool {
        let test = self.ranking.p_value.zip(self.rejection.as_ref());
        test.is_some_and(|(p, rejection)| rejection.rejects(p))
    }
}

/// The flaws of series, by their sources.
pub type FlawsBySource = BTreeMap<SourceId, Vec<Flaw>>;

/// The ranking of a scan, and the flaws that were found while it was followed.
pub struct Ranked {
    /// The library's surfaces.
    pub ranking: Ranking,
    /// Flaws of the sources that were followed; of others nothing is known yet.
    pub flaws: FlawsBySource,
}

/// Reads the library anew at each call.
pub type Load = Arc<dyn Fn() -> Result<Arc<Recogniser>, String> + Send + Sync>;

/// A library, ready to name scans.
pub struct Recogniser {
    models: Vec<Arc<dyn Model>>,
    model_of: BTreeMap<TrialKey, usize>,
    /// The options for following scans with each model.
    following: Vec<FollowOptions>,
    /// How long scans must last, in seconds, where that is known.
    needed_s: Option<f64>,
    scene: Scene,
    library: LibraryState,
    trials: BTreeMap<TrialKey, Entry>,
}

impl Recogniser {
    /// Names scans of a scene by one model.
    pub fn new(model: Arc<dyn Model>, scene: Scene, library: LibraryState) -> Self {
        Self::with_folds(vec![model], BTreeMap::new(), scene, library)
    }

    /// Names each recorded scan by the model of its fold; those not in `model_of`, by the first
    /// model.
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

    /// Sets how long scans must last, in seconds, where that is known.
    pub fn lasting(self, needed_s: Option<f64>) -> Self {
        Self { needed_s, ..self }
    }

    /// Sets where the library's trials are, so that the one nearest to a scan can be shown.
    pub fn with_trials(mut self, entries: &[Entry]) -> Self {
        self.trials = entries.iter().map(|entry| (entry.key.clone(), entry.clone())).collect();
        self
    }

    /// From now on, calls a scan that fits no surface unknown, at this rate of false alarms (the
    /// usual one for `None`). Returns the threshold of each model and its basis.
    ///
    /// # Errors
    /// If the method gives no p-value, or a library has too few trials; no scan is called
    /// unknown then.
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

    /// Finds ahead of all scans when answers are settled with each model, at this loss of accuracy.
    /// Empty if the method cannot follow scans.
    pub fn calibrate(&mut self, loss: f64) -> Vec<Settling> {
        self.following.iter_mut().for_each(|following| following.loss = loss);
        let with_options = self.models.iter().zip(&self.following);
        let settling = with_options.filter_map(|(model, options)| {
            Some(model.clone().embedding()?.follow(options).settling().clone())
        });
        settling.collect()
    }

    /// Adds remarks on the basis of answers to those of the library.
    pub(crate) fn add_remarks(&mut self, remarks: &[String]) {
        self.library.remarks.extend_from_slice(remarks);
    }

    /// The index of a scan's model. The truth only serves to choose the model made without it.
    fn model(&self, truth: Option<&TrialKey>) -> usize {
        truth.and_then(|key| self.model_of.get(key)).copied().unwrap_or(0)
    }

    /// Whether a source is a switch, which rests most of the time: its length scale is fixed.
    fn is_switch(&self, id: &SourceId) -> bool {
        self.scene.get(id.as_str()).is_some_and(|spec| spec.sigma.is_some())
    }

    /// The flaws of all series of a scan, except of switches; `known` holds those already found.
    fn flaws(&self, scan: &Scan, mut known: FlawsBySource) -> FlawsBySource {
        known.retain(|id, _| !self.is_switch(id));
        for (id, signal) in scan.trial.signals.iter().filter(|(id, _)| !self.is_switch(id)) {
            if let Signal::Series(series) = signal {
                known.entry(id.clone()).or_insert_with(|| flaws(series));
            }
        }
        known
    }

    /// The damage of sources by their flaws; `truth` as in [`Scan::truth`].
    fn damage(&self, truth: Option<&TrialKey>, flaws: &FlawsBySource) -> Vec<Damage> {
        let of = |(id, found): (&SourceId, &Vec<Flaw>)| {
            Damage::of_source(id, found, |channel| self.moves(truth, id, channel))
        };
        flaws.iter().filter_map(of).collect()
    }

    /// Whether a channel (counted from 0) ever changes in the library; `truth` as in
    /// [`Scan::truth`].
    pub(super) fn moves(&self, truth: Option<&TrialKey>, id: &SourceId, channel: usize) -> bool {
        let embedding = self.models[self.model(truth)].clone().embedding();
        embedding.is_none_or(|embedding| embedding.moves(id, channel))
    }

    /// The damage of a scan in progress.
    pub(super) fn damage_so_far(
        &self,
        truth: Option<&TrialKey>,
        follower: &Follower,
    ) -> Vec<Damage> {
        let sources = self.library.sources.iter().filter(|id| !self.is_switch(id));
        let found = sources.filter_map(|id| Some((id.clone(), follower.flaws(id)?))).collect();
        self.damage(truth, &found)
    }

    /// The state of the answer if the scan in progress ended now; `None` as long as it cannot be
    /// told whether the surface is unknown.
    pub(super) fn state_so_far(
        &self,
        truth: Option<&TrialKey>,
        guess: &GuessSoFar,
    ) -> Option<AnswerState> {
        let (_, probability) = guess.named.first()?;
        so_far(guess.p_value, self.following[self.model(truth)].rejection.as_ref(), *probability)
    }

    /// Remarks on the flaws of the scan's channels, and on a drag that is too short.
    fn remarks(&self, scan: &Scan, ranking: &Ranking, flaws: &FlawsBySource) -> Vec<Remark> {
        let mut remarks = Vec::new();
        for (id, found) in flaws {
            let left_out =
                if ranking.sources.contains(id) { "" } else { "; the source is left out" };
            remarks.extend(found.iter().map(|flaw| Remark {
                kind: RemarkKind::Flaw,
                source: Some(id.clone()),
                text: format!("{id}: {flaw}{left_out}"),
            }));
        }
        remarks.extend(self.needed_s.filter(|s| scan.scan_s < s - 0.5 * LOOK_S).map(|needed_s| {
            Remark {
                kind: RemarkKind::Short,
                source: None,
                text: format!(
                    "the drag was short: {:.1} s, and this library needs {needed_s:.1} s",
                    scan.scan_s
                ),
            }
        }));
        remarks
    }

    /// Ranks the surfaces for a scan.
    ///
    /// # Errors
    /// If the scan has no source in common with the library, or does not fit the scene.
    pub fn rank(&self, scan: &Scan) -> Result<Ranked, RecogniseError> {
        let ranking = self.models[self.model(scan.truth.as_ref())].rank(&self.query(scan)?.0)?;
        Ok(Ranked { ranking, flaws: FlawsBySource::new() })
    }

    /// A scan as a query to its model, without sources that have flaws, and a text for each of
    /// these sources.
    fn query(&self, scan: &Scan) -> Result<(Prepared, Vec<String>), RecogniseError> {
        let model = &self.models[self.model(scan.truth.as_ref())];
        let moves = |id: &SourceId, channel: usize| self.moves(scan.truth.as_ref(), id, channel);
        let (trial, left_out) = without_flawed(scan.trial.clone(), &self.scene, moves);
        let trial = Arc::new(trial);
        Ok((model.prepare(&Entry::in_memory(trial.clone()), &trial)?, left_out))
    }

    /// Why a scan was named as it was: what each source says, and the nearest trial. Takes about as
    /// long as naming it.
    ///
    /// # Errors
    /// As [`Recogniser::rank`].
    pub fn explain(&self, scan: &Scan) -> Result<Why, RecogniseError> {
        let at = self.model(scan.truth.as_ref());
        let (query, left_out) = self.query(scan)?;
        let ranking = self.models[at].rank(&query)?;
        let evidence = self.models[at].explain(&query)?;
        let held = |id: &&SourceId| !scan.trial.signals.contains_key(*id);
        let missing = self.library.sources.iter().filter(held);
        let missing = missing.map(|id| format!("{id} is not in this scan"));
        let left_out = left_out.into_iter().chain(missing).collect();
        Ok(Why::new(&ranking, evidence.as_ref(), self.following[at].rejection.as_ref(), left_out))
    }

    /// A trial that scans are compared with.
    pub fn trial(&self, key: &TrialKey) -> Option<&Entry> {
        self.trials.get(key)
    }

    /// Judges a scan by its ranking.
    pub fn verdict(&self, scan: &Scan, ranked: Ranked) -> Verdict {
        let Ranked { ranking, flaws } = ranked;
        let rejection = self.following[self.model(scan.truth.as_ref())].rejection.clone();
        let needed_s = self.needed_s;
        let flaws = self.flaws(scan, flaws);
        let damage = self.damage(scan.truth.as_ref(), &flaws);
        let remarks = self.remarks(scan, &ranking, &flaws);
        let left_out = self.left_out(scan, &ranking, &remarks);
        let is_lacking = |id: &&SourceId| !scan.trial.signals.contains_key(*id);
        let lacking = self.library.sources.iter().filter(is_lacking).cloned().collect();
        Verdict { needed_s, rejection, left_out, lacking, remarks, damage, ranking }
    }

    /// Sources of a scan that the library has and that were not compared, with reasons.
    fn left_out(&self, scan: &Scan, ranking: &Ranking, remarks: &[Remark]) -> Vec<String> {
        let held = self.library.sources.iter().filter(|id| scan.trial.signals.contains_key(*id));
        let not_compared = held.filter(|id| !ranking.sources.contains(id));
        let why = |id: &SourceId| {
            let mut flaws = remarks.iter().filter(|remark| remark.kind == RemarkKind::Flaw);
            let flaw = flaws
                .find(|remark| remark.source.as_ref() == Some(id))
                .map(|remark| remark.text.clone());
            flaw.unwrap_or_else(|| format!("{id} was not compared"))
        };
        not_compared.map(why).collect()
    }

    /// Begins to follow a scan, if the method can; `truth` as in [`Scan::truth`].
    pub fn follow(&self, truth: Option<&TrialKey>) -> Option<Follower> {
        let at = self.model(truth);
        Some(self.models[at].clone().embedding()?.follow(&self.following[at]))
    }

    /// How long the drag of a scan must last, in seconds, where that is known.
    pub fn needed_s(&self) -> Option<f64> {
        self.needed_s
    }

    /// The library that scans are compared with.
    pub fn library(&self) -> LibraryState {
        self.library.clone()
    }
}

/// The library that scans are compared with.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct LibraryState {
    /// Its name, or its folder's.
    pub name: String,
    /// Its surfaces, sorted, with the number of trials of each.
    pub surfaces: Vec<(String, usize)>,
    /// Its sources.
    pub sources: Vec<SourceId>,
    /// Made by a generator, not measured.
    pub synthetic: bool,
    /// The reason why scans cannot be named with it, if they cannot.
    pub problem: Option<String>,
    /// The basis of its answers, a line each.
    pub remarks: Vec<String>,
}

impl LibraryState {
    /// The state of a library of these trials.
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
            problem: None,
            remarks: Vec::new(),
        }
    }
}

/// An imperfection of a scan; in JSON, its text.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(into = "String")]
pub struct Remark {
    /// The kind of imperfection.
    pub kind: RemarkKind,
    /// The source that it is about, if it is about one.
    pub source: Option<SourceId>,
    /// The text for messages.
    pub text: String,
}

/// The kinds of remark about a scan.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum RemarkKind {
    /// A channel has a flaw.
    Flaw,
    /// The drag is shorter than the library asks for.
    Short,
}

impl From<Remark> for String {
    fn from(remark: Remark) -> Self {
        remark.text
    }
}
