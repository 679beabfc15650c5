//! Sends answers by HTTP POST, one JSON document each.

use std::sync::Arc;
use std::time::Duration;

use axum::body::{Body, Bytes, to_bytes};
use axum::http::header::{CONTENT_TYPE, HOST};
use axum::http::{Request, StatusCode};
use hyper_util::rt::TokioIo;
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tokio::time::{Instant, timeout, timeout_at};

use super::{BackOff, OutputHealth, Pending};
use crate::station::Answer;
use crate::station::config::HttpAddress;

const LONGEST_ATTEMPT: Duration = Duration::from_secs(5);

/// Posts the answers of a station. After its end, returns once all arrived or an attempt failed.
pub(super) async fn post_all(
    mut pending: Pending,
    address: HttpAddress,
    mut answers: mpsc::Receiver<Arc<Answer>>,
) {
    let mut back_off = BackOff::new();
    loop {
        while let Ok(answer) = answers.try_recv() {
            pending.add(&answer);
        }
        let Some((sequence, text)) = pending.first() else {
            let Some(answer) = answers.recv().await else { return };
            pending.add(&answer);
            continue;
        };
        if deliver(&pending.health, &address, text).await {
            pending.done(sequence);
            back_off.reset();
            continue;
        }
        let until = Instant::now() + back_off.next();
        while let Ok(answer) = timeout_at(until, answers.recv()).await {
            let Some(answer) = answer else { return };
            pending.add(&answer);
        }
    }
}

/// Posts one answer; true if the answer was accepted, or refused for good.
async fn deliver(health: &OutputHealth, address: &HttpAddress, answer: String) -> bool {
    let why = match timeout(LONGEST_ATTEMPT, post(address, answer)).await {
        Ok(Ok(status)) if status.is_success() => {
            health.arrived();
            return true;
        }
        // Redirects are not followed, and a second attempt would get the same redirect.
        Ok(Ok(status)) if status.is_redirection() => {
            health.failed(&format!(
                "{status}, a redirect, which is not followed; write the new address into the \
                 configuration"
            ));
            return true;
        }
        Ok(Ok(status @ StatusCode::TOO_MANY_REQUESTS)) => status.to_string(),
        Ok(Ok(status)) if status.is_client_error() => {
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

pub(super) async fn post(address: &HttpAddress, answer: String) -> Result<StatusCode, String> {
    let HttpAddress { host, path } = address;
    let request = Request::post(path)
        .header(CONTENT_TYPE, "application/json")
        .body(Body::from(answer))
        .map_err(|error| error.to_string())?;
    // Only the status matters, so the body of the reply is not used.
    Ok(send((&host.0, host.1), request, 0).await?.0)
}

/// Sends a request to a host and port, without TLS. Reads at most `most` bytes of the reply; a
/// longer or unreadable body is an error.
///
/// # Errors
/// With the reason, if the host cannot be reached or gives no reply.
pub(crate) async fn send(
    (host, port): (&str, u16),
    mut request: Request<Body>,
    most: usize,
) -> Result<(StatusCode, Result<Bytes, String>), String> {
    let text = |error: &dyn std::fmt::Display| error.to_string();
    let name =
        if host.contains(':') { format!("[{host}]:{port}") } else { format!("{host}:{port}") };
    let name = name.parse().map_err(|error| text(&error))?;
    request.headers_mut().insert(HOST, name);
    let stream = TcpStream::connect((host, port)).await.map_err(|error| text(&error))?;
    let connected = hyper::client::conn::http1::handshake(TokioIo::new(stream)).await;
    let (mut sender, connection) = connected.map_err(|error| text(&error))?;
    // An error of the connection also reaches `send_request`, so the connection's copy is dropped.
    let connection = tokio::spawn(async move { drop(connection.await) });
    let answer = sender.send_request(request).await.map_err(|error| text(&error))?;
    let status = answer.status();
    let body = to_bytes(Body::new(answer.into_body()), most).await;
    connection.abort();
    Ok((status, body.map_err(|error| text(&error))))
}
