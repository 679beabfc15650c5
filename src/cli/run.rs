//! `surfaced run`: the station at work, with the devices that are there.

use super::answers::AnswerArgs;
use super::live::{StationArgs, StationWork, check, given, library_of, load, verdict, work};
use super::method::ComparingArgs;
use super::{Done, Failure, shown};
use crate::station::assemble;

/// Name surfaces as they are dragged over: live devices, until `q` or Ctrl-C
///
/// Starts with the devices that are there, and names those that are missing. Scans are detected by
/// their tap and drag; on a terminal, the space bar also begins and ends one by hand.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced run --library my-library\n  \
                        surfaced run --config station.toml --json --serve\n  \
                        surfaced run --library my-library --stylus /dev/ttyUSB0\n\nTime: until it is ended; an answer comes some 10 ms after its scan")]
pub struct Args {
    #[command(flatten)]
    station: StationArgs,
    #[command(flatten)]
    comparing: ComparingArgs,
    #[command(flatten)]
    answers: AnswerArgs,
}

/// Runs the command.
pub fn run(args: &Args) -> Done {
    let how = args.comparing.resolve(None)?;
    let mut config = args.station.config()?;
    if let Some(plan) = &how.plan {
        config = config.only(&plan.sources);
    }
    let library = library_of(&config)?;
    if !library.is_dir() {
        return Err(Failure::Failed(format!(
            "{}: no such folder; record a library first, with `surfaced enroll LABEL --library {0}` \
             for each surface, or name another one",
            shown(&library)
        )));
    }
    let check = Some(check(&library, &how));
    let assembled = assemble(&config);
    let given = Some(given(&assembled));
    let load = load(&library, &config.scene, &how, &args.answers, given);
    let long = how.query_seconds.map(|s| format!(" for {s} s or more")).unwrap_or_default();
    let totals = work(
        &config,
        assembled,
        StationWork {
            load: Some(load),
            store: library,
            keep: None,
            listeners: Vec::new(),
            hint: format!(
                "tap a surface, then drag over it{long}; space begins and ends a scan, q quits"
            ),
            check,
            json: args.station.json,
            serve: args.station.serve.clone(),
        },
    )?;
    verdict(&totals)
}
