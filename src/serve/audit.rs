//! The audit log over HTTP: who changed what, for administrators.

use std::sync::Arc;

use axum::Router;
use axum::extract::rejection::QueryRejection;
use axum::extract::{Query, State};
use axum::response::{Json, Response};
use axum::routing::get;
use serde::Deserialize;
use serde_json::{Value, json};

use super::hub::{Hub, Shared};
use super::request::{JSON_LINES, Problem, aside, exported};
use super::scans::{MOST, USUAL};
use crate::history::AuditRecord;

pub(super) fn router() -> Router<Arc<Hub>> {
    Router::new().route("/audit", get(audit)).route("/audit.jsonl", get(json_lines))
}

/// Adds records of changes that were made.
pub(super) async fn note(hub: Arc<Hub>, records: Vec<AuditRecord>) -> Result<(), Problem> {
    aside(move || {
        hub.settings.history.note_changes(records);
        Ok(())
    })
    .await
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct AuditRequest {
    limit: Option<usize>,
    /// Only changes older than the one with this id.
    before: Option<u64>,
}

async fn audit(
    State(hub): Shared,
    asked: Result<Query<AuditRequest>, QueryRejection>,
) -> Result<Json<Value>, Problem> {
    let Query(AuditRequest { limit, before }) = asked?;
    let most = limit.unwrap_or(USUAL).min(MOST);
    let changes = aside(move || Ok(hub.settings.history.changes(before, most)?)).await?;
    Ok(Json(json!({ "changes": changes })))
}

async fn json_lines(State(hub): Shared) -> Response {
    exported(JSON_LINES, move |out| hub.settings.history.write_changes(out))
}
