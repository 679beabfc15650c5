//! A small HTTP client, for addresses without TLS.

use axum::body::{Body, Bytes, to_bytes};
use axum::http::header::HOST;
use axum::http::{Request, StatusCode};
use hyper_util::rt::TokioIo;
use tokio::net::TcpStream;

/// Sends a request to a host and its port. Of the answer at most `most` bytes are read: the body is an
/// error where it is longer, or cannot be read.
///
/// # Errors
/// With the reason, if the host cannot be reached or gives no answer.
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
    // Its error is the sender's, too.
    let connection = tokio::spawn(async move { drop(connection.await) });
    let answer = sender.send_request(request).await.map_err(|error| text(&error))?;
    let status = answer.status();
    let body = to_bytes(Body::new(answer.into_body()), most).await;
    connection.abort();
    Ok((status, body.map_err(|error| text(&error))))
}
