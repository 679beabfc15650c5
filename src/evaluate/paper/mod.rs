//! Repeats the paper's evaluation (Tables I and II, and numbers in its text), and compares results.
//!
//! A *stream* is a source sampled in one of several ways, such as in time or in the spectrum. A
//! *shard* is a part of the queries, so that several machines can share a run.
//!
//! ```text
//! rows (settings, published figures) ─► work (scores of each stream, once) ─► part
//! parts of a run split by query ─► merge ─► report (products of sources), figures
//! ```
//!
//! `work` processes one shard, `merge` joins shards. A report holds no timings, so it is the same,
//! byte for byte, from one shard or from many.

mod figure;
mod part;
mod report;
mod rows;
mod work;

pub use rows::{ALL, rows};

pub(crate) use figure::{bars, confusion};
pub(crate) use part::{PaperPart, Shard, merge};
pub(crate) use report::{PaperReport, ReportRow};
pub(crate) use work::{work, work_head};
