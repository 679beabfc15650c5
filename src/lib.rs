//! Names the surface a sensorised stylus is dragged over, by the kernel two-sample test.
//!
//! ```
//! use surfaced::dataset::synth::{self, Parameters};
//! use surfaced::recognise::{MethodName, MethodSpec, ready_model};
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
//! use surfaced::library::{Entry, Library};
//! use surfaced::recognise::{MethodName, MethodSpec, ready_model};
//! use surfaced::{scene::SourceId, trial::{Series, Trial, TrialKey}};
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
//! # Map
//!
//! Data flow (no folder imports against an arrow):
//!
//! ```text
//! device (serial · lines · microphone · camera · replay) ─► ring ─► scan (clock, tap/drag) ─► recognise (sampling ─► kernel ─► score ─► rank)
//!                                                                  └► record ─► library ◄─ dataset (lmt108 · synth)
//! duration (HSIC, T*) stands on library + kernel; evaluate (protocols, chart, stress, plan) on
//! recognise and duration; station joins scan, recognise, duration and record, and reads the
//! configuration; history (past scans) and outputs (HTTP, MQTT) stand on station; serve (web page
//! and API) stands on history and outputs; fleet (many stations on one page) and cli are on top.
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
//! | compute how long a scan must last | [`duration`] |
//! | keep and read past scans | [`history`] |
//! | run a station with your own devices | [`device::Device`], [`station::Station`], [`station::Listener`] |
//! | compare two samples, or test independence | [`kernel`] |
//!
//! [`scene`] describes the sources, [`trial`] holds one recorded interaction, [`seed`] makes every
//! random draw repeatable, and [`spectrum`] computes amplitude spectra for methods and the web
//! page. Decoders, kernels and statistics are pure: no I/O, no clock, no global state. The defaults
//! of a station (detection, devices, history, enrolment) are in `configs/stylus.toml`, which is
//! embedded; the defaults of a method are in its options.
//!
//! # Stability
//! Before version 1.0, a minor version may change this interface, and `CHANGELOG.md` says so. The items
//! in the table are meant to stay. [`ring`], [`scan`], [`serve`] and [`outputs`] are public for
//! programs that build their own station, and may change with it. Everything else is private or hidden
//! from these pages: the command line, the drivers, and the parts that only the project's tests and
//! tools use. In the recording format, and in JSON below `/api/v1`, fields are only ever added.

#![cfg_attr(not(test), warn(unreachable_pub))]

// Lets helpers in tests/common, which unit tests include too, name this crate `surfaced`.
#[cfg(test)]
extern crate self as surfaced;

#[doc(hidden)]
pub mod cli;
pub mod dataset;
pub mod device;
mod draw;
pub mod duration;
pub mod evaluate;
mod fleet;
pub mod history;
mod jpeg;
pub mod kernel;
pub mod library;
pub mod outputs;
mod printable;
pub mod recognise;
pub mod record;
pub mod ring;
pub mod scan;
pub mod scene;
#[doc(hidden)]
pub mod seed;
pub mod serve;
#[doc(hidden)] // For the project's own tests.
pub mod spectrum;
pub mod station;
mod system;
pub mod trial;
