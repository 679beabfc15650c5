//! Reads from the stations' histories the answers that the broker did not deliver.

use std::time::Duration;

use axum::body::Body;
use axum::http::{Request, StatusCode};
use serde::Deserialize;
use serde_json::Value;
use tokio::time::{sleep, timeout};

use super::Fleet;
use crate::outputs::http;
use crate::station::config::HttpAddress;

/// Interval at which stations with missing answers are looked for.
const EVERY: Duration = Duration::from_secs(1);
/// How many answers one request asks for. The reply may have at most `LARGEST` bytes.
const A_REQUEST: usize = 200;
const LARGEST: usize = 32 << 20;
/// How many requests one refill may send to a station.
const MOST: usize = 500;
/// How long a station may take to reply.
const PATIENCE: Duration = Duration::from_secs(10);

#[derive(Deserialize)]
struct Scans {
    scans: Vec<Value>,
}

/// Reads missing answers, one station after the other, without end.
pub(super) async fn refill(fleet: &Fleet) {
    loop {
        sleep(EVERY).await;
        loop {
            let next = fleet.lock().stations.next_to_read();
            let Some((station, page, from_ms)) = next else { break };
            let done = read(fleet, &station, &page, from_ms).await;
            fleet.lock().stations.was_read(&station, from_ms, done);
        }
    }
}

/// Reads the history of a station, from the newest scan back to the time `from_ms`.
async fn read(fleet: &Fleet, station: &str, page: &str, from_ms: u64) -> Result<(), String> {
    let address: HttpAddress = page.parse()?;
    let mut before = String::new();
    for _ in 0..MOST {
        let scans = request(&address, &before).await?;
        let is_last = scans.len() < A_REQUEST;
        let oldest_ms = scans.last().and_then(|scan| scan["unix_ms"].as_u64()).unwrap_or(0);
        before = format!(
            "&before={}",
            scans.last().and_then(|scan| scan["id"].as_str()).unwrap_or_default()
        );
        for scan in scans {
            add(fleet, station, scan)?;
        }
        if is_last || oldest_ms < from_ms {
            break;
        }
    }
    Ok(())
}

fn add(fleet: &Fleet, station: &str, mut scan: Value) -> Result<(), String> {
    // Outputs send no answer for a scan that could not be compared, so it is skipped here too.
    let was_compared = scan["state"] != "unnamed";
    let Some(fields) = scan.as_object_mut().filter(|_| was_compared) else { return Ok(()) };
    fields.insert("station".into(), station.into());
    // Corrections belong to the station and may change there, so they are removed.
    for said in ["correction", "became", "kept"] {
        fields.remove(said);
    }
    fleet.lock().answered(station, &scan)
}

async fn request(address: &HttpAddress, before: &str) -> Result<Vec<Value>, String> {
    let path = format!("/api/v1/scans?limit={A_REQUEST}{before}");
    let request = Request::get(path).body(Body::empty()).map_err(|error| error.to_string())?;
    let asked = http::send((&address.host.0, address.host.1), request, LARGEST);
    let (status, body) =
        timeout(PATIENCE, asked).await.map_err(|_| "its page gives no answer")??;
    match status {
        StatusCode::OK => {}
        StatusCode::UNAUTHORIZED => return Err("its page asks for a token".into()),
        StatusCode::MISDIRECTED_REQUEST => {
            return Err("its page answers only its own machine; run `surfaced fleet` there".into());
        }
        other => return Err(format!("its page answers {other}")),
    }
    serde_json::from_slice(&body?).map(|Scans { scans }| scans).map_err(|error| error.to_string())
}
