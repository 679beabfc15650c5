//! `surfaced outputs`: tries the outputs of a station.

use std::path::PathBuf;

use clap::Subcommand;

use super::{Done, Failure, show};
use crate::outputs::{self, OutputTest};

/// Try the outputs of a station's configuration
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced outputs test --config station.toml\n\n\
                        Time: a second; ten where nobody answers")]
pub(super) struct Args {
    #[command(subcommand)]
    command: OutputsCommand,
}

#[derive(Subcommand)]
enum OutputsCommand {
    /// Send one answer to each output, and say what happened
    ///
    /// The answer has the state `unnamed` and belongs to no scan. By MQTT it goes to the topic
    /// PREFIX/STATION/test, and is not retained. Ends with code 1 if an output refuses it.
    Test {
        /// The station's configuration
        #[arg(long, value_name = "FILE")]
        config: PathBuf,
        /// Print each output's result as one line of JSON
        #[arg(long)]
        json: bool,
    },
}

pub(super) fn run(args: &Args) -> Done {
    let OutputsCommand::Test { config: path, json } = &args.command;
    let tests = outputs::test(&super::config(Some(path))?.outputs)?;
    if tests.is_empty() {
        let problem = "no output is configured; add `http` or `mqtt` to [outputs]";
        return Err(Failure::usage_at(path, problem));
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
