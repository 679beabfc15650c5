//! What handlers of requests share.

use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::State;
use axum::extract::rejection::BytesRejection;

use super::hub::Hub;
use super::problem::Problem;

/// What each handler gets.
pub type Shared = State<Arc<Hub>>;

/// Does what may wait for the disk, on another thread than the server's own.
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
