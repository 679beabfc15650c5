//! The library over HTTP, with its trials, edits of the trials, and its audit.

use std::sync::Arc;

use axum::extract::State;
use axum::response::Json;
use axum::routing::{get, post};
use axum::{Extension, Router};
use serde::Deserialize;
use serde_json::{Value, json};

use super::hub::{CheckView, Hub, Shared};
use super::request::{Problem, Reply, Said, aside, body, few, label};
use super::review::{NOTE, moved};
use super::roles::By;
use super::state::unix_ms;
use super::subscribers::EventKind;
use crate::history::Actor;
use crate::library::LibraryError;
use crate::record::edit::{self, Editor, Move, Step};
use crate::station::Command;

pub(super) fn router() -> Router<Arc<Hub>> {
    Router::new()
        .route("/library/trials", get(trials))
        .route("/library/rename", post(rename))
        .route("/library/move", post(move_to))
        .route("/library/remove", post(remove))
        .route("/library/restore", post(restore))
        .route("/library/undo", post(undo))
        .route("/check", get(check).post(begin_check))
}

async fn trials(State(hub): Shared) -> Reply<Json<Value>> {
    let library = hub.settings.library.clone().ok_or(Problem::NoLibrary)?;
    let listed = aside(move || {
        Ok(json!({
            "trials": edit::list(&library.folder, &library.scene)?,
            "removed": edit::list_removed(&library.folder, &library.scene)?,
            // The last edit is reported, since it can be undone.
            "undo": edit::last_step(&library.folder)?,
        }))
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

async fn rename(State(hub): Shared, Extension(by): By, said: Said) -> Reply<Json<Step>> {
    let Rename { surface, to } = body(said, "{\"surface\": \"oak\", \"to\": \"ash\"}")?;
    let to = label("to", &to)?;
    edited(&hub, (by, "rename"), move |editor| editor.rename(&surface, &to)).await
}

async fn move_to(State(hub): Shared, Extension(by): By, said: Said) -> Reply<Json<Step>> {
    let MoveTo { trials, to } = body(said, "{\"trials\": [\"oak/anna-01\"], \"to\": \"ash\"}")?;
    let (trials, to) = (few("trials", trials)?, label("to", &to)?);
    edited(&hub, (by, "move"), move |editor| editor.move_to(&trials, &to)).await
}

fn chosen(said: Said) -> Reply<Vec<String>> {
    let Chosen { trials } = body(said, "{\"trials\": [\"oak/anna-01\"]}")?;
    few("trials", trials)
}

async fn remove(State(hub): Shared, Extension(by): By, said: Said) -> Reply<Json<Step>> {
    let trials = chosen(said)?;
    edited(&hub, (by, "remove"), move |editor| editor.remove(&trials)).await
}

async fn restore(State(hub): Shared, Extension(by): By, said: Said) -> Reply<Json<Step>> {
    let trials = chosen(said)?;
    edited(&hub, (by, "restore"), move |editor| editor.restore(&trials)).await
}

async fn undo(State(hub): Shared, Extension(by): By) -> Reply<Json<Step>> {
    edited(&hub, (by, "undo"), Editor::undo).await
}

/// Makes an edit, notes each of its moves, then tells the station to read the library again.
async fn edited(
    hub: &Hub,
    (by, action): (Actor, &'static str),
    edit: impl FnOnce(&mut Editor) -> Result<Step, LibraryError> + Send + 'static,
) -> Reply<Json<Step>> {
    let library = hub.settings.library.clone().ok_or(Problem::NoLibrary)?;
    let history = hub.settings.history.clone();
    let step = aside(move || {
        let step = edit(&mut Editor::open(&library.folder, &library.scene)?)?;
        // If the moves cannot be recorded now, moved trials are found later by their notes.
        let scan_of = |one: &Move| {
            let notes = edit::notes_of(&library.folder, &one.to)?;
            notes.strip_prefix(NOTE).map(String::from)
        };
        let _ = history.relocated(&step.moves, scan_of, by.person.as_deref());
        let moves = step.moves.iter();
        history.note_changes(moves.map(|one| moved(&by, action, [Some(&one.from), Some(&one.to)])));
        Ok(step)
    });
    let step = step.await?;
    // If the station is too busy to take this command, the operator can reload later.
    let _ = hub.order(Command::Reload);
    Ok(Json(step))
}

async fn check(State(hub): Shared) -> Json<CheckView> {
    Json(hub.lock().check.clone())
}

async fn begin_check(State(hub): Shared) -> Reply<Json<CheckView>> {
    let audit = hub.settings.check.clone().ok_or(Problem::NoLibrary)?;
    let view = {
        let view = &mut hub.lock().check;
        if view.state == "running" {
            return Err(Problem::Busy);
        }
        (view.state, view.unix_ms, view.problem) = ("running", unix_ms(), None);
        view.clone()
    };
    tokio::spawn(async move {
        let found = tokio::task::spawn_blocking(move || audit()).await;
        let inner = &mut *hub.lock();
        let view = &mut inner.check;
        view.unix_ms = unix_ms();
        match found.unwrap_or_else(|_| Err("the audit failed; please report this".into())) {
            Ok(report) => (view.state, view.report) = ("done", Some(Arc::new(report))),
            Err(why) => (view.state, view.problem) = ("failed", Some(why)),
        }
        let view = view.clone();
        inner.publish(EventKind::Check, &view);
    });
    Ok(Json(view))
}
