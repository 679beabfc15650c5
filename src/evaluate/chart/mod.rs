//! Accuracy against latency and against scan time, method by method.
//!
//! ```text
//! charted (settings, subsets of sources, controls) ─► measure ─► Chart of points ─► figure (panels, legend)
//! ```

mod figure;
mod legend;
mod measure;
mod panel;
mod point;
mod settings;

pub use figure::figure;
pub use measure::{Charting, drag_s, measure};
pub use point::{Chart, Point, pareto};
pub use settings::{Charted, What, charted, settings};
