//! Answers by HTTP POST: each as one JSON document.

use std::convert::Infallible;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::body::Body;
use axum::http::header::{CONTENT_TYPE, HOST};
use axum::http::{Request, StatusCode};
use crossbeam_channel::{Sender, bounded};
use hyper_util::rt::TokioIo;
use tokio::net::TcpStream;
use tokio::runtime::Runtime;

use super::{BackOff, OutputHealth, PATIENCE, QUEUE};
use crate::station::config::HttpAddress;
use crate::station::{End, Listener, StationEvent};

/// How long one attempt may take.
const ATTEMPT: Duration = Duration::from_secs(5);

/// Posts the answers of a station.
#[derive(Debug)]
pub struct HttpOutput {
    answers: Option<Sender<String>>,
    health: OutputHealth,
    ending: Arc<AtomicBool>,
    end: End,
}

struct Poster {
    health: OutputHealth,
    address: HttpAddress,
    runtime: Runtime,
    back_off: BackOff,
    ending: Arc<AtomicBool>,
}

impl HttpOutput {
    /// Posts to an address from now on.
    ///
    /// # Errors
    /// If the system gives no thread, or no means to wait on sockets.
    pub fn start(address: HttpAddress) -> std::io::Result<Self> {
        let (answers, to_post) = bounded::<String>(QUEUE);
        let (ending, ended) = bounded::<Infallible>(0);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let stop = Arc::new(AtomicBool::new(false));
        let HttpAddress { host, path } = &address;
        let health = OutputHealth::new(format!("http://{}:{}{path}", host.0, host.1));
        let (back_off, ending_too) = (BackOff::new(), stop.clone());
        let mut poster =
            Poster { health: health.clone(), address, runtime, back_off, ending: ending_too };
        let run = move || {
            let _ending = ending;
            for answer in &to_post {
                poster.health.waits(to_post.len() + 1);
                poster.deliver(&answer);
                poster.health.waits(to_post.len());
            }
        };
        std::thread::Builder::new().name("http-output".into()).spawn(run)?;
        Ok(Self { answers: Some(answers), health, ending: stop, end: End::of(ended) })
    }

    /// How it is, now and later.
    pub fn health(&self) -> OutputHealth {
        self.health.clone()
    }
}

impl Listener for HttpOutput {
    fn on_event(&mut self, event: &StationEvent) {
        if self.end.is_here(event) {
            self.close();
        }
        let (StationEvent::Answer(answer), Some(answers)) = (event, &self.answers) else { return };
        // Plain structs, numbers and text: nothing here that JSON cannot express.
        let text = serde_json::to_string(&**answer).unwrap_or_default();
        if answers.try_send(text).is_err() {
            self.health
                .failed(&format!("{QUEUE} wait already, so answer {} is dropped", answer.id));
        }
    }
}

impl Drop for HttpOutput {
    fn drop(&mut self) {
        self.close();
        self.end.wait(PATIENCE);
    }
}

impl HttpOutput {
    /// Takes no more answers; those that wait are tried once.
    fn close(&mut self) {
        self.answers.take();
        self.ending.store(true, Ordering::Release);
    }
}

impl Poster {
    /// Posts one answer, again and again until it is taken or refused; at the end, once.
    fn deliver(&mut self, answer: &str) {
        loop {
            match self.post(answer) {
                Ok(status) if status.is_success() => {
                    self.health.arrived();
                    return self.back_off.reset();
                }
                // It will not be taken another time either.
                Ok(status) if status.is_redirection() => {
                    return self.health.failed(&format!(
                        "{status}, a redirect, which is not followed; write the new address into \
                         the configuration"
                    ));
                }
                Ok(status)
                    if status.is_client_error() && status != StatusCode::TOO_MANY_REQUESTS =>
                {
                    return self.health.failed(&format!("refused with {status}"));
                }
                Ok(status) => self.health.failed(&format!("{status}; they are tried again")),
                Err(error) => self.health.failed(&format!("{error}; they are tried again")),
            }
            self.back_off.wait(&self.ending);
            if self.ending.load(Ordering::Acquire) {
                return;
            }
        }
    }

    fn post(&self, answer: &str) -> Result<StatusCode, String> {
        let attempt = async { tokio::time::timeout(ATTEMPT, self.attempt(answer)).await };
        self.runtime.block_on(attempt).map_err(|_| "no answer in time".to_string())?
    }

    async fn attempt(&self, answer: &str) -> Result<StatusCode, String> {
        let HttpAddress { host, path } = &self.address;
        let to_text = |error: &dyn std::fmt::Display| error.to_string();
        let connected = TcpStream::connect((host.0.as_str(), host.1)).await;
        let stream = TokioIo::new(connected.map_err(|error| to_text(&error))?);
        let (mut sender, connection) =
            hyper::client::conn::http1::handshake(stream).await.map_err(|e| to_text(&e))?;
        // Its error is the sender's, too.
        tokio::spawn(async move { drop(connection.await) });
        let request = Request::post(path)
            .header(HOST, format!("{}:{}", host.0, host.1))
            .header(CONTENT_TYPE, "application/json")
            .body(Body::from(answer.to_string()))
            .map_err(|error| to_text(&error))?;
        let response = sender.send_request(request).await.map_err(|error| to_text(&error))?;
        Ok(response.status())
    }
}
