//! Sends answers by HTTP POST, one JSON document each.

use std::time::Duration;

use axum::body::Body;
use axum::http::header::{CONTENT_TYPE, HOST};
use axum::http::{Request, Response, StatusCode};
use hyper::body::Incoming;
use hyper_util::rt::TokioIo;
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tokio::time::{Instant, timeout, timeout_at};

use super::{BackOff, OutputHealth, Pending, Said};
use crate::station::config::HttpAddress;

const LONGEST_ATTEMPT: Duration = Duration::from_secs(5);

/// Posts the answers of a station. After its end, returns once all arrived or an attempt failed.
pub(super) async fn post_all(
    mut pending: Pending,
    address: HttpAddress,
    mut answers: mpsc::Receiver<Said>,
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
    let request = Request::post(&address.path)
        .header(CONTENT_TYPE, "application/json")
        .body(Body::from(answer))
        .map_err(|error| error.to_string())?;
    Ok(send(address, request).await?.status())
}

/// Sends a request to the host of an address, without TLS; fails with the reason.
pub(crate) async fn send(
    address: &HttpAddress,
    mut request: Request<Body>,
) -> Result<Response<Incoming>, String> {
    let text = |error: &dyn std::fmt::Display| error.to_string();
    let (host, port) = (address.host.0.as_str(), address.host.1);
    let name =
        if host.contains(':') { format!("[{host}]:{port}") } else { format!("{host}:{port}") };
    let name = name.parse().map_err(|error| text(&error))?;
    request.headers_mut().insert(HOST, name);
    let stream = TcpStream::connect((host, port)).await.map_err(|error| text(&error))?;
    let connected = hyper::client::conn::http1::handshake(TokioIo::new(stream)).await;
    let (mut sender, connection) = connected.map_err(|error| text(&error))?;
    // An error of the connection also reaches `send_request`, so the connection's copy is dropped.
    // The connection ends when its reply is read or dropped.
    tokio::spawn(async move { drop(connection.await) });
    sender.send_request(request).await.map_err(|error| text(&error))
}
