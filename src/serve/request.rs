//! Helpers for handlers of requests: bodies, labels, work on other threads, long answers and refusals.

use std::io::{self, BufWriter, Write};

use axum::body::{Body, Bytes};
use axum::extract::Query;
use axum::extract::rejection::{BytesRejection, PathRejection, QueryRejection};
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Json, Response};
use serde_json::json;
use tokio::sync::mpsc::{Sender, channel};

use super::settings::LARGEST_BODY;
use super::subscribers::EventStream;
use crate::history::HistoryError;
use crate::library::LibraryError;
use crate::trial::checked_label;

/// How many scans one answer holds by default (`USUAL`) and at most (`MOST`).
pub(crate) const USUAL: usize = 100;
pub(crate) const MOST: usize = 1000;

#[derive(Debug, thiserror::Error)]
pub(crate) enum Problem {
    #[error("there is nothing here; see /api/v1/state")]
    NotFound,
    #[error("{0}")]
    Gone(String),
    #[error("{0}")]
    Failed(String),
    #[error(transparent)]
    Library(#[from] LibraryError),
    #[error("this path does not take that method")]
    Method,
    #[error("{0}")]
    Bad(String),
    #[error("{}", .0.body_text())]
    Path(#[from] PathRejection),
    #[error("{}", .0.body_text())]
    Query(#[from] QueryRejection),
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
    #[error(
        "only an administrator may do this; open /?token=… with the administrator's token, or send \
         that one"
    )]
    Role,
    #[error("the station is busy with earlier commands; try again")]
    Busy,
    #[error("the station has ended")]
    Ended,
    #[error("this station has no trials to change or read again; start it with --library LIB")]
    NoLibrary,
    #[error("{0} enrols {1} now; end that first, or replace it")]
    Standing(String, String),
}

/// The query of a request, which may hold something else.
pub(crate) type Asked<T> = Result<Query<T>, QueryRejection>;
pub(crate) type Reply<T = Response> = Result<T, Problem>;

impl Problem {
    /// The status of the answer, and the word for programs.
    pub(crate) fn kind(&self) -> (StatusCode, &'static str) {
        match self {
            Self::NotFound | Self::Gone(_) => (StatusCode::NOT_FOUND, "not_found"),
            Self::Failed(_) | Self::Library(_) => (StatusCode::CONFLICT, "failed"),
            Self::Method => (StatusCode::METHOD_NOT_ALLOWED, "method_not_allowed"),
            Self::Bad(_) | Self::Path(_) | Self::Query(_) => {
                (StatusCode::BAD_REQUEST, "bad_request")
            }
            Self::Large => (StatusCode::PAYLOAD_TOO_LARGE, "too_large"),
            Self::Slow => (StatusCode::REQUEST_TIMEOUT, "too_slow"),
            Self::TooOften => (StatusCode::TOO_MANY_REQUESTS, "too_often"),
            Self::Readers => (StatusCode::SERVICE_UNAVAILABLE, "too_many_readers"),
            Self::Host(_) => (StatusCode::MISDIRECTED_REQUEST, "wrong_host"),
            Self::Origin(_) => (StatusCode::FORBIDDEN, "wrong_origin"),
            Self::Token => (StatusCode::UNAUTHORIZED, "token_needed"),
            Self::Role => (StatusCode::FORBIDDEN, "administrator_needed"),
            Self::Busy => (StatusCode::SERVICE_UNAVAILABLE, "busy"),
            Self::Ended => (StatusCode::CONFLICT, "ended"),
            Self::NoLibrary => (StatusCode::CONFLICT, "no_library"),
            Self::Standing(..) => (StatusCode::CONFLICT, "enrolling"),
        }
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let (status, error) = self.kind();
        (status, Json(json!({ "error": error, "message": self.to_string() }))).into_response()
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

impl From<HistoryError> for Problem {
    fn from(error: HistoryError) -> Self {
        match error {
            HistoryError::NoScan(_) => Self::NotFound,
            HistoryError::NoSignals(_) => Self::Gone(error.to_string()),
            _ => Self::Failed(error.to_string()),
        }
    }
}

/// Runs work that may wait for the disk, on a thread other than the server's.
pub(crate) async fn aside<T: Send + 'static>(
    work: impl FnOnce() -> Reply<T> + Send + 'static,
) -> Reply<T> {
    let done = tokio::task::spawn_blocking(work).await;
    done.unwrap_or_else(|_| Err(Problem::Failed("this failed; please report it".into())))
}

pub(crate) const CSV: &str = "text/csv; charset=utf-8";
pub(crate) const JSON_LINES: &str = "application/jsonl";
/// The text is sent in blocks of `PIECE` bytes, of which at most `PIECES` may wait for the client.
const PIECE: usize = 64 << 10;
const PIECES: usize = 4;

/// A writer that sends blocks to a client, as fast as the client takes them.
pub(crate) struct Pieces(Sender<io::Result<Bytes>>);

impl Write for Pieces {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let sent = self.0.blocking_send(Ok(Bytes::copy_from_slice(bytes)));
        sent.map(|()| bytes.len()).map_err(|_| io::ErrorKind::BrokenPipe.into())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// An answer that `write` writes on a thread of its own.
pub(crate) fn exported(
    content_type: &'static str,
    write: impl FnOnce(BufWriter<Pieces>) -> io::Result<()> + Send + 'static,
) -> Response {
    let (send, pieces) = channel(PIECES);
    tokio::task::spawn_blocking(move || {
        let out = BufWriter::with_capacity(PIECE, Pieces(send.clone()));
        if let Err(error) = write(out) {
            // The client sees that the text is cut short. If the client is gone, sending fails.
            let _ = send.blocking_send(Err(error));
        }
    });
    ([(CONTENT_TYPE, content_type)], Body::from_stream(EventStream(pieces))).into_response()
}

pub(crate) type Said = Result<Bytes, BytesRejection>;

/// Parses the body of a request as JSON; an empty body counts as `{}`.
pub(crate) fn body<T: serde::de::DeserializeOwned>(said: Said, expected: &str) -> Reply<T> {
    let body = said?;
    let text: &[u8] = if body.is_empty() { b"{}" } else { &body };
    serde_json::from_slice(text)
        .map_err(|error| Problem::Bad(format!("{error}; expected {expected}")))
}

/// The `what` of a request, which are neither none nor too many.
pub(crate) fn few(what: &str, all: Vec<String>) -> Reply<Vec<String>> {
    match all.len() {
        1..=MOST => Ok(all),
        n => Err(Problem::Bad(format!("{n} {what}; expected 1 to {MOST}"))),
    }
}

/// The checked label of a surface or user; messages call the field `what`.
pub(crate) fn label(what: &str, label: &str) -> Reply<String> {
    checked_label(label).map_err(|why| Problem::Bad(format!("`{what}` {why}")))
}
