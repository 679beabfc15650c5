//! `surfaced run`: the station at work, with whatever devices are there.

use super::live::{CompareArgs, StationArgs, Work, library_of, verdict, work};
use super::serve::ServeArgs;
use super::{Done, Failure, shown};

/// Name surfaces as they are dragged over: live devices, until `q` or Ctrl-C
///
/// Starts with whatever devices are there, and says what it lacks. On a terminal, the space bar
/// begins and ends a scan by hand; without it, scans are found by their tap and drag.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced run --library my-library\n  \
                        surfaced run --config station.toml --json\n  \
                        surfaced run --library my-library --plan plan.toml --serve")]
pub struct Args {
    #[command(flatten)]
    station: StationArgs,
    #[command(flatten)]
    compare: CompareArgs,
    #[command(flatten)]
    serve: ServeArgs,
}

/// Runs the command.
pub fn run(args: &Args) -> Done {
    let config = args.station.config()?;
    let library = library_of(&config)?;
    if !library.is_dir() {
        return Err(Failure::Failed(format!(
            "{}: no such folder; record a library first, with `surfaced enroll LABEL --library {0}` \
             for each surface, or name another one",
            shown(&library)
        )));
    }
    let load = args.compare.load(&library, &config.scene);
    let totals = work(
        &config,
        Work {
            load: Some(load),
            keep: library,
            orders: Vec::new(),
            listeners: Vec::new(),
            serve: Some(&args.serve),
            hint: "tap a surface, then drag over it; space begins and ends by hand, q ends".into(),
            json: args.station.json,
        },
    )?;
    verdict(&totals)
}
