//! Serving the page while a station works: `--serve`, the token, and the end by a signal.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::mpsc;

use crossbeam_channel::Sender;
use signal_hook::consts::TERM_SIGNALS;
use signal_hook::iterator::{Handle, Signals};

use super::Failure;
use crate::scan::Options;
use crate::serve::{PORT, Reporter, ServeError, Server, Settings, Token};
use crate::station::Order;

/// The environment variable that holds the token.
const TOKEN: &str = "SURFACED_TOKEN";
/// How often the page is told what is new, in seconds: 20 times a second.
const TRACE_EVERY_S: f64 = 0.05;
/// How often it is told how a scan goes on, in seconds of drag.
const PROGRESS_EVERY_S: f64 = 0.1;

/// Whether and where the page is served.
#[derive(clap::Args)]
pub struct ServeArgs {
    /// Serve the page and the interface for programs until SIGTERM: on 127.0.0.1:8108 (or where the
    /// configuration says), or where ADDR says (`9000`, `127.0.0.1:0` for a free port, …)
    ///
    /// An address that other machines reach needs a token, in the environment variable
    /// SURFACED_TOKEN.
    #[arg(
        long,
        value_name = "ADDR",
        num_args = 0..=1,
        value_parser = address
    )]
    serve: Option<Option<SocketAddr>>,
}

/// An address with its port, or one of the two.
fn address(text: &str) -> Result<SocketAddr, String> {
    let port = || text.parse().ok().map(|port| SocketAddr::new(Ipv4Addr::LOCALHOST.into(), port));
    let ip = || text.parse::<IpAddr>().ok().map(|ip| SocketAddr::new(ip, PORT));
    let known = text.strip_prefix("localhost").and_then(|rest| match rest.strip_prefix(':') {
        Some(port) => port.parse().ok(),
        None => rest.is_empty().then_some(PORT),
    });
    let localhost = known.map(|port| SocketAddr::new(Ipv4Addr::LOCALHOST.into(), port));
    text.parse().ok().or_else(ip).or_else(port).or(localhost).ok_or_else(|| {
        "expected an address such as 127.0.0.1:8108, or a port; where --serve stands before DATA, \
         write --serve=ADDR, or put it last"
            .into()
    })
}

/// A server, and what ends it.
pub struct Serving {
    server: Server,
    stopped: mpsc::Receiver<()>,
    signals: Handle,
}

impl ServeArgs {
    /// Options of a session that is shown, if it is.
    pub fn options(&self, options: Options) -> Options {
        if self.serve.is_none() {
            return options;
        }
        Options {
            trace_every_s: Some(TRACE_EVERY_S),
            progress_every_s: options.progress_every_s.or(Some(PROGRESS_EVERY_S)),
            ..options
        }
    }

    /// Serves, if that was asked for, and says where on stderr; SIGTERM and its like end the
    /// station that takes `orders` from now on. `enrolls` tells whether it keeps scans;
    /// `configured` is the address where none was named.
    pub fn start(
        &self,
        orders: Sender<Order>,
        enrolls: bool,
        configured: Option<SocketAddr>,
    ) -> Result<Option<(Serving, Reporter)>, Failure> {
        let Some(named) = self.serve else { return Ok(None) };
        let local = SocketAddr::new(Ipv4Addr::LOCALHOST.into(), PORT);
        let address = named.or(configured).unwrap_or(local);
        let usage = |error: ServeError| Failure::Usage(error.to_string());
        let token = match std::env::var(TOKEN) {
            Ok(text) => Some(Token::new(&text).map_err(usage)?),
            Err(_) => None,
        };
        let settings = Settings { address, token, enrolls, ..Settings::default() };
        let (server, reporter) =
            Server::start(&settings, orders.clone()).map_err(|error| match error {
                ServeError::Open(_) => usage(error),
                _ => error.into(),
            })?;
        let mut signals = Signals::new(TERM_SIGNALS)?;
        let (tell, stopped) = mpsc::channel();
        let handle = signals.handle();
        std::thread::Builder::new().name("signals".into()).spawn(move || {
            for _ in signals.forever() {
                // Whoever has ended already needs no order.
                let _ = orders.send(Order::Quit);
                let _ = tell.send(());
            }
        })?;
        eprintln!("http://{}", server.address());
        Ok(Some((Serving { server, stopped, signals: handle }, reporter)))
    }
}

impl Serving {
    /// Serves on what is known, until a signal says that it is enough.
    pub fn until_stopped(self) {
        let _ = self.stopped.recv();
        self.stop();
    }

    /// Serves no more.
    pub fn stop(self) {
        self.signals.close();
        self.server.stop();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_may_be_short() {
        for (text, full) in [
            ("0", "127.0.0.1:0"),
            ("9000", "127.0.0.1:9000"),
            ("127.0.0.1", "127.0.0.1:8108"),
            ("localhost", "127.0.0.1:8108"),
            ("localhost:1", "127.0.0.1:1"),
            ("0.0.0.0:80", "0.0.0.0:80"),
            ("[::1]:80", "[::1]:80"),
            ("::1", "[::1]:8108"),
        ] {
            assert_eq!(address(text), Ok(full.parse().unwrap()), "{text}");
        }
        for text in ["", "recordings", "localhosts", "1.2.3", "127.0.0.1:99999"] {
            assert!(address(text).unwrap_err().contains("--serve=ADDR"), "{text}");
        }
    }
}
