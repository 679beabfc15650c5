//! Accuracy against latency and against scan time, method by method.
//!
//! ```text
//! charted (settings, subsets of sources, controls) ─► measure ─► Chart of points ─► figure (panels, legend)
//!                                                      several Charts of points ─► side_by_side
//! ```

mod figure;
mod legend;
mod measure;
mod panel;
mod point;
mod settings;
mod side_by_side;

pub use figure::figure;
pub use measure::{Charting, drag_s, measure};
pub use point::Chart;
#[cfg(test)]
pub use settings::settings;
pub use settings::{Comparer, brief, charted};
pub use side_by_side::side_by_side;
