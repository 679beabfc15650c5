//! `surfaced enroll` and `surfaced record`: live scans become trials of a library.

use std::cell::Cell;
use std::path::Path;
use std::rc::Rc;

use crossbeam_channel::Sender;

use super::live::{Listen, StationArgs, Work, library_of, verdict, work};
use super::method::at_least_one;
use super::{Done, Failure, shown};
use crate::record::write_library_toml;
use crate::scene::Scene;
use crate::station::config::StationConfig;
use crate::station::{Command, Enrolled, Listener, StationEvent};
use crate::trial::EXPERT;

/// Label of scans that nobody labelled.
const UNLABELLED: &str = "unlabelled";

/// Add trials of a surface to a library, led from scan to scan
///
/// Each trial is a tap, then a drag. One that is too short by its own T*, clipped, or not whole is
/// refused, with the reason; the others are kept at once, so that nothing is lost whatever happens.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced enroll steel --library my-library\n  \
                        surfaced enroll felt --library my-library --trials 5 --user anna")]
pub struct EnrollArgs {
    /// The surface
    #[arg(value_name = "LABEL", value_parser = name)]
    label: String,
    /// How many trials (default: those of the configuration)
    #[arg(long, value_name = "N", value_parser = at_least_one)]
    trials: Option<usize>,
    /// Who drags
    #[arg(long, default_value = EXPERT, value_parser = name)]
    user: String,
    #[command(flatten)]
    station: StationArgs,
}

/// ScanStore every live scan as a trial of a library, until `q` or Ctrl-C
///
/// Nothing is refused; a scan that is not whole is marked as incomplete.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced record --library new-scans\n  \
                        surfaced record --label felt --library my-library")]
pub struct RecordArgs {
    /// The surface
    #[arg(long, value_name = "LABEL", default_value = UNLABELLED, value_parser = name)]
    label: String,
    /// Who drags
    #[arg(long, default_value = EXPERT, value_parser = name)]
    user: String,
    #[command(flatten)]
    station: StationArgs,
}

/// Parses a label or a user's name.
fn name(text: &str) -> Result<String, String> {
    match text.trim() {
        "" => Err("expected a name".into()),
        name => Ok(name.to_string()),
    }
}

/// Runs `surfaced enroll`.
pub fn enroll(args: &EnrollArgs) -> Done {
    let config = args.station.config()?;
    let trials = args.trials.map_or(config.trials, |trials| trials.try_into().unwrap_or(u32::MAX));
    let order = Command::Enroll { surface: args.label.clone(), user: args.user.clone(), trials };
    let hint =
        format!("{}: {trials} trial(s) to go; tap the surface, then drag over it", args.label);
    let kept = keep(&config, &args.station, order, hint)?;
    if kept < trials {
        return Err(Failure::Failed(format!("{kept} of {trials} trials were recorded")));
    }
    Ok(())
}

/// Runs `surfaced record`.
pub fn record(args: &RecordArgs) -> Done {
    let config = args.station.config()?;
    let order = Command::Record { surface: args.label.clone(), user: args.user.clone() };
    let hint = format!("keeping every scan as {}; q ends", args.label);
    keep(&config, &args.station, order, hint).map(drop)
}

/// Keeps scans until `order` is fulfilled, or work ends; tells how many. `hint` is for people.
fn keep(
    config: &StationConfig,
    args: &StationArgs,
    order: Command,
    hint: String,
) -> Result<u32, Failure> {
    let library = library_of(config)?;
    describe(&library, &config.scene)?;
    let kept = Rc::new(Cell::new(0));
    let counted = kept.clone();
    let count: Listen<'_> = Box::new(|orders| Box::new(Count { orders, kept: counted }));
    let totals = work(
        config,
        Work {
            load: None,
            keep: library.clone(),
            orders: vec![order],
            listeners: vec![count],
            hint,
            json: args.json,
            serve: args.serve.clone(),
        },
    )?;
    let kept = kept.get();
    eprintln!("{kept} trial(s) were recorded in {}", shown(&library));
    // What was lost between scans is in no trial, and what was lost within them was told.
    if totals.failed.is_empty() {
        return Ok(kept);
    }
    verdict(&totals).map(|()| kept)
}

/// Makes a library that is not there yet, and says in it what its sources are.
fn describe(library: &Path, scene: &Scene) -> Result<(), Failure> {
    if !library.exists() {
        let name = library.file_name().map(|name| name.to_string_lossy()).unwrap_or_default();
        write_library_toml(library, scene, &name, false)?;
    }
    Ok(())
}

/// Counts trials, and ends the work with the last one.
struct Count {
    orders: Sender<Command>,
    kept: Rc<Cell<u32>>,
}

impl Listener for Count {
    fn on_event(&mut self, event: &StationEvent) {
        let StationEvent::Enrolled(Enrolled { trial, wanted, .. }) = event else { return };
        self.kept.set(self.kept.get() + u32::from(trial.is_some()));
        if *wanted == 0 {
            // Fails only when the station has ended already.
            let _ = self.orders.send(Command::Quit);
        }
    }
}
