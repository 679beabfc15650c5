//! `surfaced outputs`, and the outputs of a station at work.

use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

use clap::Subcommand;

use super::{Done, Failure, live, show};
use crate::history::History;
use crate::outputs::{self, Output, OutputHealth, OutputTest};
use crate::serve::Server;
use crate::station::Station;
use crate::station::config::{OutputsConfig, machine_name};

/// Name of the folder of answers that wait, in that of the library.
const FOLDER: &str = ".outbox";

/// The address of a station's page, once it is known.
pub type Page = Arc<OnceLock<String>>;

/// Sends the answers of a station where its configuration says; those that wait are kept in `folder`.
pub fn send_answers<'a>(
    mut station: Station<'a>,
    config: &OutputsConfig,
    folder: &Path,
    shown: (&Arc<History>, &Page),
) -> Result<(Station<'a>, Vec<OutputHealth>), Failure> {
    let mut healths = Vec::new();
    for output in Output::start(config, &folder.join(FOLDER), shown)? {
        healths.push(output.health());
        station = station.listener(output);
    }
    Ok((station, healths))
}

/// The page of a station is at the address of this server, as other machines reach it.
pub fn is_at(page: &Page, server: Option<&Server>) {
    let Some(address) = server.map(Server::address) else { return };
    let host = match address.ip().is_unspecified() {
        true => format!("{}:{}", machine_name(), address.port()),
        false => address.to_string(),
    };
    let _ = page.set(format!("http://{host}"));
}

/// Try the outputs of a station's configuration
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced outputs test --config station.toml\n\n\
                        Time: a second; ten where nobody answers")]
pub struct Args {
    #[command(subcommand)]
    command: OutputsCommand,
}

#[derive(Subcommand)]
enum OutputsCommand {
    /// Send one answer to each output, and say what happened
    ///
    /// It is an answer of the state `unnamed`, for a scan that never was. By MQTT it goes to the topic
    /// PREFIX/STATION/test, and is not retained. Ends with code 1 where an output did not take it.
    Test(TestArgs),
}

#[derive(clap::Args)]
struct TestArgs {
    /// The station's configuration
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Print one line of JSON an output
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Done {
    let OutputsCommand::Test(TestArgs { config: path, json }) = &args.command;
    let config = live::config(Some(path))?.outputs;
    let tests = outputs::test(&config)?;
    if tests.is_empty() {
        let problem = "no output is configured; add `http` or `mqtt` to [outputs]";
        return Err(Failure::Usage(format!("{}: {problem}", path.display())));
    }
    for test in &tests {
        let OutputTest { output, arrived, said } = test;
        match json {
            true => show::json(test),
            false if *arrived => result!("{output}: {said}"),
            false => result!("{output}: failed: {said}"),
        }
    }
    match tests.iter().filter(|test| !test.arrived).count() {
        0 => Ok(()),
        failed => Err(Failure::Failed(format!("{failed} of {} outputs failed", tests.len()))),
    }
}
