//! The interface for programs and the files of the page: the handler of each path.

use std::sync::Arc;

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::rejection::{BytesRejection, QueryRejection};
use axum::extract::{DefaultBodyLimit, Query, State};
use axum::http::StatusCode;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::{IntoResponse, Json, Response};
use axum::routing::{MethodRouter, get, post};
use serde::{Deserialize, Serialize};

use super::guard::{Guard, Traffic, guard};
use super::hub::{Hub, Undelivered};
use super::request::{Problem, Shared};
use super::settings::{LARGEST_BODY, Settings};
use super::subscribers::EventFilter;
use super::{library, metrics, order, scans};
use crate::station::Command;

impl From<Undelivered> for Problem {
    fn from(undelivered: Undelivered) -> Self {
        match undelivered {
            Undelivered::Busy => Self::Busy,
            Undelivered::Ended => Self::Ended,
            Undelivered::NoLibrary => Self::NoLibrary,
        }
    }
}

/// All paths, behind the guard.
pub fn router(hub: Arc<Hub>, settings: &Settings) -> Router {
    let api = Router::new()
        .route("/state", get(state))
        .merge(scans::router())
        .merge(library::router())
        .route("/library", get(library))
        .route("/events", get(events))
        .route("/openapi.json", get(open_api))
        .route(
            "/start",
            post(|State(hub): Shared| async move { send(&hub, "start", Command::Start) }),
        )
        .route("/stop", post(|State(hub): Shared| async move { send(&hub, "stop", Command::Stop) }))
        .route(
            "/reload",
            post(|State(hub): Shared| async move { send(&hub, "reload", Command::Reload) }),
        )
        .route("/enroll", post(enroll))
        .route("/enroll/keep", post(keep_refused))
        .route(
            "/enroll/end",
            post(|State(hub): Shared| async move { send(&hub, "enroll/end", Command::EndEnroll) }),
        );
    let mut router = Router::new()
        .nest("/api/v1", api)
        .route("/metrics", get(all_metrics))
        .route("/healthz", get(health));
    for (path, content_type, text) in FILES {
        router = router.route(path, file(content_type, text));
    }
    guarded(router, hub.traffic.clone(), settings).with_state(hub)
}

/// Paths behind the guard, and a refusal of all others.
pub fn guarded<S: Clone + Send + Sync + 'static>(
    router: Router<S>,
    traffic: Arc<Traffic>,
    settings: &Settings,
) -> Router<S> {
    let checks = Arc::new(Guard::new(traffic, settings));
    router
        .fallback(|| async { Problem::NotFound })
        .method_not_allowed_fallback(|| async { Problem::Method })
        .layer(DefaultBodyLimit::max(LARGEST_BODY))
        .layer(axum::middleware::from_fn_with_state(checks, guard))
}

async fn state(State(hub): Shared) -> Response {
    Json(hub.lock().whole()).into_response()
}

async fn library(State(hub): Shared) -> Response {
    Json(&hub.lock().state.library).into_response()
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Types {
    types: Option<String>,
}

async fn events(
    State(hub): Shared,
    types: Result<Query<Types>, QueryRejection>,
) -> Result<Response, Problem> {
    let Query(Types { types }) = types.map_err(|rejection| Problem::Bad(rejection.body_text()))?;
    let filter = types.as_deref().map_or(Ok(EventFilter::ALL), EventFilter::parse);
    let stream = hub.subscribe(filter.map_err(Problem::Bad)?).ok_or(Problem::Readers)?;
    let headers = [(CONTENT_TYPE, "text/event-stream"), (CACHE_CONTROL, "no-cache")];
    Ok((headers, Body::from_stream(stream)).into_response())
}

async fn enroll(
    State(hub): Shared,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    send(&hub, "enroll", order::enroll(&body?).map_err(Problem::Bad)?)
}

async fn keep_refused(
    State(hub): Shared,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    send(&hub, "enroll/keep", order::keep_refused(&body?).map_err(Problem::Bad)?)
}

/// The description of all paths, for programs.
async fn open_api() -> Response {
    ([(CONTENT_TYPE, "application/json")], include_str!("openapi.json")).into_response()
}

#[derive(Serialize)]
struct Accepted {
    accepted: &'static str,
}

fn send(hub: &Hub, accepted: &'static str, order: Command) -> Result<Response, Problem> {
    hub.order(order)?;
    Ok((StatusCode::ACCEPTED, Json(Accepted { accepted })).into_response())
}

async fn all_metrics(State(hub): Shared) -> Response {
    ([(CONTENT_TYPE, metrics::CONTENT_TYPE)], hub.metrics()).into_response()
}

#[derive(Serialize)]
struct Health {
    status: &'static str,
}

async fn health(State(hub): Shared) -> Response {
    let (status, text) = match hub.lock().state.finished {
        false => (StatusCode::OK, "ok"),
        true => (StatusCode::SERVICE_UNAVAILABLE, "ended"),
    };
    (status, Json(Health { status: text })).into_response()
}

/// (path, content type, text) of each file.
pub const FILES: [(&str, &str, &str); 16] = [
    ("/", "text/html; charset=utf-8", include_str!("page/index.html")),
    ("/style.css", "text/css; charset=utf-8", include_str!("page/style.css")),
    ("/page.js", "text/javascript; charset=utf-8", include_str!("page/page.js")),
    ("/review.css", "text/css; charset=utf-8", include_str!("page/review.css")),
    ("/dom.js", "text/javascript; charset=utf-8", include_str!("page/dom.js")),
    ("/answer.js", "text/javascript; charset=utf-8", include_str!("page/answer.js")),
    ("/history.js", "text/javascript; charset=utf-8", include_str!("page/history.js")),
    ("/now.js", "text/javascript; charset=utf-8", include_str!("page/now.js")),
    ("/enrol.js", "text/javascript; charset=utf-8", include_str!("page/enrol.js")),
    ("/route.js", "text/javascript; charset=utf-8", include_str!("page/route.js")),
    ("/scan.js", "text/javascript; charset=utf-8", include_str!("page/scan.js")),
    ("/shelf.js", "text/javascript; charset=utf-8", include_str!("page/shelf.js")),
    ("/chart.js", "text/javascript; charset=utf-8", include_str!("page/chart.js")),
    ("/camera.js", "text/javascript; charset=utf-8", include_str!("page/camera.js")),
    ("/draw.js", "text/javascript; charset=utf-8", include_str!("page/draw.js")),
    ("/favicon.svg", "image/svg+xml", include_str!("page/favicon.svg")),
];

/// Answers with one of them.
pub fn file<S: Clone + Send + Sync + 'static>(
    content_type: &'static str,
    text: &'static str,
) -> MethodRouter<S> {
    // So that no browser shows the old page after an update of the program.
    let headers = [(CONTENT_TYPE, content_type), (CACHE_CONTROL, "no-cache")];
    get(move || async move { (headers, text).into_response() })
}
