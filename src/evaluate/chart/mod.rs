//! Measures accuracy against latency and against scan time, for each method.
//!
//! ```text
//! charted (settings, subsets of sources, controls) ─► measure ─► Chart of points ─► figure
//! ```

mod figure;
mod point;
mod settings;

pub use figure::figure;
pub use point::Chart;
#[cfg(test)]
pub use settings::settings;
pub use settings::{brief, charted};

use point::ChartPoint;
use settings::Charted;

use crate::evaluate::{
    EvaluateError, Evaluation, Fold, LeftOutSources, Loudness, Measured, Protocol,
};
use crate::library::Entry;
use crate::recognise::{Method, RecogniseError};
use crate::scene::{Scene, SourceId};

#[derive(Clone, Copy)]
pub struct Charting<'a> {
    pub entries: &'a [Entry],
    pub protocol: Protocol,
    pub folds: &'a [Fold],
}

/// Measures one setting. Returns a point for each scan time, and the sources that were left out.
/// `name` is the setting's name in the chart.
pub fn measure(
    on: Charting<'_>,
    charted: &Charted,
    name: &str,
) -> Result<(Vec<ChartPoint>, LeftOutSources), EvaluateError> {
    let scene = &charted.scene;
    let method: Box<dyn Method> = match &charted.method {
        Some(method) => method.build(scene),
        None => Box::new(Loudness { scene: scene.clone() }),
    };
    let run = Evaluation::new(scene, on.entries, on.folds).prepare(&*method)?;
    let measured = run.measure_by(on.folds, &charted.seconds)?;
    let point = |(seconds, measured): (&Option<f64>, &Measured)| {
        ChartPoint::new(&measured.outcome, on.protocol, name, *seconds, charted.control.is_some())
    };
    let points = charted.seconds.iter().zip(&measured).map(point).collect();
    let mut left_out = LeftOutSources::new();
    for (remark, trials) in measured.into_iter().flat_map(|measured| measured.left_out) {
        left_out.entry(remark).or_default().extend(trials);
    }
    Ok((points, left_out))
}

/// Length of a whole drag in seconds: that of the longest drag source in the first trial that has one.
pub fn drag_s(entries: &[Entry], scene: &Scene) -> Result<Option<f64>, RecogniseError> {
    let is_drag = |id: &SourceId| scene.is_dragged(id);
    let Some(entry) = entries.iter().find(|entry| entry.sources.iter().any(is_drag)) else {
        return Ok(None);
    };
    Ok(entry.load()?.longest_s(is_drag))
}
