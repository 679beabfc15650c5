//! Names the surface that a recorded drag was made on, by the kernel two-sample test, and says how long a
//! drag must be. Everything here is computed from recordings: no device, no server, no command line.
//!
//! ```
//! use surfaced_method::dataset::synth::{self, Parameters};
//! use surfaced_method::recognise::{MethodName, MethodSpec, ready_model};
//!
//! // Synthetic recordings; `dataset::open(folder, &Scene::lmt108())` opens your own.
//! let small = Parameters { surfaces: 3, trials: 3, users: 1, drag_seconds: 0.5, ..Parameters::default() };
//! let data = synth::library(&small);
//! let (library, queries): (Vec<_>, Vec<_>) =
//!     data.entries.into_iter().partition(|entry| entry.key.user == "expert");
//!
//! let method = MethodSpec::from(MethodName::Embedding).build(&data.scene);
//! let all = (0..library.len()).collect();
//! let model = ready_model(&*method, &library, &all, None, &|_, _| ())?.model;
//!
//! let query = model.prepare(&queries[0], &queries[0].load()?)?;
//! assert_eq!(model.rank(&query)?.surface(), queries[0].key.surface);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Recordings may also be arrays of shape (samples, channels); here they are made up:
//!
//! ```
//! use surfaced_method::library::{Entry, Library};
//! use surfaced_method::recognise::{MethodName, MethodSpec, ready_model};
//! use surfaced_method::{scene::SourceId, trial::{Series, Trial, TrialKey}};
//!
//! let drag = |step: u32, seed: u32| {
//!     let samples = (0..2000).map(|t| ((t / step + 7919 * seed).wrapping_mul(2654435761) >> 8) as f32);
//!     Series::new(1000.0, 2, samples.collect()) // 1000 samples a second, 2 channels, interleaved
//! };
//! let source = SourceId::new("signal")?;
//! let mut trials = Vec::new();
//! for number in 1..=5 {
//!     trials.push((TrialKey::new("felt", "ann", number), drag(8, number)?));
//!     trials.push((TrialKey::new("oak", "ann", number), drag(1, number)?));
//! }
//! let data = Library::of_series(&source, None, trials)?;
//! let method = MethodSpec::from(MethodName::Embedding).build(&data.scene);
//! let model = ready_model(&*method, &data.entries, &(0..10).collect(), None, &|_, _| ())?.model;
//! let query = Trial::of_series(TrialKey::new("?", "ben", 1), source, drag(8, 9)?);
//! let ranking = model.rank(&model.prepare(&Entry::in_memory(query.clone()), &query)?)?;
//! assert_eq!(ranking.surface(), "felt");
//! assert!(ranking.probabilities()[0] > 0.5);
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
pub mod independence;
#[doc(hidden)]
pub mod jpeg;
pub mod kernel;
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
