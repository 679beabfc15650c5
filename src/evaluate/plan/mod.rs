//! The plan of a scene: the cheapest setting that names its surfaces well enough.
//!
//! A scene of five surfaces does not need what one of a hundred needs. [`search()`] cross-validates
//! inside the library (nothing else is looked at) and gives a [`Plan`]: sources, method and scan
//! time. Cheapest means: fewest sources, then least scan time, then fewest samples to work
//! through; these are counted, not timed, so that the same library gives the same plan. Sources are
//! searched with `embedding`, whose distances add up over sources, so that every subset is known
//! once each source is. The scan time of these sources is that of all commands
//! ([`crate::recognise::LeftOutAccuracy`]), and the accuracy that the plan expects is measured with it.
//! Plans of version 0.2 that name `reference` are still read.
//!
//! Uncertainty: sources reach the target if the median of the posterior of their accuracy does, under
//! Jeffreys' prior, which asks for a little more than the target itself; with few queries, if none of
//! them is named wrong. The plan says that its target is not shown where the 95 % interval of the
//! accuracy begins below it. The best of many settings looks a little better than it is; the
//! interval does not cover that.
//!
//! Not searched: weights of sources.
//!
//! # What it finds
//! For a target of 99 %, one source is enough in every library that was tried with a camera or a
//! microphone. Without its camera, the synthetic scene of 108 surfaces needs several sources;
//! `tests/it/plan.rs` says how well they do.

mod file;
mod search;
mod study;

pub use file::Plan;
pub use search::{PlanOptions, Planned, search};
