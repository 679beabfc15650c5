//! Serves the page while a station runs, by `--serve` and its token.

use std::ffi::OsString;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::{Arc, OnceLock};

use super::{Done, Failure};
use crate::scan::Options;
use crate::serve::{Reporter, ServeError, Server, Settings, Token};
use crate::station::Station;
use crate::station::config::machine_name;

/// The environment variables that hold the tokens of administrators and of operators.
const TOKEN: &str = "SURFACED_TOKEN";
const OPERATOR_TOKEN: &str = "SURFACED_OPERATOR_TOKEN";
/// Interval at which new samples are sent to the page, in seconds. At 25 times a second, the
/// page can draw 20 times a second even if some samples come late.
const TRACE_EVERY_S: f64 = 0.04;
/// Interval at which the progress of a scan is sent to the page, in seconds of drag.
const PROGRESS_EVERY_S: f64 = 0.1;

/// The address of a station's page; empty until the server has started.
pub(super) type Page = Arc<OnceLock<String>>;

#[derive(Clone, Debug, clap::Args)]
pub(super) struct ServeArgs {
    /// Serve the page and the HTTP API, until SIGTERM
    ///
    /// ADDR is an address with its port, or either alone; port 0 picks a free one. To serve other
    /// machines, give an address such as 0.0.0.0, and a token of at least 16 characters in the
    /// environment variable SURFACED_TOKEN. Who has only the token in SURFACED_OPERATOR_TOKEN sees
    /// everything, begins and ends scans, and corrects them. [default: 127.0.0.1:8080; of a fleet 127.0.0.1:8081]
    #[arg(long, value_name = "ADDR", value_parser = address)]
    serve: Option<Option<Address>>,
    /// A trusted proxy in front of the server
    ///
    /// `X-Forwarded-For` and `X-Forwarded-Proto` are believed only from these addresses. Repeat the
    /// option for each proxy.
    #[arg(long = "serve-proxy", value_name = "ADDR", requires = "serve")]
    proxies: Vec<IpAddr>,
}

/// An address; without a port, the command's own is meant.
type Address = (IpAddr, Option<u16>);

/// Parses an address with a port, an address alone, or a port alone.
fn address(text: &str) -> Result<Address, String> {
    let local = Ipv4Addr::LOCALHOST.to_string();
    let text = text.strip_prefix("localhost").map_or(text.to_string(), |port| local + port);
    let full = text.parse().ok().map(|full: SocketAddr| (full.ip(), Some(full.port())));
    let port = || text.parse().ok().map(|port| (Ipv4Addr::LOCALHOST.into(), Some(port)));
    let ip = || text.parse().ok().map(|ip| (ip, None));
    full.or_else(ip).or_else(port).ok_or_else(|| {
        "expected an address such as 127.0.0.1:8080, or a port; where --serve stands before DATA, \
         write --serve=ADDR, or put it last"
            .into()
    })
}

impl ServeArgs {
    pub(super) fn is_wanted(&self) -> bool {
        self.serve.is_some()
    }

    /// The options of a session. If the page is served, they include updates for the page.
    pub(super) fn options(&self, options: Options) -> Options {
        if !self.is_wanted() {
            return options;
        }
        Options {
            trace_every_s: Some(TRACE_EVERY_S),
            progress_every_s: options.progress_every_s.or(Some(PROGRESS_EVERY_S)),
            ..options
        }
    }

    /// Serves `station` if `--serve` is given, and prints the address on stderr. The default
    /// address is in `settings`. Sets `page` to the address at which other machines find the page.
    pub(super) fn start<'a>(
        &self,
        station: Station<'a>,
        settings: Settings,
        page: &Page,
    ) -> Done<(Station<'a>, Option<Server>)> {
        if !self.is_wanted() {
            return Ok((station, None));
        }
        let settings = self.settings(settings)?;
        let started = Server::start(&settings, station.commands());
        let (server, reporter): (Server, Reporter) = started.map_err(failure)?;
        let address = server.address();
        say!("http://{address}");
        let host = match address.ip().is_unspecified() {
            true => format!("{}:{}", machine_name(), address.port()),
            false => address.to_string(),
        };
        let public = settings.public_address.map(|address| address.to_string());
        let shown = public.unwrap_or_else(|| format!("http://{host}"));
        let _ = page.set(shown.trim_end_matches('/').into());
        Ok((station.listener(reporter), Some(server)))
    }

    /// Adds the token and the command line's options to the settings.
    pub(super) fn settings(&self, settings: Settings) -> Done<Settings> {
        let [token, operator_token] =
            [TOKEN, OPERATOR_TOKEN].map(|name| token(name, std::env::var_os(name)));
        let (token, operator_token) = (token?, operator_token?);
        let usual = settings.address;
        let given = |(ip, port): Address| SocketAddr::new(ip, port.unwrap_or(usual.port()));
        let address = self.serve.flatten().map_or(usual, given);
        let proxies = self.proxies.iter().map(|proxy| proxy.to_canonical()).collect();
        Ok(Settings { address, token, operator_token, proxies, ..settings })
    }
}

fn token(variable: &str, text: Option<OsString>) -> Done<Option<Token>> {
    // Bytes that are not UTF-8 become characters that no token has, so they are refused.
    let token = text.map(|text| Token::new(&text.to_string_lossy())).transpose();
    token.map_err(|error| Failure::Usage(format!("{variable}: {error}")))
}

pub(super) fn failure(error: ServeError) -> Failure {
    match error {
        ServeError::Bind { .. } | ServeError::System(_) => error.into(),
        _ => Failure::usage(error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_may_be_short() {
        for (text, ip, port) in [
            ("0", "127.0.0.1", Some(0)),
            ("9000", "127.0.0.1", Some(9000)),
            ("127.0.0.1", "127.0.0.1", None),
            ("localhost", "127.0.0.1", None),
            ("localhost:1", "127.0.0.1", Some(1)),
            ("0.0.0.0:80", "0.0.0.0", Some(80)),
            ("[::1]:80", "::1", Some(80)),
            ("::1", "::1", None),
        ] {
            assert_eq!(address(text), Ok((ip.parse().unwrap(), port)), "{text}");
        }
        for text in ["", "recordings", "localhosts", "1.2.3", "127.0.0.1:99999"] {
            assert!(address(text).unwrap_err().contains("--serve=ADDR"), "{text}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn a_token_that_is_not_utf8_is_refused_and_not_taken_for_none() {
        use std::os::unix::ffi::OsStringExt;
        let given = |end: u8| Some(OsString::from_vec([b"0123456789abcde", &[end][..]].concat()));
        assert!(token(TOKEN, given(b'f')).is_ok_and(|token| token.is_some()));
        assert!(token(TOKEN, given(0xff)).is_err());
        assert!(token(TOKEN, None).is_ok_and(|token| token.is_none()));
    }
}
