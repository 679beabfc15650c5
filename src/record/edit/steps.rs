//! The steps by which a library was edited, so that they can be undone.

use std::fs;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::folders::REMOVED;
use crate::library::LibraryError;
use crate::trial::TrialKey;

/// The list of steps in it.
pub(super) const STEPS: &str = "steps.jsonl";
/// Steps that are remembered.
pub(super) const MOST_STEPS: usize = 1000;

/// One edit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Step {
    /// For people: what was done.
    pub what: String,
    /// When, in UTC.
    pub at: String,
    /// Which trials went where.
    pub moves: Vec<Move>,
}

/// A trial that went from one folder of a library to another.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Move {
    /// The folder before, `SURFACE/TRIAL`, within the library.
    pub from: String,
    /// The folder after.
    pub to: String,
    /// What it was called; `None` for a trial that cannot be read.
    pub was: Option<TrialKey>,
    /// What it is called now.
    pub is: Option<TrialKey>,
}

/// The last step that can be undone.
///
/// # Errors
/// If the list of steps cannot be read.
pub fn last_step(library: &Path) -> Result<Option<Step>, LibraryError> {
    Ok(steps(library)?.pop())
}

/// All steps, the last one last.
///
/// # Errors
/// If the list cannot be read.
pub(super) fn steps(library: &Path) -> Result<Vec<Step>, LibraryError> {
    let path = library.join(REMOVED).join(STEPS);
    let text = match fs::read_to_string(&path) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(LibraryError::io(&path, error)),
    };
    // A line that a crash cut short is no step: it is written before anything moves.
    Ok(text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect())
}
