//! Past scans for programs and the page. Serves the list, single scans and their files.

use std::io::Write;
use std::sync::Arc;

use axum::Router;
use axum::extract::rejection::PathRejection;
use axum::extract::{Path, Query, State};
use axum::http::header::{ACCEPT_RANGES, CONTENT_RANGE, CONTENT_TYPE, RANGE};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Json, Response};
use axum::routing::get;
use serde::Deserialize;
use serde_json::{Value, json};

use super::hub::{Hub, Shared};
use super::request::{Asked, CSV, JSON_LINES, MOST, Problem, Reply, USUAL, aside, exported};
use crate::history::{COLUMNS, Drift, HistoryRow, NOTES, Wanted, nearest_picture, write_csv};
use crate::jpeg;
use crate::printable::json_text;
use crate::scene::SourceId;
use crate::station::AnswerState;

pub(crate) fn router() -> Router<Arc<Hub>> {
    Router::new()
        .route("/scans", get(scans))
        .route("/scans.csv", get(csv))
        .route("/scans.jsonl", get(json_lines))
        .route("/scans/{id}", get(scan))
        .route("/scans/{id}/why", get(why))
        .route("/scans/{id}/{file}", get(file))
        .route("/history", get(history))
        .route("/drift", get(drift))
        .route("/pictures/{file}", get(live_picture))
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
    fn wanted(self) -> Reply<Wanted> {
        let Self { state, surface, user, from_unix_ms, to_unix_ms, text, .. } = self;
        let states = state.iter().flat_map(|states| states.split(','));
        let states = states.map(|state| {
            serde_json::from_value::<AnswerState>(state.into()).map_err(|_| {
                let all = "named, nearest, unsure, unknown, unnamed";
                Problem::Bad(format!("`state` is one or several of {all}, not `{state}`"))
            })
        });
        let states = states.collect::<Result<_, _>>()?;
        Ok(Wanted { states, surface, user, from_unix_ms, to_unix_ms, text })
    }
}

async fn scans(State(hub): Shared, asked: Asked<ScansRequest>) -> Reply<Json<Value>> {
    let Query(mut asked) = asked?;
    let most = asked.limit.unwrap_or(USUAL).min(MOST);
    let before = asked.before.take();
    let wanted = asked.wanted()?;
    let read = move || Ok(hub.settings.history.newest(before.as_deref(), most, &wanted)?);
    Ok(Json(json!({ "scans": aside(read).await? })))
}

/// The scans that an export is to hold: all that are wanted.
fn to_export(asked: Asked<ScansRequest>) -> Reply<Wanted> {
    let Query(asked) = asked?;
    if asked.limit.is_some() || asked.before.is_some() {
        return Err(Problem::Bad(
            "an export holds all scans; `limit` and `before` are for pages".into(),
        ));
    }
    asked.wanted()
}

async fn csv(State(hub): Shared, asked: Asked<ScansRequest>) -> Reply {
    let wanted = to_export(asked)?;
    Ok(exported(CSV, move |out| write_csv(out, COLUMNS, hub.settings.history.values(wanted))))
}

async fn json_lines(State(hub): Shared, asked: Asked<ScansRequest>) -> Reply {
    let wanted = to_export(asked)?;
    Ok(exported(JSON_LINES, move |mut out| {
        for row in hub.settings.history.rows(wanted) {
            writeln!(out, "{}", json_text(&row?))?;
        }
        out.flush()
    }))
}

pub(super) type ScanPath<T = String> = Result<Path<T>, PathRejection>;

async fn scan(State(hub): Shared, id: ScanPath) -> Reply<Json<HistoryRow>> {
    let Path(id) = id?;
    Ok(Json(aside(move || Ok(hub.settings.history.answer(&id)?)).await?))
}

fn whole(path: &std::path::Path) -> Reply<Vec<u8>> {
    std::fs::read(path).map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => Problem::NotFound,
        _ => Problem::Failed(format!("{}: {error}", path.display())),
    })
}

async fn why(State(hub): Shared, id: ScanPath) -> Reply {
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
        (first, last) => {
            let (first, end) = (first.parse().ok()?, last.parse::<usize>().ok()?.checked_add(1)?);
            // One that ends before it begins is not valid.
            (first < end).then_some((first, end))
        }
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

async fn file(State(hub): Shared, path: ScanPath<(String, String)>, headers: HeaderMap) -> Reply {
    let Path((id, file)) = path?;
    let (file, content_type) = on_disk(&file).ok_or(Problem::NotFound)?;
    let bytes = aside(move || whole(&hub.settings.history.folder(&id)?.join(file))).await?;
    Ok(([(CONTENT_TYPE, content_type)], part(&headers, bytes)).into_response())
}

/// The latest picture of a camera, cut to the compared region, or whole for `whole-SOURCE.jpg`.
async fn live_picture(State(hub): Shared, file: ScanPath) -> Reply {
    let Path(file) = file?;
    let stem = file.strip_suffix(".jpg").ok_or(Problem::NotFound)?;
    let whole = stem.strip_prefix("whole-");
    let source = SourceId::new(whole.unwrap_or(stem)).map_err(|_| Problem::NotFound)?;
    let is_whole = whole.is_some();
    let encode = move || {
        if is_whole {
            let finder = hub.settings.viewfinder.as_ref();
            return finder.filter(|finder| finder.view().source == source)?.jpeg();
        }
        let image = hub.lock().pictures.get(&source).cloned();
        jpeg::encode(&*image?).ok()
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

async fn drift(State(hub): Shared) -> Reply<Json<Arc<Drift>>> {
    Ok(Json(aside(move || Ok(hub.settings.history.drift())).await?))
}
