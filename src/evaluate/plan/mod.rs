//! The plan of a scene: the cheapest setting that names its surfaces well enough.
//!
//! A scene of five surfaces needs less than a scene of a hundred. [`search()`] cross-validates
//! within the library and returns a [`Plan`]: sources, method and scan time. Cheapest means fewest
//! sources, then least scan time, then fewest samples to process. These are counted, not timed, so
//! that the same library gives the same plan. Sources are searched with `embedding`, whose
//! distances add up over sources: every subset follows from the distances of single sources. The
//! scan time is computed as in all commands ([`crate::recognise::LeftOutAccuracy`]), and the plan's
//! expected accuracy is measured at that scan time. Weights of sources are not searched. Plans of
//! version 0.2 that name `reference` can still be read.
//!
//! Sources reach the target if the median of the posterior of their accuracy does, under Jeffreys'
//! prior; with queries too few for that, if all are named correctly. The plan says that its target
//! is not shown if the 95 % interval of the accuracy begins below the target. Choosing the best of
//! many settings makes its accuracy look slightly too good; the interval does not cover that.
//!
//! # Results
//! For a target of 99 %, one source is enough in every library with a camera or a microphone that
//! was tried. Without its camera, the synthetic scene of 108 surfaces needs several sources;
//! `tests/it/plan.rs` pins their accuracy.

mod file;
mod search;
mod study;

pub use file::Plan;
pub use search::{PlanOptions, Planned, search};
