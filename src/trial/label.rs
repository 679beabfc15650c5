//! Who and what a trial is: surface, user, number.

/// The user of a trial that names none.
pub const EXPERT: &str = "expert";

/// The surface of a trial whose label nobody knows.
pub const UNLABELLED: &str = "unlabelled";

/// Names one trial: which surface, whose hand, which repetition.
///
/// Ordered by surface, then user, then number, which is also the order in which ties are broken.
#[derive(
    Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, serde::Serialize, serde::Deserialize,
)]
pub struct TrialKey {
    /// The label: what a recogniser answers with.
    pub surface: String,
    /// Who moved the stylus; [`EXPERT`] unless the recording says otherwise.
    pub user: String,
    /// Number of the repetition, counted from 1.
    pub number: u32,
}

impl TrialKey {
    /// A key from its three parts.
    pub fn new(surface: impl Into<String>, user: impl Into<String>, number: u32) -> Self {
        Self { surface: surface.into(), user: user.into(), number }
    }
}

/// A label in Unicode's normal form C: an é is the same, however it was typed.
pub fn normal(label: &str) -> String {
    use unicode_normalization::UnicodeNormalization;
    label.nfc().collect()
}

impl TrialKey {
    /// The surface, if it is known.
    pub fn label(&self) -> Option<&str> {
        (self.surface != UNLABELLED).then_some(self.surface.as_str())
    }
}

impl std::fmt::Display for TrialKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} · {} · trial {}", self.surface, self.user, self.number)
    }
}
