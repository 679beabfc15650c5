//! The library over HTTP: its trials, edits of them, and its audit.

use std::sync::Arc;

use axum::Router;
use axum::body::Bytes;
use axum::extract::State;
use axum::extract::rejection::BytesRejection;
use axum::http::StatusCode;
use axum::response::Json;
use axum::routing::{get, post};
use serde::{Deserialize, Serialize};

use super::hub::{CheckView, Hub};
use super::label;
use super::request::{Problem, Shared, aside, body};
use super::state::unix_ms;
use crate::library::LibraryError;
use crate::record::edit::{self, Editor, ListedTrial, Step, Undone};
use crate::station::Command;

/// Most trials of one edit.
const MOST: usize = 1000;

/// The routes below `/api/v1`.
pub fn router() -> Router<Arc<Hub>> {
    Router::new()
        .route("/library/trials", get(trials))
        .route("/library/rename", post(rename))
        .route("/library/move", post(move_to))
        .route("/library/remove", post(remove))
        .route("/library/restore", post(restore))
        .route("/library/undo", post(undo))
        .route("/check", get(check).post(begin_check))
}

#[derive(Serialize)]
struct LibraryTrials {
    trials: Vec<ListedTrial>,
    removed: Vec<ListedTrial>,
    /// The step that can be undone.
    undo: Option<Step>,
}

async fn trials(State(hub): Shared) -> Result<Json<LibraryTrials>, Problem> {
    let library = hub.library.clone().ok_or(Problem::NoLibrary)?;
    let listed = aside(move || {
        Ok(LibraryTrials {
            trials: edit::list(&library.folder, &library.scene)?,
            removed: edit::list_removed(&library.folder, &library.scene)?,
            undo: edit::last_step(&library.folder)?,
        })
    });
    Ok(Json(listed.await?))
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Rename {
    surface: String,
    to: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct MoveTo {
    trials: Vec<String>,
    to: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Chosen {
    trials: Vec<String>,
}

type Said = Result<Bytes, BytesRejection>;

async fn rename(State(hub): Shared, said: Said) -> Result<Json<Step>, Problem> {
    let Rename { surface, to } = body(said, "{\"surface\": \"oak\", \"to\": \"ash\"}")?;
    let to = label::check("to", &to).map_err(Problem::Bad)?;
    edited(&hub, move |editor| editor.rename(&surface, &to)).await
}

async fn move_to(State(hub): Shared, said: Said) -> Result<Json<Step>, Problem> {
    let MoveTo { trials, to } = body(said, "{\"trials\": [\"oak/anna-01\"], \"to\": \"ash\"}")?;
    let to = label::check("to", &to).map_err(Problem::Bad)?;
    let trials = few(trials)?;
    edited(&hub, move |editor| editor.move_to(&trials, &to)).await
}

const TRIALS: &str = "{\"trials\": [\"oak/anna-01\"]}";

async fn remove(State(hub): Shared, said: Said) -> Result<Json<Step>, Problem> {
    let Chosen { trials } = body(said, TRIALS)?;
    let trials = few(trials)?;
    edited(&hub, move |editor| editor.remove(&trials)).await
}

async fn restore(State(hub): Shared, said: Said) -> Result<Json<Step>, Problem> {
    let Chosen { trials } = body(said, TRIALS)?;
    let trials = few(trials)?;
    edited(&hub, move |editor| editor.restore(&trials)).await
}

async fn undo(State(hub): Shared) -> Result<Json<Undone>, Problem> {
    edited(&hub, Editor::undo).await
}

fn few(trials: Vec<String>) -> Result<Vec<String>, Problem> {
    match trials.len() {
        1..=MOST => Ok(trials),
        n => Err(Problem::Bad(format!("{n} trials; expected 1 to {MOST}"))),
    }
}

/// Makes an edit, then has the station read the library again.
async fn edited<T: AsRef<Step> + Send + 'static>(
    hub: &Hub,
    edit: impl FnOnce(&mut Editor) -> Result<T, LibraryError> + Send + 'static,
) -> Result<Json<T>, Problem> {
    let library = hub.library.clone().ok_or(Problem::NoLibrary)?;
    let history = hub.history.clone();
    let step = aside(move || {
        let step = edit(&mut Editor::open(&library.folder, &library.scene)?)?;
        // If the moves cannot be noted now, the trials are found by their notes when needed.
        let _ = history.relocated(&step.as_ref().moves);
        Ok(step)
    });
    let step = step.await?;
    // If the station is too busy, the operator can reload later.
    let _ = hub.order(Command::Reload);
    Ok(Json(step))
}

async fn check(State(hub): Shared) -> Json<CheckView> {
    Json(hub.checks.lock().clone())
}

async fn begin_check(State(hub): Shared) -> Result<(StatusCode, Json<CheckView>), Problem> {
    let audit = hub.checks.audit.clone().ok_or(Problem::NoLibrary)?;
    let view = {
        let mut view = hub.checks.lock();
        if view.state == "running" {
            return Err(Problem::Busy);
        }
        (view.state, view.unix_ms, view.problem) = ("running", unix_ms(), None);
        view.clone()
    };
    let running = hub.clone();
    let work = move || {
        let audit = std::panic::AssertUnwindSafe(|| (audit.0)());
        let panicked = |_| Err("the audit failed; please report this".to_string());
        let found = std::panic::catch_unwind(audit).unwrap_or_else(panicked);
        let view = {
            let mut view = running.checks.lock();
            view.unix_ms = unix_ms();
            match found {
                Ok(report) => (view.state, view.report) = ("done", Some(Arc::new(report))),
                Err(why) => (view.state, view.problem) = ("failed", Some(why)),
            }
            view.clone()
        };
        running.checked(&view);
    };
    let started = std::thread::Builder::new().name("check".into()).spawn(work);
    started.map_err(|error| Problem::Failed(error.to_string()))?;
    Ok((StatusCode::OK, Json(view)))
}
