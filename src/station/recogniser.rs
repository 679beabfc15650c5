//! Names scans against a library, whatever the method.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::event::{LibraryState, Remark, RemarkKind};
use super::requirements::DurationRequirements;
use crate::library::Entry;
use crate::recognise::{
    Follow, FollowOptions, Model, Ranking, RecogniseError, Rejection, RejectionError, Settling,
    without_flawed,
};
use crate::scan::Scan;
use crate::scene::SourceId;
use crate::trial::{Signal, TrialKey, flaws};

/// What a scan was named.
#[derive(Clone, Debug, PartialEq)]
pub struct Verdict {
    /// The library's surfaces, the most alike first.
    pub ranking: Ranking,
    /// It is none of them.
    pub unknown: bool,
    /// Scan duration that 400 samples T* apart need on the first one, in seconds.
    pub needed_s: Option<f64>,
    /// What is not perfect about the scan.
    pub remarks: Vec<Remark>,
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
        Self { models, model_of, following, requirements, library }
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
        let model = &self.models[self.model(scan.truth.as_ref())];
        // What came out of the rings and nothing else, but for channels with flaws.
        let moves = |id: &SourceId, channel: usize| model.moves(id, channel);
        let (trial, _) = without_flawed(scan.trial.clone(), self.requirements.scene(), moves);
        let trial = Arc::new(trial);
        model.rank(&model.prepare(&Entry::in_memory(trial.clone()), &trial)?)
    }

    /// What a scan's ranking says.
    pub fn verdict(&self, scan: &Scan, ranking: Ranking) -> Verdict {
        let rejection = self.following[self.model(scan.truth.as_ref())].rejection.as_ref();
        let unknown = ranking.p_value.zip(rejection).is_some_and(|(p, r)| r.rejects(p));
        let needed_s = self.requirements.scan_s(ranking.surface(), &ranking.sources);
        Verdict { needed_s, unknown, remarks: self.remarks(scan, &ranking), ranking }
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
