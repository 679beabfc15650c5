//! Stress: what each method makes of disturbances, from none to absurd.
//!
//! ```text
//! disturb (Trial ─► Trial, seeded) ─► run (method × disturbance × level) ─► report ─► figure
//! ```
//!
//! Queries are disturbed and the library stays clean, but for the disturbances that are named for
//! the library. At every level there is
//! - the accuracy,
//! - how many queries of surfaces that the library lacks would be rejected, if what is less sure
//!   than all but one in twenty of the undisturbed answers is rejected; every fourth surface is
//!   taken out of the library for it,
//! - for methods that state a probability, its expected calibration error.
//!
//! An unknown surface is no disturbance of its own: it has no severity, and asking after it at each
//! level of all others tells more than one more panel would.

pub mod disturb;
mod figure;
mod report;
mod run;

pub use disturb::{Disturbance, all};
pub use figure::{Measure, figure};
pub use report::{Cell, Level, MethodReport, Report, Series as DisturbanceReport};
pub use run::{Plan, run};
