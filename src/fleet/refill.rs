//! Reads answers that the broker did not deliver from the stations' own histories.

use std::net::IpAddr;
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;

use axum::body::{Body, to_bytes};
use axum::http::{Request, StatusCode};
use serde::Deserialize;
use serde_json::Value;
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};

use super::Fleet;
use super::state::Due;
use crate::outputs::Sent;
use crate::outputs::http::{self, Receiver};
use crate::station::config::HttpAddress;

/// Hosts whose pages may be asked. A station names its page itself, so it could name any.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Pages {
    Host(String),
    /// All names that end with this, which begins with a dot.
    Below(String),
    /// An address and how many of its first bits count; all of them for one address.
    Network(IpAddr, u32),
}

impl FromStr for Pages {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let expected = "expected a host, such as press-3.hall, *.hall, 10.0.3.7 or 10.0.3.0/24";
        let (address, bits) = text.split_once('/').unzip();
        if let Ok(ip) = address.unwrap_or(text).parse::<IpAddr>() {
            let all = if ip.is_ipv4() { 32 } else { 128 };
            let bits = bits.map_or(Some(all), |bits| bits.parse().ok().filter(|n| *n <= all));
            return bits.map(|bits| Self::Network(ip, bits)).ok_or_else(|| expected.into());
        }
        let name = text.to_ascii_lowercase();
        let is_plain = |name: &str| {
            !name.is_empty() && name.chars().all(|c| c.is_ascii_alphanumeric() || "-_.".contains(c))
        };
        match name.strip_prefix('*') {
            Some(end) if end.starts_with('.') && is_plain(end) => Ok(Self::Below(end.into())),
            None if is_plain(&name) => Ok(Self::Host(name)),
            _ => Err(expected.into()),
        }
    }
}

impl Pages {
    fn allow(&self, host: &str) -> bool {
        let host = host.trim_start_matches('[').trim_end_matches(']').to_lowercase();
        match self {
            Self::Host(name) => *name == host,
            Self::Below(end) => host.ends_with(end.as_str()) && host.parse::<IpAddr>().is_err(),
            Self::Network(network, bits) => host.parse::<IpAddr>().is_ok_and(|host| {
                let differing = from_left(*network) ^ from_left(host);
                network.is_ipv4() == host.is_ipv4() && differing.leading_zeros() >= *bits
            }),
        }
    }
}

/// The bits of an address; those of a short one stand on the left.
fn from_left(address: IpAddr) -> u128 {
    match address {
        IpAddr::V4(address) => u128::from(address.to_bits()) << 96,
        IpAddr::V6(address) => address.to_bits(),
    }
}

/// Interval at which stations with missing answers are looked for.
const EVERY: Duration = Duration::from_secs(1);
/// How many answers one request asks for. The reply may have at most `LARGEST` bytes.
const A_REQUEST: usize = 200;
const LARGEST: usize = 32 << 20;
const MOST_REQUESTS_A_STATION: usize = 500;
const REPLY_PATIENCE: Duration = Duration::from_secs(10);
const HISTORY_PATIENCE: Duration = Duration::from_secs(300);
/// How many stations are read at once.
const AT_ONCE: usize = 16;

#[derive(Deserialize)]
struct Scans {
    scans: Vec<Value>,
}

/// Reads missing answers without end, of several stations at once, so that a slow one holds up none.
pub(super) async fn refill(fleet: &Arc<Fleet>, pages: Arc<[Pages]>) {
    let mut reading = JoinSet::new();
    loop {
        tokio::select! {
            () = sleep(EVERY) => {}
            Some(_) = reading.join_next() => {}
        }
        while reading.len() < AT_ONCE {
            let Some(due) = fleet.lock().stations.next_to_read() else { break };
            reading.spawn(read_due(fleet.clone(), due, pages.clone()));
        }
    }
}

async fn read_due(fleet: Arc<Fleet>, due: Due, pages: Arc<[Pages]>) {
    let all = timeout(HISTORY_PATIENCE, read(&fleet, &due, &pages)).await;
    let done = all.unwrap_or_else(|_| Err("its page is too slow".into()));
    let (station, _, from_ms) = due;
    fleet.lock().stations.was_read(&station, from_ms, done.map_err(|why| why.to_string()));
}

/// Reads the history of a station, from the newest scan back to the time where to begin.
async fn read(fleet: &Fleet, due: &Due, pages: &[Pages]) -> Sent<()> {
    let (station, page, from_ms) = due;
    let address: HttpAddress = page.parse()?;
    let host = &address.host.0;
    if !pages.iter().any(|pages| pages.allow(host)) {
        return Err(format!("to ask its page, start the fleet with --pages {host}").into());
    }
    let receiver = Receiver::of(&address)?;
    let mut before = String::new();
    for _ in 0..MOST_REQUESTS_A_STATION {
        let scans = request(&receiver, &before).await?;
        let is_last = scans.len() < A_REQUEST;
        let oldest = scans.last().unwrap_or(&Value::Null);
        let oldest_ms = oldest["unix_ms"].as_u64().unwrap_or(0);
        before = format!("&before={}", oldest["id"].as_str().unwrap_or_default());
        for scan in scans {
            add(fleet, station, scan)?;
        }
        if is_last || oldest_ms < *from_ms {
            break;
        }
    }
    Ok(())
}

fn add(fleet: &Fleet, station: &str, mut scan: Value) -> Sent<()> {
    // Outputs send no answer for a scan that could not be compared, so it is skipped here too.
    let was_compared = scan["state"] != "unnamed";
    let Some(fields) = scan.as_object_mut().filter(|_| was_compared) else { return Ok(()) };
    fields.insert("station".into(), station.into());
    // Corrections belong to the station and may change there, so they are removed.
    for said in ["correction", "became", "kept"] {
        fields.remove(said);
    }
    fleet.lock().answered(station, scan)
}

async fn request(receiver: &Receiver, before: &str) -> Sent<Vec<Value>> {
    // Behind a proxy, a page may be in a folder.
    let folder = receiver.address.path.trim_end_matches('/');
    let path = format!("{folder}/api/v1/scans?limit={A_REQUEST}{before}");
    let request = Request::get(path).body(Body::empty())?;
    let reply = timeout(REPLY_PATIENCE, async {
        let reply = http::send(receiver, request).await?;
        let status = reply.status();
        Sent::Ok((status, to_bytes(Body::new(reply.into_body()), LARGEST).await))
    });
    let (status, body) = reply.await.map_err(|_| "its page gives no answer")??;
    match status {
        StatusCode::OK => {}
        StatusCode::UNAUTHORIZED => return Err("its page asks for a token".into()),
        StatusCode::MISDIRECTED_REQUEST => {
            return Err("its page answers only its own machine; run `surfaced fleet` there".into());
        }
        other => return Err(format!("its page answers {other}").into()),
    }
    let Scans { scans } = serde_json::from_slice(&body?)?;
    Ok(scans)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_pages_that_were_allowed_are_asked() {
        let allows = |pages: &str, host: &str| pages.parse::<Pages>().unwrap().allow(host);
        for (pages, host, is_allowed) in [
            ("press-3", "Press-3", true),
            ("*.hall", "press-3.hall", true),
            ("10.0.3.7", "10.0.3.7", true),
            ("10.0.3.0/24", "10.0.3.200", true),
            ("0.0.0.0/0", "192.168.1.1", true),
            ("::1", "[::1]", true),
            ("fd00::/8", "fd12::1", true),
            ("press-3", "press-3.evil", false),
            ("*.hall", "hall", false),
            ("*.hall", "hall.evil", false),
            ("10.0.3.7", "10.0.3.8", false),
            ("10.0.3.0/24", "10.0.4.1", false),
            ("10.0.3.0/24", "10.0.3.1.evil", false),
            ("10.0.3.0/24", "::1", false),
        ] {
            assert_eq!(allows(pages, host), is_allowed, "{pages} {host}");
        }
        for pages in
            ["", "*", "*hall", "a/b", "10.0.3.0/33", "http://press-3", "press-3:8080", "a b"]
        {
            assert!(pages.parse::<Pages>().is_err(), "{pages}");
        }
    }
}
