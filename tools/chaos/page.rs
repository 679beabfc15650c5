//! Readers of the page, some of them stalled, and programs that send commands.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use crate::Failure;
use crate::dice::Dice;

/// The longest time that a reply may take.
const TIMEOUT: Duration = Duration::from_secs(3);

fn send(address: SocketAddr, method: &str, path: &str, body: &str) -> Result<TcpStream, Failure> {
    let mut line = TcpStream::connect_timeout(&address, TIMEOUT)?;
    line.set_read_timeout(Some(TIMEOUT))?;
    write!(
        line,
        "{method} {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\
         Content-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}",
        body.len()
    )?;
    Ok(line)
}

/// Sends a request, and returns the whole reply.
pub fn request(
    address: SocketAddr,
    method: &str,
    path: &str,
    body: &str,
) -> Result<String, Failure> {
    let mut answer = String::new();
    send(address, method, path, body)?.read_to_string(&mut answer)?;
    Ok(answer)
}

/// A reader that asks for all events and reads no event.
pub fn stalled(address: SocketAddr) -> Result<TcpStream, Failure> {
    send(address, "GET", "/api/v1/events", "")
}

/// A reader that follows the phases of scans; returns the highest scan number so far.
pub fn watch(address: SocketAddr) -> Result<Arc<AtomicU64>, Failure> {
    let line = send(address, "GET", "/api/v1/events?types=phase", "")?;
    line.set_read_timeout(None)?;
    let highest = Arc::<AtomicU64>::default();
    let seen = highest.clone();
    std::thread::spawn(move || {
        for line in BufReader::new(line).lines().map_while(Result::ok) {
            let Some(data) = line.strip_prefix("data:") else { continue };
            let phase: serde_json::Value = serde_json::from_str(data).unwrap_or_default();
            seen.fetch_max(phase["scan"].as_u64().unwrap_or(0), Ordering::Relaxed);
        }
    });
    Ok(highest)
}

/// Sends random commands, one directly after the other, while the stylus goes on.
pub fn order(address: SocketAddr, surfaces: &[&str], dice: &mut Dice) {
    let mut orders = Vec::new();
    for _ in 0..1 + dice.below(6) {
        let enroll =
            format!("{{\"surface\":\"{}\",\"trials\":{}}}", dice.pick(surfaces), 1 + dice.below(2));
        let (path, body) = match dice.below(7) {
            0..=2 => ("enroll", enroll),
            3 => ("enroll/end", String::new()),
            4 => ("reload", String::new()),
            5 => ("start", String::new()),
            _ => ("stop", String::new()),
        };
        orders.push((format!("/api/v1/{path}"), body));
    }
    std::thread::spawn(move || {
        for (path, body) in orders {
            // A failure is ignored: the station may refuse a command, or have ended.
            let _ = request(address, "POST", &path, &body);
        }
    });
}
