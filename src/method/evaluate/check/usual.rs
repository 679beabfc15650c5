//! What is usual among the trials of a library or a surface.

use super::finding::{Inspected, Measured};
use crate::scene::SourceId;

/// Fewest trials that tell what is usual.
pub(super) const FEWEST: usize = 3;
/// A trial is too loud or quiet if ln of its loudness is at least this far from its surface's middle half: 20
/// dB.
const LOUD: f64 = std::f64::consts::LN_10;

/// The median of a measurement of a source, over the trials of one surface if one is given.
pub(super) fn usual<'i>(
    trials: impl Iterator<Item = &'i Inspected>,
    id: &SourceId,
    surface: Option<&str>,
    of: fn(&Measured) -> f64,
) -> Option<f64> {
    let those = trials.filter(|one| surface.is_none_or(|name| one.entry.key.surface == name));
    median(those.filter_map(|one| one.series.get(id).map(of)).collect())
}

/// Within what the levels of a surface lie, but for outliers, and their median between: their middle half, and on
/// either side 1.5 times its width (Tukey 1977, "Exploratory Data Analysis"), but at least [`LOUD`]. `None` if
/// there are fewer than [`FEWEST`].
pub(super) fn levels(inspected: &[Inspected], id: &SourceId, surface: &str) -> Option<[f64; 3]> {
    let of_surface = inspected.iter().filter(|one| one.entry.key.surface == surface);
    let mut all: Vec<f64> =
        of_surface.filter_map(|one| one.series.get(id).map(|of| of.level)).collect();
    if all.len() < FEWEST {
        return None;
    }
    all.sort_by(f64::total_cmp);
    let quarter = (all.len() / 4).max(1);
    let (low, high) = (all[quarter], all[all.len() - 1 - quarter]);
    let beyond = LOUD.max(1.5 * (high - low));
    Some([low - beyond, all[all.len() / 2], high + beyond])
}

/// The median; `None` if there are fewer than [`FEWEST`] values.
pub(super) fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    (values.len() >= FEWEST).then(|| values[values.len() / 2])
}
