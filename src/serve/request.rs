//! Helpers for handlers of requests, for bodies, labels, work on other threads, and refusals.

use axum::body::Bytes;
use axum::extract::rejection::{BytesRejection, QueryRejection};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Json, Response};
use serde_json::json;

use super::settings::LARGEST_BODY;
use crate::trial::normal;

const LONGEST_LABEL: usize = 80;
/// The characters that a label may contain besides letters, digits and spaces.
const MARKS: &str = "_-.,()+'%#";

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

impl Problem {
    fn kind(&self) -> (StatusCode, &'static str) {
        match self {
            Self::NotFound | Self::Gone(_) => (StatusCode::NOT_FOUND, "not_found"),
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

impl From<QueryRejection> for Problem {
    fn from(rejection: QueryRejection) -> Self {
        Self::Bad(rejection.body_text())
    }
}

/// Runs work that may wait for the disk, on a thread other than the server's.
pub async fn aside<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, Problem> + Send + 'static,
) -> Result<T, Problem> {
    let done = tokio::task::spawn_blocking(work).await;
    done.unwrap_or_else(|_| Err(Problem::Failed("this failed; please report it".into())))
}

/// The body of a request, or an error if it is too large.
pub type Said = Result<Bytes, BytesRejection>;

/// Parses the body of a request as JSON; an empty body counts as `{}`.
pub fn body<T: serde::de::DeserializeOwned>(said: Said, expected: &str) -> Result<T, Problem> {
    let body = said?;
    let text: &[u8] = if body.is_empty() { b"{}" } else { &body };
    serde_json::from_slice(text)
        .map_err(|error| Problem::Bad(format!("{error}; expected {expected}")))
}

/// Returns a label of a surface or user in normal form, without outer spaces. Refuses labels that are
/// unsafe in file names, pages or terminals. `what` names the field in the message.
pub fn label(what: &str, label: &str) -> Result<String, Problem> {
    let label = &*normal(label.trim());
    let odd = label.chars().find(|&c| !(c.is_alphanumeric() || c == ' ' || MARKS.contains(c)));
    Err(Problem::Bad(if label.is_empty() {
        format!("`{what}` is empty; give it a name, such as \"oak\"")
    } else if label.chars().count() > LONGEST_LABEL {
        format!("`{what}` is longer than {LONGEST_LABEL} characters")
    } else if label.starts_with('.') {
        format!("`{what}` begins with a dot; begin it with a letter or digit")
    } else if let Some(odd) = odd {
        let marks = MARKS.chars().map(String::from).collect::<Vec<_>>().join(" ");
        format!("`{what}` holds {odd:?}; use letters, digits, spaces and {marks}")
    } else {
        return Ok(label.into());
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn common_labels_are_taken_and_trimmed() {
        for name in ["oak", "G1EpoxyRasterPlate", "Eiche, geölt (2)", "木 100%", " oak "] {
            assert_eq!(label("surface", name).unwrap(), name.trim());
        }
        assert_eq!(label("surface", "e\u{301}rable").unwrap(), "\u{e9}rable");
    }

    #[test]
    fn what_could_mean_something_to_a_file_system_a_page_or_a_terminal_is_refused() {
        let long = "x".repeat(LONGEST_LABEL + 1);
        for name in [
            "",
            "  ",
            "../etc",
            ".",
            "a/b",
            "a\\b",
            "a\0b",
            "<script>",
            "a&b",
            "\u{1b}[2J",
            "a\nb",
            &long,
        ] {
            let said = label("surface", name).unwrap_err().to_string();
            assert!(said.contains("`surface`"), "{name:?}: {said}");
        }
    }
}
