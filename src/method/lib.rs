//! Names the surface that a recorded drag was made on, by the kernel two-sample test, and says how long a
//! drag must be. Everything here is computed from recordings: no device, no server, no command line.
//!
//! Recordings are arrays of shape (samples, channels), or files in any form ([`dataset::open`]):
//!
//! ```
//! use surfaced_method::independence::{Question, report};
//! use surfaced_method::library::Library;
//! use surfaced_method::recognise::{MethodName, MethodSpec};
//! use surfaced_method::{scene::SourceId, trial::{Series, Trial, TrialKey}};
//!
//! # let sample = |t: u32| (t.wrapping_mul(2654435761) >> 8) as f32;
//! // Made up: noise that changes every 8 samples, or with each; 2 channels, 1000 samples a second.
//! let drag = |step: u32, seed: u32| Series::new(1000.0, 2, (0..2000).map(|t| sample(t / step + 7919 * seed)).collect());
//! let source = SourceId::new("signal")?;
//! let mut trials = Vec::new();
//! for number in 1..=5 {
//!     trials.push((TrialKey::new("felt", "ann", number), drag(8, number)?));
//!     trials.push((TrialKey::new("oak", "ann", number), drag(1, number)?));
//! }
//! let library = Library::of_series(&source, None, trials)?;
//!
//! let model = MethodSpec::from(MethodName::Embedding).fit(&library)?;
//! let answer = model.rank_trial(Trial::of_series(TrialKey::new("?", "ben", 1), source, drag(8, 9)?))?;
//! assert_eq!(answer.surface(), "felt");
//! assert!(answer.probabilities()[0] > 0.5);
//!
//! let t_star = report(&library, &Question::default(), |_, _| ())?.durations; // a row for each surface
//! assert_eq!((t_star[0].surface.as_str(), t_star.len()), ("felt", 2));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! | to | use |
//! |---|---|
//! | open recordings of any form | [`dataset::open`], [`library`] |
//! | use arrays as recordings | [`library::Library::of_series`] |
//! | write and edit recordings | [`record::write_trial`], [`record::edit`] |
//! | name a trial | [`recognise`] |
//! | keep a trained model as a file | [`recognise::ModelFile`] |
//! | measure the accuracy | [`evaluate::Evaluation`] |
//! | compute T*, the time between independent samples | [`independence`] |
//! | compare two samples (MMD), or test independence (HSIC) | [`kernel`] |
//!
//! [`scene`] describes the sources, and [`trial`] holds one recorded interaction. `README.md` beside this
//! file says what is computed, exactly. Decoders, kernels and statistics are pure: no I/O, no clock, no
//! global state; random numbers come from a seed that is passed in.

#![cfg_attr(not(test), warn(unreachable_pub))]

// Lets helpers in tests/common, which unit tests include too, name this crate as the program does.
#[cfg(test)]
extern crate self as surfaced;

pub mod dataset;
#[doc(hidden)]
pub mod draw;
pub mod evaluate;
#[doc(hidden)]
pub mod features;
pub mod independence;
#[doc(hidden)]
pub mod jpeg;
pub mod kernel;
mod lanes;
pub mod library;
#[doc(hidden)]
pub mod printable;
pub mod recognise;
pub mod record;
#[doc(hidden)]
pub mod replication;
pub mod scene;
#[doc(hidden)]
pub mod seed;
#[doc(hidden)]
pub mod spectrum;
#[doc(hidden)]
pub mod system;
pub mod trial;
