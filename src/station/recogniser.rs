//! Names scans against a library, whatever the method: its types end here.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::need::Needs;
use super::notice::LibraryState;
use crate::library::Entry;
use crate::recognise::{Method, Ranking, RecogniseError};
use crate::scan::Scan;
use crate::trial::{Signal, TrialKey, flaws};

/// What a scan was named.
#[derive(Clone, Debug, PartialEq)]
pub struct Verdict {
    /// The library's surfaces, the most alike first.
    pub ranking: Ranking,
    /// Scan duration that 400 samples T* apart need on the first one, in seconds.
    pub needed_s: Option<f64>,
    /// For people: what is not perfect about the scan, a line each.
    pub remarks: Vec<String>,
}

/// A library, ready to name scans.
pub trait Recogniser: Send + Sync {
    /// Names a scan.
    ///
    /// # Errors
    /// If the scan has no source in common with the library, or does not fit the scene.
    fn name(&self, scan: &Scan) -> Result<Verdict, RecogniseError>;

    /// For people: what scans are compared with.
    fn library(&self) -> LibraryState;
}

/// Reads a library: again and again, if it is told to.
pub type Load = Arc<dyn Fn() -> Result<Arc<dyn Recogniser>, String> + Send + Sync>;

/// A method and the models that it made.
pub struct ByMethod<M: Method> {
    method: M,
    models: Vec<M::Model>,
    model_of: BTreeMap<TrialKey, usize>,
    needs: Needs,
    library: LibraryState,
}

impl<M: Method> ByMethod<M> {
    /// Names scans by one model.
    pub fn new(method: M, model: M::Model, needs: Needs, library: LibraryState) -> Self {
        Self::with_folds(method, vec![model], BTreeMap::new(), needs, library)
    }

    /// Names recorded scans by the model of their fold; those not in `model_of`, by the first.
    ///
    /// # Panics
    /// If there is no model, or `model_of` names one that there is not.
    pub fn with_folds(
        method: M,
        models: Vec<M::Model>,
        model_of: BTreeMap<TrialKey, usize>,
        needs: Needs,
        library: LibraryState,
    ) -> Self {
        assert!(!models.is_empty() && model_of.values().all(|at| *at < models.len()));
        Self { method, models, model_of, needs, library }
    }

    /// Flaws of the scan's channels, and samples closer than T*.
    fn remarks(&self, scan: &Scan, ranking: &Ranking) -> Vec<String> {
        let mut remarks = Vec::new();
        for (id, signal) in &scan.trial.signals {
            // A source with a fixed length scale is a switch, and rests most of the time.
            if let Signal::Series(series) = signal
                && !self.needs.is_switch(id)
            {
                remarks.extend(flaws(series).iter().map(|flaw| format!("{id}: {flaw}")));
            }
        }
        remarks.extend(self.needs.warnings(ranking, scan.scan_s));
        remarks
    }
}

impl<M: Method> Recogniser for ByMethod<M> {
    fn name(&self, scan: &Scan) -> Result<Verdict, RecogniseError> {
        // What came out of the rings, and nothing else; the truth only says which library it is
        // not part of.
        let fold = scan.truth.as_ref().and_then(|key| self.model_of.get(key));
        let model = &self.models[fold.copied().unwrap_or(0)];
        let trial = Arc::new(scan.trial.clone());
        let query = self.method.prepare(&Entry::in_memory(trial.clone()), &trial)?;
        let ranking = self.method.rank(model, &query)?;
        let needed_s = self.needs.scan_s(&ranking);
        Ok(Verdict { needed_s, remarks: self.remarks(scan, &ranking), ranking })
    }

    fn library(&self) -> LibraryState {
        self.library.clone()
    }
}
