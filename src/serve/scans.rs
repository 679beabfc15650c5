//! Past scans for programs and the page. Serves the list, single scans, their files and corrections.

use std::io::Write;
use std::sync::Arc;

use axum::Router;
use axum::extract::rejection::{PathRejection, QueryRejection};
use axum::extract::{Path, Query, State};
use axum::http::header::{ACCEPT_RANGES, CONTENT_RANGE, CONTENT_TYPE, RANGE};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Json, Response};
use axum::routing::{get, post};
use serde::Deserialize;
use serde_json::{Value, json};

use super::hub::{Hub, Shared};
use super::request::{CSV, JSON_LINES, Problem, Said, aside, body, exported, label};
use super::settings::LibraryFolder;
use super::subscribers::EventKind;
use crate::history::{
    COLUMNS, Correction, Drift, HistoryError, HistoryRow, NOTES, Wanted, nearest_picture, write_csv,
};
use crate::jpeg;
use crate::library::{About, LibraryError, recording};
use crate::printable::json_text;
use crate::record::TrialOptions;
use crate::record::edit::{self, Editor};
use crate::scene::SourceId;
use crate::station::{AnswerState, Command};
use crate::trial::{EXPERT, Trial, TrialKey};

/// How many scans one answer holds by default (`USUAL`) and at most (`MOST`).
pub(crate) const USUAL: usize = 100;
pub(crate) const MOST: usize = 1000;

pub(crate) fn router() -> Router<Arc<Hub>> {
    Router::new()
        .route("/scans", get(scans))
        .route("/scans.csv", get(csv))
        .route("/scans.jsonl", get(json_lines))
        .route("/scans/{id}", get(scan))
        .route("/scans/{id}/why", get(why))
        .route("/scans/{id}/correct", post(correct))
        .route("/scans/{id}/keep", post(keep))
        .route("/scans/{id}/{file}", get(file))
        .route("/history", get(history))
        .route("/drift", get(drift))
        .route("/pictures/{file}", get(live_picture))
}

impl From<HistoryError> for Problem {
    fn from(error: HistoryError) -> Self {
        match error {
            HistoryError::NoScan(_) => Self::NotFound,
            HistoryError::NoSignals(_) => Self::Gone(error.to_string()),
            HistoryError::Library(_) | HistoryError::Io { .. } | HistoryError::InUse(_) => {
                Self::Failed(error.to_string())
            }
        }
    }
}

impl From<PathRejection> for Problem {
    fn from(rejection: PathRejection) -> Self {
        Self::Bad(rejection.body_text())
    }
}

impl From<LibraryError> for Problem {
    fn from(error: LibraryError) -> Self {
        Self::Failed(error.to_string())
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ScansRequest {
    limit: Option<usize>,
    /// Only scans older than this one, which is given by its `id` or its number.
    before: Option<String>,
    /// States with commas between them.
    state: Option<String>,
    surface: Option<String>,
    user: Option<String>,
    from_unix_ms: Option<u64>,
    to_unix_ms: Option<u64>,
    text: Option<String>,
}

impl ScansRequest {
    fn wanted(self) -> Result<Wanted, Problem> {
        let states = self.state.iter().flat_map(|states| states.split(','));
        let states = states.map(|state| {
            serde_json::from_value::<AnswerState>(state.into()).map_err(|_| {
                let all = "named, nearest, unsure, unknown, unnamed";
                Problem::Bad(format!("`state` is one or several of {all}, not `{state}`"))
            })
        });
        Ok(Wanted {
            states: states.collect::<Result<_, _>>()?,
            surface: self.surface,
            user: self.user,
            from_unix_ms: self.from_unix_ms,
            to_unix_ms: self.to_unix_ms,
            text: self.text,
        })
    }
}

type Asked = Result<Query<ScansRequest>, QueryRejection>;

async fn scans(State(hub): Shared, asked: Asked) -> Result<Json<Value>, Problem> {
    let Query(mut asked) = asked?;
    let most = asked.limit.unwrap_or(USUAL).min(MOST);
    let before = asked.before.take();
    let wanted = asked.wanted()?;
    let read = move || Ok(hub.settings.history.newest(before.as_deref(), most, &wanted)?);
    Ok(Json(json!({ "scans": aside(read).await? })))
}

/// The scans that an export is to hold: all that are wanted.
fn to_export(asked: Asked) -> Result<Wanted, Problem> {
    let Query(asked) = asked?;
    if asked.limit.is_some() || asked.before.is_some() {
        return Err(Problem::Bad(
            "an export holds all scans; `limit` and `before` are for pages".into(),
        ));
    }
    asked.wanted()
}

async fn csv(State(hub): Shared, asked: Asked) -> Result<Response, Problem> {
    let wanted = to_export(asked)?;
    Ok(exported(CSV, move |out| write_csv(out, COLUMNS, hub.settings.history.values(wanted))))
}

async fn json_lines(State(hub): Shared, asked: Asked) -> Result<Response, Problem> {
    let wanted = to_export(asked)?;
    Ok(exported(JSON_LINES, move |mut out| {
        for row in hub.settings.history.rows(wanted) {
            writeln!(out, "{}", json_text(&row?))?;
        }
        out.flush()
    }))
}

type ScanPath = Result<Path<String>, PathRejection>;

async fn scan(State(hub): Shared, id: ScanPath) -> Result<Json<HistoryRow>, Problem> {
    let Path(id) = id?;
    Ok(Json(aside(move || Ok(hub.settings.history.answer(&id)?)).await?))
}

fn whole(path: &std::path::Path) -> Result<Vec<u8>, Problem> {
    std::fs::read(path).map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => Problem::NotFound,
        _ => Problem::Failed(format!("{}: {error}", path.display())),
    })
}

async fn why(State(hub): Shared, id: ScanPath) -> Result<Response, Problem> {
    let Path(id) = id?;
    let text = aside(move || whole(&hub.settings.history.folder(&id)?.join(NOTES))).await?;
    Ok(([(CONTENT_TYPE, "application/json")], text).into_response())
}

/// The name on disk and the content type of a file that clients may request.
fn on_disk(file: &str) -> Option<(String, &'static str)> {
    let (stem, extension) = file.rsplit_once('.')?;
    let nearest = stem.strip_prefix("nearest-");
    let source = SourceId::new(nearest.unwrap_or(stem)).ok()?;
    match (extension, nearest) {
        ("wav", None) => Some((format!("{source}.wav"), "audio/wav")),
        ("png", None) => Some((format!("{source}.png"), "image/png")),
        ("jpg", Some(_)) => Some((nearest_picture(&source), "image/jpeg")),
        _ => None,
    }
}

/// The part of a file named by a `Range` header, which players send in order to seek. Without a
/// valid header, it is the whole file (RFC 9110 §14).
fn part(headers: &HeaderMap, mut bytes: Vec<u8>) -> Response {
    let length = bytes.len();
    let range = headers.get(RANGE).and_then(|range| range.to_str().ok()?.strip_prefix("bytes="));
    let asked = range.and_then(|range| match range.split_once('-')? {
        ("", last) => Some((length.saturating_sub(last.parse().ok()?), length)),
        (first, "") => Some((first.parse().ok()?, length)),
        (first, last) => Some((first.parse().ok()?, last.parse::<usize>().ok()?.checked_add(1)?)),
    });
    let Some((first, end)) = asked else {
        return ([(ACCEPT_RANGES, "bytes")], bytes).into_response();
    };
    let end = end.min(length);
    if first >= end {
        let all = [(CONTENT_RANGE, format!("bytes */{length}"))];
        return (StatusCode::RANGE_NOT_SATISFIABLE, all).into_response();
    }
    bytes.truncate(end);
    let part = [(CONTENT_RANGE, format!("bytes {first}-{}/{length}", end - 1))];
    (StatusCode::PARTIAL_CONTENT, part, bytes.split_off(first)).into_response()
}

async fn file(
    State(hub): Shared,
    path: Result<Path<(String, String)>, PathRejection>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Path((id, file)) = path?;
    let (file, content_type) = on_disk(&file).ok_or(Problem::NotFound)?;
    let bytes = aside(move || whole(&hub.settings.history.folder(&id)?.join(file))).await?;
    Ok(([(CONTENT_TYPE, content_type)], part(&headers, bytes)).into_response())
}

/// The latest picture of a camera, cut to the compared region, or whole for `whole-SOURCE.jpg`.
async fn live_picture(State(hub): Shared, file: ScanPath) -> Result<Response, Problem> {
    let Path(file) = file?;
    let stem = file.strip_suffix(".jpg").ok_or(Problem::NotFound)?;
    let whole = stem.strip_prefix("whole-");
    let source = SourceId::new(whole.unwrap_or(stem)).map_err(|_| Problem::NotFound)?;
    let (finder, image) = {
        let inner = hub.lock();
        let finder = inner.viewfinder.clone().filter(|finder| finder.view().source == source);
        (finder, inner.pictures.get(&source).cloned())
    };
    let is_whole = whole.is_some();
    let encode = move || match is_whole {
        true => finder.and_then(|finder| finder.jpeg()),
        false => image.and_then(|image| jpeg::encode(&image).ok()),
    };
    let bytes = aside(move || encode().ok_or(Problem::NotFound)).await?;
    Ok(([(CONTENT_TYPE, "image/jpeg")], bytes).into_response())
}

async fn history(State(hub): Shared) -> Json<Value> {
    let history = &hub.settings.history;
    let mut view = json!(history.extent());
    view["precision"] = json!(history.precision());
    Json(view)
}

async fn drift(State(hub): Shared) -> Result<Json<Arc<Drift>>, Problem> {
    Ok(Json(aside(move || Ok(hub.settings.history.drift())).await?))
}

/// The truth about a scan, as a request states it. An empty request removes the correction.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Was {
    surface: Option<String>,
    #[serde(default)]
    unknown: bool,
    #[serde(default)]
    bad: bool,
}

async fn correct(
    State(hub): Shared,
    id: ScanPath,
    said: Said,
) -> Result<Json<HistoryRow>, Problem> {
    let Path(id) = id?;
    let expected = "{\"surface\": \"oak\"}, {\"unknown\": true} or {\"bad\": true}";
    let Was { surface, unknown, bad } = body(said, expected)?;
    let correction = match (surface, unknown, bad) {
        (None, false, false) => None,
        (None, true, false) => Some(Correction::Unknown),
        (None, false, true) => Some(Correction::Bad),
        (Some(surface), false, false) => {
            Some(Correction::Surface { surface: label("surface", &surface)? })
        }
        _ => return Err(Problem::Bad("give only one of `surface`, `unknown` and `bad`".into())),
    };
    let (history, library) = (hub.settings.history.clone(), hub.settings.library.clone());
    let scan = aside(move || {
        let _reviewing = history.reviewing();
        let scan = history.answer(&id)?;
        let id = &scan.head.id;
        let mut is_moved = false;
        if let (Some(_), Some(library)) = (&scan.became, library) {
            let label = correction.as_ref().and_then(Correction::surface);
            history.became(id, correct_trial(&library, &scan, label)?)?;
            is_moved = true;
        }
        history.correct(id, correction)?;
        Ok((history.answer(id)?, is_moved))
    });
    let (scan, is_moved) = scan.await?;
    hub.lock().publish(EventKind::Correction, &scan);
    if is_moved {
        // If the station is too busy to take this command, the operator can reload later.
        let _ = hub.order(Command::Reload);
    }
    Ok(Json(scan))
}

/// The notes written into the trial made of a scan. By these notes, the trial is found later.
fn notes(scan: &HistoryRow) -> String {
    format!("scan {}", scan.head.id)
}

/// Moves the trial made of a scan to another label, or removes the trial if `label` is `None`.
/// Returns the trial's new name; `None` if the trial is gone.
fn correct_trial(
    library: &LibraryFolder,
    scan: &HistoryRow,
    label: Option<&str>,
) -> Result<Option<String>, LibraryError> {
    let trial = edit::trial_of_note(&library.folder, &notes(scan), scan.became.as_deref());
    let Some(trial) = trial else { return Ok(None) };
    let mut editor = Editor::open(&library.folder, &library.scene)?;
    let Some(label) = label else {
        return editor.remove(&[trial]).map(|_| None);
    };
    let step = editor.move_to(std::slice::from_ref(&trial), label)?;
    Ok(Some(step.moves.first().map_or(trial, |one| one.to.clone())))
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct KeepRequest {
    user: Option<String>,
}

async fn keep(State(hub): Shared, id: ScanPath, said: Said) -> Result<Json<HistoryRow>, Problem> {
    let Path(id) = id?;
    let KeepRequest { user } = body(said, "{\"user\": \"anna\"}")?;
    let user = label("user", user.as_deref().unwrap_or(EXPERT))?;
    let library = hub.settings.library.clone().ok_or(Problem::NoLibrary)?;
    let history = hub.settings.history.clone();
    let scan = aside(move || {
        let _reviewing = history.reviewing();
        let scan = history.answer(&id)?;
        let id = &scan.head.id;
        let there = edit::trial_of_note(&library.folder, &notes(&scan), scan.became.as_deref());
        if let Some(trial) = there {
            // After a crash, the trial may exist although the history does not say so.
            history.became(id, Some(trial.clone()))?;
            let why = format!("this scan is a trial of the library already: {trial}");
            return Err(Problem::Bad(why));
        }
        let trial = to_library(&library, &scan, &history.folder(id)?, user)?;
        history.became(id, Some(trial))?;
        Ok(history.answer(id)?)
    });
    let scan = scan.await?;
    hub.lock().publish(EventKind::Correction, &scan);
    // If the station is too busy to take this command, the operator can reload later.
    let _ = hub.order(Command::Reload);
    Ok(Json(scan))
}

/// Writes a corrected scan into a library, and returns the name of the new trial.
fn to_library(
    library: &LibraryFolder,
    scan: &HistoryRow,
    folder: &std::path::Path,
    user: String,
) -> Result<String, Problem> {
    let refuse = |why: &str| Err(Problem::Bad(why.into()));
    let Some(surface) = scan.correction.as_ref().and_then(Correction::surface) else {
        return refuse("say first which surface this scan was");
    };
    if !scan.spoiled.is_empty() {
        return refuse("this scan is spoiled, so it cannot become a trial");
    }
    let about = About::read(folder)?;
    let opened = recording::open_trial(folder, &library.scene)?;
    let [entry] = opened.entries.as_slice() else { return refuse("this scan holds no signals") };
    let key = TrialKey::new(surface, user, 1).with_session(about.session.clone());
    let trial = Trial { key, signals: entry.load()?.signals };
    let about = About { notes: Some(notes(scan)), ..about };
    let options = TrialOptions { about, durable: true };
    let what = format!("keep {} as a trial of {surface}", notes(scan));
    Ok(edit::keep(&library.folder, &library.scene, trial, &options, what)?)
}
