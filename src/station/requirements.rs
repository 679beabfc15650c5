//! What T* requires of a scan: how much longer to drag.

use super::event::{Remark, RemarkKind};
use crate::duration::{DurationReport, Estimator, Question, Settings, report};
use crate::kernel::Threshold;
use crate::library::{Entry, Library};
use crate::recognise::Ranking;
use crate::scene::{Domain, Scene, SourceId};

/// T* of a library's surfaces, as far as it is known.
pub struct DurationRequirements {
    scene: Scene,
    report: Option<DurationReport>,
}

/// Draws of a start for each lag: a fifth of the paper's, since this runs before every replay.
const DRAWS: usize = 100;

impl DurationRequirements {
    /// From the trials that are compared with. A library too small for T*, or without sources of
    /// domain `time`, requires nothing.
    pub fn of(scene: &Scene, entries: Vec<Entry>, synthetic: bool) -> Self {
        let scene = scene.clone();
        let (name, remarks) = (String::new(), Vec::new());
        let library = Library { name, scene: scene.clone(), entries, synthetic, remarks };
        let sources = (scene.sources())
            .filter(|spec| spec.domain == Domain::Time && spec.sigma.is_none())
            .filter(|spec| library.entries.iter().any(|e| e.sources.contains(&spec.id)))
            .map(|spec| spec.id.clone())
            .collect::<Vec<_>>();
        if sources.is_empty() {
            return Self { scene, report: None };
        }
        let settings =
            Settings { draws: DRAWS, threshold: Threshold::Gamma, ..Settings::default() };
        let estimator = Estimator::Algorithm1(settings);
        let question = Question { sources, estimator, ..Question::default() };
        Self { scene, report: report(&library, &question, |_, _| {}).ok() }
    }

    /// The scene.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Whether a source is a switch, which rests at one value most of the time.
    pub fn is_switch(&self, id: &SourceId) -> bool {
        self.scene.get(id.as_str()).is_some_and(|spec| spec.sigma.is_some())
    }

    /// The longest scan that any of some sources requires on a surface, in seconds.
    pub fn scan_s(&self, surface: &str, sources: &[SourceId]) -> Option<f64> {
        let report = self.report.as_ref()?;
        (sources.iter())
            .filter_map(|id| report.need(surface, id.as_str()))
            .map(|need| need.scan_s())
            .max_by(f64::total_cmp)
    }

    /// Remarks on sources whose samples lie closer than T*.
    pub fn remarks(&self, ranking: &Ranking, scan_s: f64) -> Vec<Remark> {
        let Some(report) = &self.report else { return Vec::new() };
        (ranking.sources.iter())
            .filter_map(|id| {
                let need = report.need(ranking.surface(), id.as_str())?;
                let text = need.warning(id.as_str(), scan_s)?;
                Some(Remark { kind: RemarkKind::CloserThanTStar, source: id.clone(), text })
            })
            .collect()
    }
}
