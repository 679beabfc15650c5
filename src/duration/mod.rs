//! How long a scan must last: T*, the minimum time between independent samples.

mod batch;
mod estimate;
mod figure;
mod lanes;
mod need;
mod online;
mod report;
mod search;
pub mod simulate;
mod trials;
mod wild;

pub use estimate::{CurvePoint, Estimate, Outcome, Rule, Settings};
pub use figure::{FigureError, figure};
pub use need::{SAMPLES, START_S, ScanNeed, Second};
pub use online::{OnlineDuration, OnlineError, OnlineEstimate, OnlineSettings};
pub use report::{DurationReport, Question, ReportError, SceneDuration, SourceDuration, report};
pub use search::{Search, t_star};
pub use trials::{DurationError, FEWEST_FRAMES, Trials};
