//! The answer as a picture: dependence against the lag with T* marked, accuracy against scan time.

mod accuracy;
mod algorithm1;
mod dependence;

pub use accuracy::AccuracyCurve;

use super::report::{ByRule, SourceDuration};
use crate::draw::{Area, Drawn, FigureError, svg};

const PANEL: (u32, u32) = (640, 380);

type DrawnPanel<'a> = Box<dyn Fn(&Area<'_>) -> Drawn + 'a>;

/// An SVG, two panels in a row: by `pooled` one for each source with all its surfaces, by Algorithm
/// 1 one for each surface and source, and one of accuracy against scan time where that is known.
///
/// # Errors
/// If there is nothing to draw.
pub fn figure(
    durations: &[SourceDuration],
    accuracy: Option<&AccuracyCurve>,
) -> Result<String, FigureError> {
    let mut panels: Vec<DrawnPanel<'_>> = Vec::new();
    for (i, row) in durations.iter().enumerate() {
        match &row.by_rule {
            ByRule::Algorithm1 { curve, .. } if curve.len() > 1 => {
                panels.push(Box::new(move |area| algorithm1::panel(area, row, curve)));
            }
            // One panel a source, where its first row stands.
            ByRule::Pooled(_) if durations[..i].iter().all(|d| d.source != row.source) => {
                let rows = dependence::rows(durations, &row.source);
                if !rows.is_empty() {
                    panels.push(Box::new(move |area| dependence::panel(area, &rows)));
                }
            }
            _ => {}
        }
    }
    if panels.is_empty() {
        return Err(FigureError("no surface and source has a curve".into()));
    }
    if let Some(curve) = accuracy.filter(|curve| !curve.points.is_empty()) {
        panels.push(Box::new(move |area| accuracy::panel(area, curve)));
    }
    let columns = panels.len().min(2);
    let rows = panels.len().div_ceil(columns);
    let size = (PANEL.0 * columns as u32, PANEL.1 * rows as u32);
    svg(size, |root| {
        let areas = root.split_evenly((rows, columns));
        areas.iter().zip(&panels).try_for_each(|(area, panel)| panel(area))
    })
}

#[cfg(test)]
mod tests {
    use super::super::report::{Estimator, row_of};
    use super::super::{Algorithm1Settings, PooledSettings, simulate};
    use super::*;
    use crate::kernel::Threshold;
    use crate::recognise::AccuracyAt;

    fn row(surface: &str, tau: f64, estimator: Estimator) -> SourceDuration {
        let mut rng = crate::seed::rng(1, &[b"figure"]);
        let series = simulate::trials(10, 1e4, || simulate::ar1(6000, tau, &mut rng)).unwrap();
        row_of(surface, series, estimator)
    }

    #[test]
    fn a_figure_of_algorithm_1_marks_t_star() {
        let settings = Algorithm1Settings {
            draws: 50,
            threshold: Threshold::Gamma,
            ..Algorithm1Settings::default()
        };
        let row = row("G1 <mesh>", 20.0, Estimator::Algorithm1(settings));
        let svg = figure(std::slice::from_ref(&row), None).unwrap();
        assert!(svg.contains("T* =") && svg.contains("&lt;mesh&gt;"), "{svg}");
    }

    #[test]
    fn a_figure_of_pooled_has_a_panel_a_source_and_one_of_accuracy_where_it_is_known() {
        let pooled = Estimator::Pooled(PooledSettings { dependence: 0.1 });
        let rows = [row("felt", 5.0, pooled), row("mesh", 20.0, pooled)];
        let svg = figure(&rows, None).unwrap();
        assert!(svg.contains("width=\"640\"") && svg.contains("mesh"), "{svg}");
        let points = [0.2, 0.5, 1.0]
            .map(|scan_s| AccuracyAt {
                scan_s,
                accuracy: 0.9,
                accuracy_low: 0.8,
                accuracy_high: 0.95,
            })
            .to_vec();
        let curve = AccuracyCurve { points, target: 0.99, enough_s: Some(0.5) };
        let both = figure(&rows, Some(&curve)).unwrap();
        assert!(both.contains("width=\"1280\"") && both.contains("drag for 0.5 s"), "{both}");
    }

    #[test]
    fn without_a_curve_there_is_no_figure() {
        assert!(figure(&[], None).is_err());
    }
}
