//! Names scans against a library, whatever the method.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::event::{LibraryState, Remark, RemarkKind};
use super::requirements::DurationRequirements;
use super::why::Why;
use crate::library::Entry;
use crate::recognise::{
    Follow, FollowOptions, Model, Prepared, Ranking, RecogniseError, Rejection, RejectionError,
    Settling, without_flawed,
};
use crate::scan::Scan;
use crate::scene::SourceId;
use crate::trial::{Signal, TrialKey, flaws};

/// What a scan was named.
#[derive(Clone, Debug, PartialEq)]
pub struct Verdict {
    /// The library's surfaces, the most alike first.
    pub ranking: Ranking,
    /// The p-value at or below which it would be none of them, where there is such a threshold.
    pub rejection: Option<Rejection>,
    /// For people: sources that were not compared, and why, a line each.
    pub left_out: Vec<String>,
    /// Scan duration that 400 samples T* apart need on the first one, in seconds.
    pub needed_s: Option<f64>,
    /// What is not perfect about the scan.
    pub remarks: Vec<Remark>,
}

impl Verdict {
    /// Whether the scan fits no surface of the library.
    pub fn is_unknown(&self) -> bool {
        let test = self.ranking.p_value.zip(self.rejection.as_ref());
        test.is_some_and(|(p, rejection)| rejection.rejects(p))
    }
}

/// Reads a library, as often as it is called.
pub type Load = Arc<dyn Fn() -> Result<Arc<Recogniser>, String> + Send + Sync>;

/// A library, ready to name scans.
pub struct Recogniser {
    models: Vec<Arc<dyn Model>>,
    model_of: BTreeMap<TrialKey, usize>,
    /// How scans are followed with each model.
    following: Vec<FollowOptions>,
    requirements: DurationRequirements,
    library: LibraryState,
    trials: BTreeMap<TrialKey, Entry>,
}

impl Recogniser {
    /// Names scans by one model.
    pub fn new(
        model: Arc<dyn Model>,
        requirements: DurationRequirements,
        library: LibraryState,
    ) -> Self {
        Self::with_folds(vec![model], BTreeMap::new(), requirements, library)
    }

    /// Names recorded scans by the model of their fold; those not in `model_of`, by the first.
    ///
    /// # Panics
    /// If there is no model, or `model_of` names one that there is not.
    pub fn with_folds(
        models: Vec<Arc<dyn Model>>,
        model_of: BTreeMap<TrialKey, usize>,
        requirements: DurationRequirements,
        library: LibraryState,
    ) -> Self {
        assert!(!models.is_empty() && model_of.values().all(|at| *at < models.len()));
        let following = vec![FollowOptions::default(); models.len()];
        let trials = BTreeMap::new();
        Self { models, model_of, following, requirements, library, trials }
    }

    /// Remembers where the trials are that scans are compared with, to show the nearest one.
    pub fn with_trials(mut self, entries: &[Entry]) -> Self {
        self.trials = entries.iter().map(|entry| (entry.key.clone(), entry.clone())).collect();
        self
    }

    /// Calls scans unknown that fit no surface, at a rate of false rejections or the usual one. Gives what that
    /// rests on, for each model.
    ///
    /// # Errors
    /// If the method gives no p-value, or a library has too few trials; no scan is called
    /// unknown then.
    pub fn reject_unknown(&mut self, rate: Option<f64>) -> Result<Vec<Rejection>, RejectionError> {
        let rejections = self.models.iter().map(|model| model.rejection(rate));
        let rejections: Vec<Rejection> = rejections.collect::<Result<_, _>>()?;
        for (following, rejection) in self.following.iter_mut().zip(&rejections) {
            following.rejection = Some(rejection.clone());
        }
        Ok(rejections)
    }

    /// Finds when answers are settled with each model, for a stated loss of accuracy, so that no
    /// scan waits for it. Gives what was found; nothing, if the method cannot follow scans.
    pub fn calibrate(&mut self, loss: f64) -> Vec<Settling> {
        self.following.iter_mut().for_each(|following| following.loss = loss);
        let with_options = self.models.iter().zip(&self.following);
        let followers = with_options.filter_map(|(model, options)| model.clone().follow(options));
        followers.map(|follower| follower.settling().clone()).collect()
    }

    /// Adds remarks on what answers rest on to those of the library.
    pub fn add_remarks(&mut self, remarks: &[String]) {
        self.library.remarks.extend_from_slice(remarks);
    }

    /// The model of a scan. The truth only says which library it is not part of.
    fn model(&self, truth: Option<&TrialKey>) -> usize {
        truth.and_then(|key| self.model_of.get(key)).copied().unwrap_or(0)
    }

    /// Flaws of the scan's channels, and samples closer than T*.
    fn remarks(&self, scan: &Scan, ranking: &Ranking) -> Vec<Remark> {
        let mut remarks = Vec::new();
        for (id, signal) in &scan.trial.signals {
            // A source with a fixed length scale is a switch, and rests most of the time.
            if let Signal::Series(series) = signal
                && !self.requirements.is_switch(id)
            {
                let left_out =
                    if ranking.sources.contains(id) { "" } else { "; the source is left out" };
                remarks.extend(flaws(series).iter().map(|flaw| Remark {
                    kind: RemarkKind::Flaw,
                    source: id.clone(),
                    text: format!("{id}: {flaw}{left_out}"),
                }));
            }
        }
        remarks.extend(self.requirements.remarks(ranking, scan.scan_s));
        remarks
    }

    /// Ranks the surfaces for a scan.
    ///
    /// # Errors
    /// If the scan has no source in common with the library, or does not fit the scene.
    pub fn rank(&self, scan: &Scan) -> Result<Ranking, RecogniseError> {
        self.models[self.model(scan.truth.as_ref())].rank(&self.query(scan)?.0)
    }

    /// A scan as a query to its model: what came out of the rings and nothing else, but for
    /// sources with flaws; and, for people, which those are.
    fn query(&self, scan: &Scan) -> Result<(Prepared, Vec<String>), RecogniseError> {
        let model = &self.models[self.model(scan.truth.as_ref())];
        let moves = |id: &SourceId, channel: usize| model.moves(id, channel);
        let (trial, left_out) =
            without_flawed(scan.trial.clone(), self.requirements.scene(), moves);
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

    /// What a scan's ranking says.
    pub fn verdict(&self, scan: &Scan, ranking: Ranking) -> Verdict {
        let rejection = self.following[self.model(scan.truth.as_ref())].rejection.clone();
        let needed_s = self.requirements.scan_s(ranking.surface(), &ranking.sources);
        let remarks = self.remarks(scan, &ranking);
        let left_out = self.left_out(scan, &ranking, &remarks);
        Verdict { needed_s, rejection, left_out, remarks, ranking }
    }

    /// For people: sources of a scan that the library has and that were not compared.
    fn left_out(&self, scan: &Scan, ranking: &Ranking, remarks: &[Remark]) -> Vec<String> {
        let held = self.library.sources.iter().filter(|id| scan.trial.signals.contains_key(*id));
        let not_compared = held.filter(|id| !ranking.sources.contains(id));
        let why = |id: &SourceId| {
            let mut flaws = remarks.iter().filter(|remark| remark.kind == RemarkKind::Flaw);
            let flaw = flaws.find(|remark| remark.source == *id).map(|remark| remark.text.clone());
            flaw.unwrap_or_else(|| format!("{id} was not compared"))
        };
        not_compared.map(why).collect()
    }

    /// Follows a scan in progress, by a method that can; `truth` as in [`Scan::truth`].
    pub fn follow(&self, truth: Option<&TrialKey>) -> Option<Box<dyn Follow>> {
        let at = self.model(truth);
        self.models[at].clone().follow(&self.following[at])
    }

    /// Scan duration that 400 samples T* apart need on a surface, in seconds.
    pub fn needed_s(&self, surface: &str) -> Option<f64> {
        self.requirements.scan_s(surface, &self.library.sources)
    }

    /// For people: what scans are compared with.
    pub fn library(&self) -> LibraryState {
        self.library.clone()
    }
}
