//! The interface for programs: what is at which path, and how problems are told.

use std::sync::Arc;

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::rejection::{BytesRejection, PathRejection, QueryRejection};
use axum::extract::{DefaultBodyLimit, Path, Query, State};
use axum::http::StatusCode;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::{IntoResponse, Json, Response};
use axum::routing::{get, post};
use serde::{Deserialize, Serialize};

use super::accept::LARGEST_BODY;
use super::guard::{Guard, guard};
use super::hub::{Hub, Undelivered};
use super::readers::Wants;
use super::state::Told;
use super::{Settings, metrics, order, page};
use crate::station::Command;

/// Why a request is refused.
#[derive(Debug, thiserror::Error)]
pub enum Problem {
    #[error("there is nothing here; see /api/v1/state")]
    NotFound,
    #[error("this path does not take that method")]
    Method,
    #[error("{0}")]
    Bad(String),
    #[error("the body is larger than {LARGEST_BODY} bytes")]
    Large,
    #[error("the request took too long")]
    Slow,
    #[error("too many requests; slow down")]
    TooOften,
    #[error("there are too many readers already")]
    Readers,
    #[error("the name {0:?} does not stand for this machine; use 127.0.0.1 or localhost")]
    Host(String),
    #[error("orders are taken from this page alone, not from {0:?}")]
    Origin(String),
    #[error("a token is needed: open /?token=…, or send `Authorization: Bearer …`")]
    Token,
    #[error("the station is busy with the orders before this one")]
    Busy,
    #[error("the station has ended")]
    Ended,
    #[error("this station keeps no scans; start it with --library LIB, a library to keep them in")]
    NoLibrary,
}

#[derive(Serialize)]
struct ProblemView {
    error: &'static str,
    message: String,
}

impl Problem {
    fn kind(&self) -> (StatusCode, &'static str) {
        match self {
            Self::NotFound => (StatusCode::NOT_FOUND, "not_found"),
            Self::Method => (StatusCode::METHOD_NOT_ALLOWED, "method_not_allowed"),
            Self::Bad(_) => (StatusCode::BAD_REQUEST, "bad_request"),
            Self::Large => (StatusCode::PAYLOAD_TOO_LARGE, "too_large"),
            Self::Slow => (StatusCode::REQUEST_TIMEOUT, "too_slow"),
            Self::TooOften => (StatusCode::TOO_MANY_REQUESTS, "too_often"),
            Self::Readers => (StatusCode::SERVICE_UNAVAILABLE, "too_many_readers"),
            Self::Host(_) => (StatusCode::MISDIRECTED_REQUEST, "wrong_host"),
            Self::Origin(_) => (StatusCode::FORBIDDEN, "wrong_origin"),
            Self::Token => (StatusCode::UNAUTHORIZED, "token_needed"),
            Self::Busy => (StatusCode::SERVICE_UNAVAILABLE, "busy"),
            Self::Ended => (StatusCode::CONFLICT, "ended"),
            Self::NoLibrary => (StatusCode::CONFLICT, "no_library"),
        }
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let (status, error) = self.kind();
        (status, Json(ProblemView { error, message: self.to_string() })).into_response()
    }
}

impl From<Undelivered> for Problem {
    fn from(undelivered: Undelivered) -> Self {
        match undelivered {
            Undelivered::Busy => Self::Busy,
            Undelivered::Ended => Self::Ended,
            Undelivered::NoLibrary => Self::NoLibrary,
        }
    }
}

impl From<BytesRejection> for Problem {
    fn from(rejection: BytesRejection) -> Self {
        match rejection.status() {
            StatusCode::PAYLOAD_TOO_LARGE => Self::Large,
            _ => Self::Bad(rejection.body_text()),
        }
    }
}

/// All paths, behind the guard.
pub fn router(hub: Arc<Hub>, settings: &Settings) -> Router {
    let checks = Arc::new(Guard::new(hub.clone(), settings));
    let api = Router::new()
        .route("/state", get(state))
        .route("/scans", get(scans))
        .route("/scans/{number}", get(scan))
        .route("/library", get(library))
        .route("/events", get(events))
        .route(
            "/start",
            post(|State(hub): Shared| async move { tell(&hub, "start", Command::Start) }),
        )
        .route("/stop", post(|State(hub): Shared| async move { tell(&hub, "stop", Command::Stop) }))
        .route(
            "/reload",
            post(|State(hub): Shared| async move { tell(&hub, "reload", Command::Reload) }),
        )
        .route("/enroll", post(enroll))
        .route(
            "/enroll/end",
            post(|State(hub): Shared| async move { tell(&hub, "enroll/end", Command::EndEnroll) }),
        );
    let mut router = Router::new()
        .nest("/api/v1", api)
        .route("/metrics", get(all_metrics))
        .route("/healthz", get(health));
    for (path, content_type, text) in page::FILES {
        router = router.route(path, page::file(content_type, text));
    }
    router
        .fallback(|| async { Problem::NotFound })
        .method_not_allowed_fallback(|| async { Problem::Method })
        .layer(DefaultBodyLimit::max(LARGEST_BODY))
        .layer(axum::middleware::from_fn_with_state(checks, guard))
        .with_state(hub)
}

type Shared = State<Arc<Hub>>;

async fn state(State(hub): Shared) -> Response {
    Json(hub.lock().whole()).into_response()
}

async fn library(State(hub): Shared) -> Response {
    Json(&hub.lock().state.library).into_response()
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Page {
    /// How many at most.
    limit: Option<usize>,
    /// Only scans before this one.
    before: Option<u32>,
}

#[derive(Serialize)]
struct Scans {
    scans: Vec<Arc<Told>>,
}

async fn scans(
    State(hub): Shared,
    page: Result<Query<Page>, QueryRejection>,
) -> Result<Json<Scans>, Problem> {
    let Query(page) = page.map_err(|rejection| Problem::Bad(rejection.body_text()))?;
    let inner = hub.lock();
    let scans = (inner.state.history.iter())
        .filter(|told| page.before.is_none_or(|before| told.answer.scan < before))
        .take(page.limit.unwrap_or(100))
        .cloned();
    Ok(Json(Scans { scans: scans.collect() }))
}

async fn scan(
    State(hub): Shared,
    number: Result<Path<u32>, PathRejection>,
) -> Result<Json<Arc<Told>>, Problem> {
    let Path(number) = number.map_err(|_| Problem::Bad("a scan is named by its number".into()))?;
    let inner = hub.lock();
    let told = inner.state.history.iter().find(|told| told.answer.scan == number);
    told.cloned().map(Json).ok_or(Problem::NotFound)
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
    let wants = types.as_deref().map_or(Ok(Wants::ALL), Wants::parse).map_err(Problem::Bad)?;
    let reading = hub.join(wants).ok_or(Problem::Readers)?;
    let headers = [(CONTENT_TYPE, "text/event-stream"), (CACHE_CONTROL, "no-cache")];
    Ok((headers, Body::from_stream(reading)).into_response())
}

async fn enroll(
    State(hub): Shared,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    tell(&hub, "enroll", order::enroll(&body?).map_err(Problem::Bad)?)
}

#[derive(Serialize)]
struct Accepted {
    accepted: &'static str,
}

fn tell(hub: &Hub, accepted: &'static str, order: Command) -> Result<Response, Problem> {
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
