//! Measures how each method copes with disturbances, from none to absurd.
//!
//! ```text
//! disturb (Trial ─► Trial, seeded) ─► run (method × disturbance × level) ─► report ─► figure
//! ```
//!
//! Most disturbances change the queries and leave the library clean; a few change the library. A run
//! measures at each level:
//! - the accuracy,
//! - the share of queries of unknown surfaces that would be rejected. For this, a library lacks
//!   every fourth surface, and a threshold on the margin rejects 5 % of the undisturbed answers,
//! - the expected calibration error, for methods that state a probability.
//!
//! Unknown surfaces are no disturbance of their own, since they have no severity.
//! [`crate::evaluate::UnknownOutcome`] measures whether the stated rate of false rejections holds.

pub(crate) mod disturb;
mod figure;
mod report;
mod run;

pub use disturb::{Disturbance, all};

pub(crate) use figure::{Measure, figure};
pub(crate) use report::StressReport;
pub use run::{StressPlan, run};
