//! Answers that are too long to be held in memory, such as all past scans.

use std::io::{self, BufWriter, Write};

use axum::body::{Body, Bytes};
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Response};
use tokio::sync::mpsc::{Sender, channel};

use super::subscribers::EventStream;

pub const CSV: &str = "text/csv; charset=utf-8";
pub const JSON_LINES: &str = "application/jsonl";
/// The text is sent in blocks of `PIECE` bytes, of which at most `PIECES` may wait for the client.
const PIECE: usize = 64 << 10;
const PIECES: usize = 4;

/// A writer that sends blocks to a client, as fast as the client takes them.
pub struct Pieces(Sender<io::Result<Bytes>>);

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
pub fn exported(
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
