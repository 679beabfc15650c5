//! The page of a fleet, and its interface for programs.

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

/// Scans of one answer, unless the request says otherwise, and most of them.
const USUAL: usize = 100;
const MOST: usize = 1000;
/// Bytes of a history that are sent at a time, and how many such pieces wait for a reader.
const PIECE: usize = 64 << 10;
const PIECES: usize = 4;

/// The files of the page that are its own; the others are those of a station's page.
const OWN: [(&str, &str, &str); 3] = [
    ("/", "text/html; charset=utf-8", include_str!("page/index.html")),
    ("/fleet.css", "text/css; charset=utf-8", include_str!("page/fleet.css")),
    ("/fleet.js", "text/javascript; charset=utf-8", include_str!("page/fleet.js")),
];
const SHARED: [&str; 4] = ["/style.css", "/review.css", "/dom.js", "/favicon.svg"];

type Shared = State<Arc<Fleet>>;

/// All paths, behind the guard.
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
    /// How many at most.
    limit: Option<usize>,
    /// Of this station alone.
    station: Option<String>,
    /// Given before this moment.
    before_unix_ms: Option<u64>,
}

type Asked = Result<Query<ScansRequest>, QueryRejection>;

fn asked(request: Asked) -> Result<ScansRequest, Problem> {
    request.map(|Query(asked)| asked).map_err(|rejection| Problem::Bad(rejection.body_text()))
}

async fn scans(State(fleet): Shared, request: Asked) -> Result<Response, Problem> {
    let ScansRequest { limit, station, before_unix_ms } = asked(request)?;
    let most = limit.unwrap_or(USUAL).min(MOST);
    let before = before_unix_ms.unwrap_or(u64::MAX);
    let read = move || Ok(fleet.lock().cache.newest(most, station.as_deref(), before)?);
    let text = format!("{{\"scans\":[{}]}}", aside(read).await?.join(","));
    Ok(([(CONTENT_TYPE, "application/json")], text).into_response())
}

/// Sends what is written in pieces, as fast as the reader takes them.
struct Pieces {
    send: Sender<Bytes>,
    piece: Vec<u8>,
}

impl std::io::Write for Pieces {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.piece.extend_from_slice(bytes);
        if self.piece.len() >= PIECE {
            self.flush()?;
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        let piece = std::mem::take(&mut self.piece).into();
        self.send.blocking_send(piece).map_err(|_| std::io::ErrorKind::BrokenPipe.into())
    }
}

/// The history of all stations, or of one, as one text.
fn history(
    fleet: &Fleet,
    request: Asked,
    content_type: &'static str,
    write: impl FnOnce(&Snapshot, Pieces) -> Result<(), Problem> + Send + 'static,
) -> Result<Response, Problem> {
    let ScansRequest { limit, station, before_unix_ms } = asked(request)?;
    if limit.is_some() || before_unix_ms.is_some() {
        return Err(Problem::Bad("the history is given as a whole, or of a `station`".into()));
    }
    let snapshot = fleet.lock().cache.snapshot(station.as_deref())?;
    let (send, pieces) = channel(PIECES);
    // A reader that goes away ends it, and learns of no other failure.
    tokio::task::spawn_blocking(move || {
        let pieces = Pieces { send, piece: Vec::new() };
        if let Err(Problem::Failed(why)) = write(&snapshot, pieces) {
            tracing::warn!("a history was not sent to its end: {why}");
        }
    });
    Ok(([(CONTENT_TYPE, content_type)], Body::from_stream(EventStream(pieces))).into_response())
}

async fn json_lines(State(fleet): Shared, request: Asked) -> Result<Response, Problem> {
    let write = |snapshot: &Snapshot, mut out: Pieces| {
        use std::io::Write;
        for text in snapshot.texts() {
            writeln!(out, "{}", text?)?;
        }
        Ok(out.flush()?)
    };
    history(&fleet, request, "application/jsonl", write)
}

async fn csv(State(fleet): Shared, request: Asked) -> Result<Response, Problem> {
    let write = |snapshot: &Snapshot, out: Pieces| {
        let mut csv = CsvWriter::of_stations(out)?;
        for text in snapshot.texts() {
            csv.scan(&serde_json::from_str(&text?).map_err(std::io::Error::from)?)?;
        }
        Ok(std::io::Write::flush(&mut csv.finish()?)?)
    };
    history(&fleet, request, "text/csv; charset=utf-8", write)
}
