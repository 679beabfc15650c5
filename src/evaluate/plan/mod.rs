//! The plan of a scene: the cheapest setting that names its surfaces well enough.
//!
//! A scene of five surfaces needs less than a scene of a hundred. [`search()`] cross-validates
//! within the library and returns a [`Plan`]: sources, method and scan time. Cheapest means fewest
//! sources, then least scan time, then fewest samples to process. These costs are counted, not
//! timed, so that the same library gives the same plan. The search compares by `embedding`: a
//! distance is a sum over sources, so distances of single sources give those of all sets of
//! sources. The scan time is computed as in all commands ([`crate::recognise::LeftOutAccuracy`]),
//! and the plan's expected accuracy is measured at that scan time. The search never changes weights
//! of sources. Plans of version 0.2 that name `reference` can still be read.
//!
//! A set of sources reaches the target accuracy if its posterior median accuracy under Jeffreys'
//! prior does. With too few queries for that, all queries must be named correctly. A plan says that
//! its target is not shown if the 95 % interval of the accuracy begins below the target. The
//! accuracy of the best of many settings looks slightly too good; the interval does not cover this.
//!
//! # Results
//! For a target of 99 %, one source is enough in every library with a camera or a microphone that
//! was tried. Without its camera, the synthetic scene of 108 surfaces needs several sources;
//! `tests/it/plan.rs` checks their accuracy.

mod file;
mod search;

pub use file::Plan;
pub use search::{PlanOptions, Planned, search};
