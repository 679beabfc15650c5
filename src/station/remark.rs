//! What is not perfect about a scan.

use serde::Serialize;

use crate::scene::SourceId;

/// Something that is not perfect about a scan; in JSON, its text.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(into = "String")]
pub struct Remark {
    /// What it is about.
    pub kind: RemarkKind,
    /// The source that it is about, if it is about one.
    pub source: Option<SourceId>,
    /// For people.
    pub text: String,
}

/// The kinds of remark about a scan.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum RemarkKind {
    /// A channel has a flaw.
    Flaw,
    /// The drag is shorter than the library asks for.
    Short,
}

impl From<Remark> for String {
    fn from(remark: Remark) -> Self {
        remark.text
    }
}
