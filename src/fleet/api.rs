//! The page and the HTTP API of a fleet.

use std::io::Write;
use std::sync::Arc;

use axum::Router;
use axum::extract::{Query, State};
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Json};
use axum::routing::get;
use serde::Deserialize;
use serde_json::{Value, json};

use super::Fleet;
use super::cache::Texts;
use crate::history::{STATION_COLUMNS, write_csv};
use crate::serve::api::{FILES, file, guarded};
use crate::serve::request::{Asked, CSV, JSON_LINES, MOST, Problem, Reply, USUAL, aside, exported};
use crate::serve::{Settings, unix_ms};

/// The files that only this page has; the other files are shared with a station's page.
const OWN: [(&str, &str, &str); 3] = [
    ("/", "text/html; charset=utf-8", include_str!("page/index.html")),
    ("/fleet.css", "text/css; charset=utf-8", include_str!("page/fleet.css")),
    ("/fleet.js", "text/javascript; charset=utf-8", include_str!("page/fleet.js")),
];
const SHARED: [&str; 5] = ["/style.css", "/review.css", "/dom.js", "/link.js", "/favicon.svg"];

type Shared = State<Arc<Fleet>>;

pub(super) fn router(fleet: Arc<Fleet>, settings: &Settings) -> Router {
    let api = Router::new()
        .route("/state", get(state))
        .route("/scans", get(scans))
        .route("/scans.csv", get(csv))
        .route("/scans.jsonl", get(json_lines));
    let mut router = Router::new()
        .nest("/api/v1", api)
        .route("/healthz", get(|| async { Json(json!({ "status": "ok" })) }));
    let shared = FILES.into_iter().filter(|(path, ..)| SHARED.contains(path));
    for (path, content_type, text) in OWN.into_iter().chain(shared) {
        router = router.route(path, file(content_type, text));
    }
    guarded(router, fleet.traffic.clone(), settings).with_state(fleet)
}

async fn state(State(fleet): Shared) -> Json<Value> {
    let inner = &*fleet.lock();
    Json(json!({
        "api": 1,
        "version": env!("CARGO_PKG_VERSION"),
        "broker": { "address": inner.broker, "problem": inner.problem },
        "scans": inner.cache.len(),
        "passed_over": { "messages": inner.passed_over.0, "last": inner.passed_over.1 },
        "too_many_stations": inner.stations.are_too_many,
        "stale_after_s": inner.stale_after_s,
        "now_unix_ms": unix_ms(),
        "stations": inner.stations.view(&inner.cache),
    }))
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ScansRequest {
    limit: Option<usize>,
    station: Option<String>,
    before_unix_ms: Option<u64>,
}

async fn scans(State(fleet): Shared, request: Asked<ScansRequest>) -> Reply {
    let Query(ScansRequest { limit, station, before_unix_ms }) = request?;
    let most = limit.unwrap_or(USUAL).min(MOST);
    let before = before_unix_ms.unwrap_or(u64::MAX);
    let read = move || Ok(fleet.lock().cache.newest(most, station.as_deref(), before)?);
    let text = format!("{{\"scans\":[{}]}}", aside(read).await?.join(","));
    Ok(([(CONTENT_TYPE, "application/json")], text).into_response())
}

fn history(fleet: &Fleet, request: Asked<ScansRequest>) -> Reply<Texts> {
    let Query(ScansRequest { limit, station, before_unix_ms }) = request?;
    if limit.is_some() || before_unix_ms.is_some() {
        return Err(Problem::Bad("the history is given as a whole, or of a `station`".into()));
    }
    Ok(fleet.lock().cache.texts(station.as_deref())?)
}

async fn json_lines(State(fleet): Shared, request: Asked<ScansRequest>) -> Reply {
    let history = history(&fleet, request)?;
    Ok(exported(JSON_LINES, move |mut out| {
        for text in history {
            writeln!(out, "{}", text?)?;
        }
        out.flush()
    }))
}

async fn csv(State(fleet): Shared, request: Asked<ScansRequest>) -> Reply {
    let history = history(&fleet, request)?;
    Ok(exported(CSV, move |out| {
        let scans = history.map(|text| Ok(serde_json::from_str(&text?)?));
        write_csv(out, STATION_COLUMNS, scans)
    }))
}
