//! Answers by HTTP POST: each as one JSON document.

use std::sync::Arc;
use std::time::Duration;

use axum::body::Body;
use axum::http::header::CONTENT_TYPE;
use axum::http::{Request, StatusCode};
use tokio::sync::mpsc;
use tokio::time::{Instant, timeout, timeout_at};

use super::{BackOff, Pending, client};
use crate::station::Answer;
use crate::station::config::HttpAddress;

/// How long one attempt may take.
const ATTEMPT: Duration = Duration::from_secs(5);

/// Posts the answers of a station.
#[derive(Debug)]
pub(super) struct Poster {
    pending: Pending,
    address: HttpAddress,
    back_off: BackOff,
}

impl Poster {
    pub fn new(pending: Pending, address: &HttpAddress) -> Self {
        Self { pending, address: address.clone(), back_off: BackOff::new() }
    }

    /// Posts answers until no more come, and all arrived or one attempt failed.
    pub async fn run(mut self, mut answers: mpsc::Receiver<Arc<Answer>>) {
        loop {
            while let Ok(answer) = answers.try_recv() {
                self.pending.add(&answer);
            }
            let Some((sequence, text)) = self.pending.first() else {
                let Some(answer) = answers.recv().await else { return };
                self.pending.add(&answer);
                continue;
            };
            if self.deliver(text).await {
                self.pending.done(sequence);
                self.back_off.reset();
                continue;
            }
            let until = Instant::now() + self.back_off.next();
            while let Ok(answer) = timeout_at(until, answers.recv()).await {
                let Some(answer) = answer else { return };
                self.pending.add(&answer);
            }
        }
    }

    /// Posts one answer; true if it was taken, or refused for good.
    async fn deliver(&self, answer: String) -> bool {
        let health = &self.pending.health;
        let why = match timeout(ATTEMPT, post(&self.address, answer)).await {
            Ok(Ok(status)) if status.is_success() => {
                health.arrived();
                return true;
            }
            // It will not be taken another time either.
            Ok(Ok(status)) if status.is_redirection() => {
                health.failed(&format!(
                    "{status}, a redirect, which is not followed; write the new address into the \
                     configuration"
                ));
                return true;
            }
            Ok(Ok(status))
                if status.is_client_error() && status != StatusCode::TOO_MANY_REQUESTS =>
            {
                health.failed(&format!("refused with {status}"));
                return true;
            }
            Ok(Ok(status)) => status.to_string(),
            Ok(Err(error)) => error,
            Err(_) => "no answer in time".into(),
        };
        health.failed(&format!("{why}; they are tried again"));
        false
    }
}

/// Posts one answer, and gives the status of the reply.
pub(super) async fn post(address: &HttpAddress, answer: String) -> Result<StatusCode, String> {
    let HttpAddress { host, path } = address;
    let request = Request::post(path)
        .header(CONTENT_TYPE, "application/json")
        .body(Body::from(answer))
        .map_err(|error| error.to_string())?;
    // What it says beside the status does not matter.
    let (status, _) = client::send((&host.0, host.1), request, 0).await?;
    Ok(status)
}
