//! `surfaced fleet`: one page and one HTTP API for the stations of a broker.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;

use super::keys::watch_service;
use super::serve::ServeArgs;
use super::{Done, Failure};
use crate::fleet::{self, Pages};
use crate::serve::Settings;
use crate::station::config::{MqttAddress, STRAY_PASSWORD_FILE, TlsFiles};

/// The default port. A station on the same machine may already use port 8080.
const PORT: u16 = 8081;

/// Show the stations of a broker on one page, until Ctrl-C
///
/// Each station whose configuration has `[outputs] mqtt` appears: its state, last answers and
/// throughput, unknown scans, missing devices, scans that wait for review, and a link to its own
/// page. /api/v1/scans.jsonl and .csv hold the answers of all stations.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced fleet mqtt://127.0.0.1\n  \
                        surfaced fleet mqtts://broker.example --ca ca.pem --serve 127.0.0.1:9000\n\n\
                        Time: until you quit")]
pub(super) struct Args {
    /// The broker, and the prefix of the stations' topics: mqtt://HOST, mqtts://USER@HOST/PREFIX
    ///
    /// Other users of this machine see the command line. A user's password is therefore read from
    /// --password-file, or else from the environment variable SURFACED_MQTT_PASSWORD;
    /// USER:PASSWORD@HOST works, too. A character of theirs with another meaning is written %XX.
    broker: String,
    /// A file that holds the password of the broker's user
    #[arg(long, value_name = "FILE")]
    password_file: Option<PathBuf>,
    /// The certificate authority of the broker, if the system does not know it
    #[arg(long, value_name = "FILE")]
    ca: Option<PathBuf>,
    /// The client certificate, if the broker requires one
    #[arg(long, value_name = "FILE", requires = "key")]
    certificate: Option<PathBuf>,
    /// The key of the client certificate
    #[arg(long, value_name = "FILE", requires = "certificate")]
    key: Option<PathBuf>,
    /// The folder that caches the answers; it may be removed at any time [default:
    /// ~/.cache/surfaced/fleet]
    #[arg(long, value_name = "FOLDER")]
    cache: Option<PathBuf>,
    /// Size of the cache, in millions of bytes; the oldest answers are dropped first
    #[arg(long, default_value_t = 256, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    keep_mb: u32,
    /// Hosts whose pages may be asked for answers that the broker did not deliver; repeat the option
    ///
    /// A name or address (`press-3.hall`, 10.0.3.7), all names below one (`*.hall`), or a network of
    /// addresses (10.0.3.0/24). Without it no page is asked, since a station names its own.
    #[arg(long = "pages", value_name = "HOST")]
    pages: Vec<Pages>,
    #[command(flatten)]
    serve: ServeArgs,
}

pub(super) fn run(args: &Args) -> Done {
    // clap would repeat a wrong address in its message, with the password.
    let broker = args.broker.parse().map_err(|why| Failure::Usage(format!("BROKER: {why}")));
    let mut broker: MqttAddress = broker?;
    if let Some(path) = &args.password_file
        && !broker.set_password_file(path.clone())
    {
        return Err(Failure::usage(STRAY_PASSWORD_FILE));
    }
    let client = args.certificate.clone().zip(args.key.clone());
    match &mut broker.tls {
        Some(tls) => *tls = TlsFiles { ca: args.ca.clone(), client },
        None if args.ca.is_some() || client.is_some() => {
            let problem = "certificates are for a broker with TLS; begin its address with mqtts://";
            return Err(Failure::usage(problem));
        }
        None => {}
    }
    let cache = args.cache.clone().map_or_else(default_cache, Ok)?;
    let address = SocketAddr::new(Ipv4Addr::LOCALHOST.into(), PORT);
    let serve = args.serve.settings(Settings { address, ..Settings::default() })?;
    let most_bytes = u64::from(args.keep_mb) * 1_000_000;
    let pages = args.pages.clone();
    let server =
        fleet::start(broker, (&cache, most_bytes), pages, &serve).map_err(super::serve::failure)?;
    let signals = watch_service(crossbeam_channel::unbounded().0)?;
    say!("http://{}", server.address());
    let _ = signals.recv();
    drop(server);
    Ok(())
}

fn default_cache() -> Done<PathBuf> {
    let given = std::env::var_os("XDG_CACHE_HOME").filter(|folder| !folder.is_empty());
    let cache = given.map(PathBuf::from).or_else(|| Some(std::env::home_dir()?.join(".cache")));
    let found = cache.map(|cache| cache.join("surfaced/fleet"));
    found.ok_or_else(|| Failure::usage("there is no home folder; give --cache FOLDER"))
}
