//! Sends a test answer to each output, to check whether it arrives.

use std::future::Future;
use std::time::{Duration, Instant};

use rumqttc::{Event, MqttOptions, Packet, QoS};
use serde::Serialize;
use tokio::time::timeout;

use super::broker::{self, Line};
use super::{http, message};
use crate::history::HistoryError;
use crate::scan::Scan;
use crate::station::Answer;
use crate::station::config::{HttpAddress, OutputsConfig};

/// How long an output may take to deliver the test answer.
const PATIENCE: Duration = Duration::from_secs(10);

/// The result of sending the test answer to one output.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct OutputTest {
    pub output: String,
    pub arrived: bool,
    /// The reply of the receiver, or the problem.
    pub said: String,
}

/// Sends one answer to each output of a configuration.
pub(crate) fn test(config: &OutputsConfig) -> Result<Vec<OutputTest>, HistoryError> {
    let answer = Answer {
        reasons: vec!["a test of this output, and no scan".into()],
        ..Answer::of(&Scan::of_signals(0, Default::default()), 0.0)
    };
    let text = message::answer(&config.station, 0, &answer);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(|error| HistoryError::Io { path: "outputs".into(), error })?;
    let mut tests = Vec::new();
    if let Some(address) = &config.http {
        let done = runtime.block_on(tried(post(address, text.clone())));
        tests.push(OutputTest::of(address.to_string(), done));
    }
    if let Some(address) = &config.mqtt {
        let topic = format!("{}/{}/test", address.prefix, config.station);
        let options = broker::options(address, format!("surfaced-test-{}", std::process::id()))?;
        let done = runtime.block_on(tried(publish(options, &topic, text)));
        tests.push(OutputTest::of(format!("{address}/{}/test", config.station), done));
    }
    Ok(tests)
}

impl OutputTest {
    fn of(output: String, done: Result<String, String>) -> Self {
        Self { output, arrived: done.is_ok(), said: done.unwrap_or_else(|why| why) }
    }
}

async fn tried(work: impl Future<Output = Result<String, String>>) -> Result<String, String> {
    timeout(PATIENCE, work).await.unwrap_or_else(|_| Err("no answer in time".into()))
}

async fn post(address: &HttpAddress, text: String) -> Result<String, String> {
    let status = http::post(address, text).await?;
    if status.is_success() { Ok(format!("taken with {status}")) } else { Err(status.to_string()) }
}

async fn publish(options: MqttOptions, topic: &str, text: String) -> Result<String, String> {
    let (mut line, begin) = (Line::open(options), Instant::now());
    let published = line.client.try_publish(topic, QoS::AtLeastOnce, false, text);
    published.map_err(|error| error.to_string())?;
    while let Some(event) = line.events.recv().await {
        if let Event::Incoming(Packet::PubAck(_)) = event.map_err(|error| error.to_string())? {
            let _ = line.client.try_disconnect();
            return Ok(format!("acknowledged after {} ms", begin.elapsed().as_millis()));
        }
    }
    Err("the connection ended".into())
}
