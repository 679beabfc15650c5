//! The page and the HTTP API of a fleet.

use std::io::{BufWriter, Write};
use std::sync::Arc;

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::rejection::QueryRejection;
use axum::extract::{Query, State};
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Json, Response};
use axum::routing::get;
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::mpsc::{Sender, channel};

use super::Fleet;
use super::cache::Snapshot;
use crate::history::CsvWriter;
use crate::serve::Settings;
use crate::serve::api::{FILES, file, guarded};
use crate::serve::request::{Problem, aside};
use crate::serve::subscribers::EventStream;

/// How many scans one answer holds by default (`USUAL`) and at most (`MOST`).
const USUAL: usize = 100;
const MOST: usize = 1000;
/// A history is sent in blocks of `PIECE` bytes, of which at most `PIECES` may wait for the reader.
const PIECE: usize = 64 << 10;
const PIECES: usize = 4;

/// The files that only this page has; the other files are shared with a station's page.
const OWN: [(&str, &str, &str); 3] = [
    ("/", "text/html; charset=utf-8", include_str!("page/index.html")),
    ("/fleet.css", "text/css; charset=utf-8", include_str!("page/fleet.css")),
    ("/fleet.js", "text/javascript; charset=utf-8", include_str!("page/fleet.js")),
];
const SHARED: [&str; 4] = ["/style.css", "/review.css", "/dom.js", "/favicon.svg"];

type Shared = State<Arc<Fleet>>;

/// The routes of all paths, protected by the guard.
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
        "stations": inner.stations.view(&inner.cache),
    }))
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ScansRequest {
    limit: Option<usize>,
    /// Only the scans of this station.
    station: Option<String>,
    before_unix_ms: Option<u64>,
}

type Asked = Result<Query<ScansRequest>, QueryRejection>;

async fn scans(State(fleet): Shared, request: Asked) -> Result<Response, Problem> {
    let Query(ScansRequest { limit, station, before_unix_ms }) = request?;
    let most = limit.unwrap_or(USUAL).min(MOST);
    let before = before_unix_ms.unwrap_or(u64::MAX);
    let read = move || Ok(fleet.lock().cache.newest(most, station.as_deref(), before)?);
    let text = format!("{{\"scans\":[{}]}}", aside(read).await?.join(","));
    Ok(([(CONTENT_TYPE, "application/json")], text).into_response())
}

/// A writer that sends blocks to the reader of an HTTP answer, as fast as the reader takes them.
struct Pieces(Sender<Bytes>);

impl Write for Pieces {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let sent = self.0.blocking_send(Bytes::copy_from_slice(bytes));
        sent.map(|()| bytes.len()).map_err(|_| std::io::ErrorKind::BrokenPipe.into())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// The history of all stations, or of one station, as one text.
fn history(
    fleet: &Fleet,
    request: Asked,
    content_type: &'static str,
    write: impl FnOnce(&Snapshot, BufWriter<Pieces>) -> Result<(), Problem> + Send + 'static,
) -> Result<Response, Problem> {
    let Query(ScansRequest { limit, station, before_unix_ms }) = request?;
    if limit.is_some() || before_unix_ms.is_some() {
        return Err(Problem::Bad("the history is given as a whole, or of a `station`".into()));
    }
    let snapshot = fleet.lock().cache.snapshot(station.as_deref())?;
    let (send, pieces) = channel(PIECES);
    // If the reader disconnects, writing fails and this work stops. Only other failures are logged.
    tokio::task::spawn_blocking(move || {
        let pieces = BufWriter::with_capacity(PIECE, Pieces(send));
        if let Err(Problem::Failed(why)) = write(&snapshot, pieces) {
            tracing::warn!("a history was not sent to its end: {why}");
        }
    });
    Ok(([(CONTENT_TYPE, content_type)], Body::from_stream(EventStream(pieces))).into_response())
}

async fn json_lines(State(fleet): Shared, request: Asked) -> Result<Response, Problem> {
    let write = |snapshot: &Snapshot, mut out: BufWriter<Pieces>| {
        for text in snapshot.texts() {
            writeln!(out, "{}", text?)?;
        }
        Ok(out.flush()?)
    };
    history(&fleet, request, "application/jsonl", write)
}

async fn csv(State(fleet): Shared, request: Asked) -> Result<Response, Problem> {
    let write = |snapshot: &Snapshot, out: BufWriter<Pieces>| {
        let mut csv = CsvWriter::of_stations(out)?;
        for text in snapshot.texts() {
            let scan: Value = serde_json::from_str(&text?).map_err(std::io::Error::from)?;
            csv.scan(&scan)?;
        }
        Ok(csv.finish()?.flush()?)
    };
    history(&fleet, request, "text/csv; charset=utf-8", write)
}
