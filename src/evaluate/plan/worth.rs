//! Whether the samples that a plan compares are worth their number.

use super::file::Plan;
use crate::duration::{ByRule, Question, report, worth};
use crate::library::Library;
use crate::recognise::MethodSpec;

/// Samples that are worth less than this share of their number lie too close to each other.
const WORTH: f64 = 0.9;

/// For people: the sources of which a plan compares more samples than its scans hold independent
/// ones, a line each. Methods that do not draw samples need no such number.
pub(super) fn too_close(library: &Library, plan: &Plan) -> Vec<String> {
    let MethodSpec::Reference(options) = &plan.method else { return Vec::new() };
    let question = Question { sources: plan.sources.clone(), ..Question::default() };
    // Pictures have no T*, and taps are over before they repeat themselves.
    let Ok(found) = report(library, &question, |_, _| {}) else { return Vec::new() };
    let of_source = |id: &crate::scene::SourceId| {
        let worst = found.durations.iter().filter(|row| row.source == *id).filter_map(|row| {
            let ByRule::Pooled(pooled) = &row.by_rule else { return None };
            let trial_s = pooled.trial_s?;
            let share = plan.scan_s.map_or(1.0, |scan_s| (scan_s / trial_s).min(1.0));
            Some((worth(options.samples, share * pooled.effective_samples?), row))
        });
        let (worth, row) = worst.min_by(|a, b| a.0.total_cmp(&b.0))?;
        (worth < WORTH * options.samples as f64).then(|| {
            format!(
                "{id}: {} samples of such a scan are worth {worth:.0} independent ones ({})",
                options.samples, row.surface
            )
        })
    };
    plan.sources.iter().filter_map(of_source).collect()
}
