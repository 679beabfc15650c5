//! `surfaced enroll` and `surfaced record`: add live scans to a library as trials.

use super::live::{Kept, StationArgs, Work, library_of, make_library, verdict, work};
use super::method::at_least_one;
use super::show::quoted;
use super::{Done, Failure, show};
use crate::record::check_writable;
use crate::station::config::StationConfig;
use crate::station::{Keep, assemble};
use crate::trial::{EXPERT, UNLABELLED, checked_label};

/// Add trials of a surface to a library, scan by scan
///
/// Each trial is a tap, then a drag. A trial that is shorter than the scan time, clipped or incomplete
/// is refused, with the reason; every other trial is written at once.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced enroll steel --library my-library\n  \
                        surfaced enroll felt --library my-library --trials 5 --user anna\n\nTime: about 6 s a trial")]
pub(super) struct EnrollArgs {
    /// The surface
    #[arg(value_name = "LABEL", value_parser = name)]
    label: String,
    /// How many trials (default: those of the configuration)
    #[arg(long, value_name = "N", value_parser = at_least_one)]
    trials: Option<usize>,
    /// The person who drags
    #[arg(long, default_value = EXPERT, value_parser = name)]
    user: String,
    #[command(flatten)]
    station: StationArgs,
}

/// Keep every live scan as a trial of a library, until `q` or Ctrl-C
///
/// No scan is refused; a scan with gaps is marked as incomplete.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced record --library new-scans\n  \
                        surfaced record --label felt --library my-library\n\nTime: until you quit")]
pub(super) struct RecordArgs {
    /// The surface
    #[arg(long, value_name = "LABEL", default_value = UNLABELLED, value_parser = name)]
    label: String,
    /// The person who drags
    #[arg(long, default_value = EXPERT, value_parser = name)]
    user: String,
    #[command(flatten)]
    station: StationArgs,
}

fn name(text: &str) -> Result<String, String> {
    checked_label(text).map_err(|problem| format!("the name {problem}"))
}

pub(super) fn enroll(args: &EnrollArgs) -> Done {
    let config = args.station.config()?;
    let wanted = args.trials.map_or(config.trials, |trials| trials.try_into().unwrap_or(u32::MAX));
    let (surface, user) = (args.label.clone(), args.user.clone());
    let keep = Keep { surface, user, trials: Some(wanted), good_only: true, ordered_by: None };
    let trials = show::counted(wanted as usize, "trial");
    let hint = format!("{}: {trials} to go; tap the surface, then drag over it", args.label);
    let Kept { kept, lost } = store(&config, &args.station, keep, hint)?;
    if kept < wanted {
        let lost = if lost > 0 { format!("; {lost} could not be written") } else { String::new() };
        return Err(Failure::Failed(format!("{kept} of {wanted} trials were recorded{lost}")));
    }
    Ok(())
}

pub(super) fn record(args: &RecordArgs) -> Done {
    let config = args.station.config()?;
    let (surface, user) = (args.label.clone(), args.user.clone());
    let keep = Keep { surface, user, trials: None, good_only: false, ordered_by: None };
    let hint = format!("keeping every scan as {}; q quits", args.label);
    let Kept { kept, lost } = store(&config, &args.station, keep, hint)?;
    let text = || format!("{} could not be written", show::counted(lost as usize, "scan"));
    match (kept, lost) {
        (_, 0) => Ok(()),
        (0, _) => Err(Failure::Failed(text())),
        (_, _) => Err(Failure::Damaged(text())),
    }
}

/// Runs a station that keeps scans until its order is complete. The operator sees `hint`.
fn store(config: &StationConfig, args: &StationArgs, order: Keep, hint: String) -> Done<Kept> {
    let library = library_of(config)?;
    if !library.exists() {
        make_library(&library, &config.scene)?;
    }
    check_writable(&library)?;
    let mut kept = Kept::default();
    let of = (Work::Keep(order, &mut kept), library.clone(), hint);
    let totals = work(config, args, assemble(config), of)?;
    let trials = show::counted(kept.kept as usize, "trial");
    say!("{trials} recorded in {}", library.display());
    let folder = quoted(&library);
    let station = args.typed();
    show::next(&match kept.kept {
        0 => "surfaced devices lists what is plugged in, and the problems of each".into(),
        _ => format!(
            "enroll another surface with surfaced enroll LABEL{station} --library {folder}; with two \
             or more, surfaced eval {folder}, then surfaced run{station} --library {folder}"
        ),
    });
    // Samples lost between scans belong to no trial; losses within scans were already reported.
    if !totals.failed.is_empty() {
        verdict(&totals)?;
    }
    Ok(kept)
}
