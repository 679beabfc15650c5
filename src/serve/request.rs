//! Parts shared by the handlers of requests: bodies, work on other threads, and refusals.

use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::State;
use axum::extract::rejection::BytesRejection;
use axum::http::StatusCode;
use axum::response::{IntoResponse, Json, Response};
use serde::Serialize;

use super::hub::Hub;
use super::settings::LARGEST_BODY;

/// Reasons for refusing a request.
#[derive(Debug, thiserror::Error)]
pub enum Problem {
    #[error("there is nothing here; see /api/v1/state")]
    NotFound,
    #[error("{0}")]
    Gone(String),
    #[error("{0}")]
    Failed(String),
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
    #[error("there are too many subscribers already")]
    Readers,
    #[error("{0:?} is not a name of this machine; use 127.0.0.1 or localhost")]
    Host(String),
    #[error("commands are accepted from this page only, not from {0:?}")]
    Origin(String),
    #[error("a token is needed: open /?token=…, or send `Authorization: Bearer …`")]
    Token,
    #[error("the station is busy with earlier commands; try again")]
    Busy,
    #[error("the station has ended")]
    Ended,
    #[error("this station keeps no scans; start it with --library LIB")]
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
            Self::Gone(_) => (StatusCode::NOT_FOUND, "not_found"),
            Self::Failed(_) => (StatusCode::CONFLICT, "failed"),
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

impl From<BytesRejection> for Problem {
    fn from(rejection: BytesRejection) -> Self {
        match rejection.status() {
            StatusCode::PAYLOAD_TOO_LARGE => Self::Large,
            _ => Self::Bad(rejection.body_text()),
        }
    }
}

/// The hub, as each handler gets it.
pub type Shared = State<Arc<Hub>>;

/// Runs work that may wait for the disk, on a thread other than the server's.
pub async fn aside<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, Problem> + Send + 'static,
) -> Result<T, Problem> {
    let done = tokio::task::spawn_blocking(work).await;
    done.unwrap_or_else(|_| Err(Problem::Failed("this failed; please report it".into())))
}

/// The body of a request as JSON; an empty one as `{}`.
pub fn body<T: serde::de::DeserializeOwned>(
    body: Result<Bytes, BytesRejection>,
    expected: &str,
) -> Result<T, Problem> {
    let body = body?;
    let text: &[u8] = if body.is_empty() { b"{}" } else { &body };
    serde_json::from_slice(text)
        .map_err(|error| Problem::Bad(format!("{error}; expected {expected}")))
}
