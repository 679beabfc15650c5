//! Sends answers by HTTP POST, one JSON document each.

use std::path::Path;
use std::time::Duration;

use axum::body::Body;
use axum::http::header::{CONTENT_TYPE, HOST};
use axum::http::{HeaderName, HeaderValue, Request, Response, StatusCode};
use hyper::body::Incoming;
use hyper_util::rt::TokioIo;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tokio::time::{Instant, timeout_at};
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::pki_types::ServerName;

use super::{BackOff, OutputHealth, Pending, Said, Sent, tls, within};
use crate::history::HistoryError;
use crate::station::config::HttpAddress;

const LONGEST_ATTEMPT: Duration = Duration::from_secs(5);

/// An address, and what its files say about how to reach it.
pub(crate) struct Receiver {
    pub address: HttpAddress,
    /// The header that tells who sends, such as `Authorization`.
    header: Option<(HeaderName, HeaderValue)>,
    tls: Option<TlsConnector>,
}

impl Receiver {
    /// Reads the files of an address; fails if one cannot be used.
    pub(crate) fn of(address: &HttpAddress) -> Result<Self, HistoryError> {
        let header = address.header_file.as_deref().map(header).transpose()?;
        let tls = address.tls.as_ref().map(tls::connector).transpose()?;
        Ok(Self { address: address.clone(), header, tls })
    }
}

fn header(path: &Path) -> Result<(HeaderName, HeaderValue), HistoryError> {
    let text = tls::read(path)?;
    let parsed = str::from_utf8(&text).ok().and_then(|text| {
        let (name, value) = text.trim_ascii().split_once(':')?;
        let mut value: HeaderValue = value.trim_ascii().parse().ok()?;
        value.set_sensitive(true);
        Some((name.parse().ok()?, value))
    });
    let expected = "expected one line with a header, such as `Authorization: Bearer SECRET`";
    parsed.ok_or_else(|| tls::unusable(path, expected))
}

/// Posts the answers of a station. After its end, returns once all arrived or an attempt failed.
pub(super) async fn post_all(
    mut pending: Pending,
    receiver: Receiver,
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
        if deliver(&pending.health, &receiver, text).await {
            pending.done(sequence);
            back_off = BackOff::new();
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
async fn deliver(health: &OutputHealth, receiver: &Receiver, answer: String) -> bool {
    let why = match within(LONGEST_ATTEMPT, post(receiver, answer)).await {
        Ok(status) if status.is_success() => {
            health.arrived();
            return true;
        }
        // Redirects are not followed, and a second attempt would get the same redirect.
        Ok(status) if status.is_redirection() => {
            health.failed(&format!(
                "{status}, a redirect, which is not followed; write the new address into the \
                 configuration"
            ));
            return true;
        }
        Ok(status) if status.is_client_error() && status != StatusCode::TOO_MANY_REQUESTS => {
            health.failed(&format!("refused with {status}"));
            return true;
        }
        Ok(status) => status.to_string(),
        Err(why) => why.to_string(),
    };
    health.failed(&format!("{why}; they are tried again"));
    false
}

pub(super) async fn post(receiver: &Receiver, answer: String) -> Sent<StatusCode> {
    let request = Request::post(&receiver.address.path)
        .header(CONTENT_TYPE, "application/json")
        .body(Body::from(answer))?;
    Ok(send(receiver, request).await?.status())
}

/// Sends a request to the host of an address.
pub(crate) async fn send(
    receiver: &Receiver,
    mut request: Request<Body>,
) -> Sent<Response<Incoming>> {
    let Receiver { address, header, tls } = receiver;
    let (host, port) = (address.host.0.as_str(), address.host.1);
    request.headers_mut().insert(HOST, address.authority().parse()?);
    request.headers_mut().extend(header.clone());
    let stream = TcpStream::connect((host, port)).await?;
    let Some(tls) = tls else { return exchange(stream, request).await };
    let name = ServerName::try_from(host.to_string())?;
    exchange(tls.connect(name, stream).await?, request).await
}

async fn exchange(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    request: Request<Body>,
) -> Sent<Response<Incoming>> {
    let (mut sender, connection) =
        hyper::client::conn::http1::handshake(TokioIo::new(stream)).await?;
    // An error of the connection also reaches `send_request`, so the connection's copy is dropped.
    // The connection ends when its reply is read or dropped.
    tokio::spawn(async move { drop(connection.await) });
    Ok(sender.send_request(request).await?)
}
