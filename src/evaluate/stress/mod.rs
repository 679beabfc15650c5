//! Stress: how each method copes with disturbances, from none to absurd.
//!
//! ```text
//! disturb (Trial ─► Trial, seeded) ─► run (method × disturbance × level) ─► report ─► figure
//! ```
//!
//! Queries are disturbed and the library stays clean, except for the disturbances of the library. At every level there is
//! - the accuracy,
//! - how many queries of surfaces that the library lacks would be rejected, if what is less sure
//!   than all but one in twenty of the undisturbed answers is rejected; every fourth surface is
//!   taken out of the library for it,
//! - for methods that state a probability, its expected calibration error.
//!
//! An unknown surface is no disturbance of its own: it has no severity, and a look at unknown surfaces
//! at each level of all others shows more than one more panel would. Whether the stated rate of false
//! rejections holds is measured by [`crate::evaluate::UnknownOutcome`].
//!
//! # What it showed of `embedding`, and what was mended
//! The first runs found offsets, held gaps, hum and a room's noise to cost most; charts before and
//! after are in `tools/charts`.
//!
//! - A frame loses its mean, so that a sensor's offset stays out of the lowest bands.
//! - Frames far quieter than the rest are left out: they shifted the level of all others.
//! - Among several sources, one that is far from every surface no longer overrules the others.
//!   There a change of light alone cost more than all other sources could make up for.
//! - Guesses while dragging leave out dead and stuck sensors, as the final answer does.
//!
//! Accuracy is still lost by samples lost one by one and a wrong clock, which shift the pitch; noise
//! of a tenth of the sound's power; scans of half a second and less.

pub(crate) mod disturb;
mod figure;
mod report;
mod run;

pub use disturb::{Disturbance, all};

pub(crate) use figure::{Measure, figure};
pub(crate) use report::StressReport;
pub use run::{StressPlan, run};
