//! The paper's evaluation: its Tables I and II and the figures in its text, each beside ours.
//!
//! ```text
//! rows (settings, published figures) ─► work (scores of each stream, once) ─► part
//! parts of a run split by query ─► merge ─► report (products of sources), figures
//! ```
//!
//! `work` does one shard; `merge` joins shards. A run in one piece is a single shard, so both
//! ways give the same report, byte for byte: it holds no timings.

mod figure;
mod part;
mod report;
mod rows;
mod work;

pub use rows::{ALL, rows};

pub(crate) use figure::{bars, confusion};
pub(crate) use part::{MergeError, PaperPart, Shard, merge};
pub(crate) use report::{PaperReport, ReportRow};
pub(crate) use work::{work, work_head};
