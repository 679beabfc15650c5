//! Audits of the library: how the last one is.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde::Serialize;

use super::settings::Audit;
use crate::evaluate::CheckReport;

/// How the audit is.
#[derive(Clone, Debug, Serialize)]
pub struct CheckView {
    /// `none`, `running`, `done` or `failed`.
    pub state: &'static str,
    /// Since when.
    pub unix_ms: u64,
    /// For people: why it failed.
    pub problem: Option<String>,
    /// What was found last.
    pub report: Option<Arc<CheckReport>>,
}

/// Audits, one at a time.
#[derive(Debug)]
pub struct Checks {
    /// Does one.
    pub audit: Option<Audit>,
    view: Mutex<CheckView>,
}

impl Checks {
    /// None has run yet.
    pub fn new(audit: Option<Audit>) -> Self {
        let view = CheckView { state: "none", unix_ms: 0, problem: None, report: None };
        Self { audit, view: Mutex::new(view) }
    }

    /// How the last one is.
    pub fn lock(&self) -> MutexGuard<'_, CheckView> {
        // Each change is one assignment.
        self.view.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
