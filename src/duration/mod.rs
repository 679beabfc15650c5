//! How long a scan must last: T*, the minimum time between independent samples.

mod batch;
mod lanes;
mod need;
mod online;
mod search;
pub mod simulate;
mod trials;

pub use need::{SAMPLES, START_S, ScanNeed, Second};
pub use online::{OnlineDuration, OnlineError, OnlineEstimate, OnlineSettings};
pub use search::{CurvePoint, Estimate, Outcome, Rule, Search, Settings, t_star};
pub use trials::{DurationError, FEWEST_FRAMES, Trials};
