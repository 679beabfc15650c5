//! `surfaced export` and `surfaced import`: write recordings as MCAP, and read them back.

use std::path::{Path, PathBuf};

use super::{Done, import_csv};

/// Write a recording as MCAP, which Foxglove and other tools open
///
/// The file holds samples and pictures as messages, and also the recording's own files:
/// `surfaced import` restores these byte for byte.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced export my-library my-library.mcap\n  \
                        surfaced export my-library/oak/expert-01 oak.mcap\n\nTime: as long as copying the files takes")]
pub(super) struct ExportArgs {
    /// A library, one trial of it, or the LMT108 database
    recording: PathBuf,
    /// The file to write; it must not exist yet
    out: PathBuf,
}

/// Make a library from CSV tables, or restore a recording that was exported as MCAP
#[derive(clap::Args)]
#[command(
    args_conflicts_with_subcommands = true,
    subcommand_negates_reqs = true,
    after_help = "Examples:\n  surfaced import my-library.mcap my-library\n  surfaced import csv recordings --out my-library --rate 1000 --dry-run\n\nTime: as long as copying the files takes"
)]
pub(super) struct ImportArgs {
    #[command(subcommand)]
    then: Option<Then>,
    /// The MCAP file
    #[arg(required = true)]
    mcap: Option<PathBuf>,
    /// Folder of the library to make; it must not exist yet
    #[arg(required = true)]
    library: Option<PathBuf>,
}

#[derive(clap::Subcommand)]
enum Then {
    Csv(import_csv::CsvArgs),
}

pub(super) fn import(args: &ImportArgs) -> Done {
    match (&args.then, &args.mcap, &args.library) {
        (Some(Then::Csv(args)), ..) => import_csv::run(args),
        (None, Some(mcap), Some(library)) => import_mcap(mcap, library),
        _ => Err(super::Failure::usage("name the file and the library to make")),
    }
}

#[cfg(feature = "mcap")]
pub(super) fn export(args: &ExportArgs) -> Done {
    use super::show;
    use crate::record::mcap;
    super::hold(&args.recording);
    let library = mcap::open(&args.recording, &crate::scene::Scene::lmt108())?;
    let trials = mcap::export(&args.recording, &library, &args.out)?;
    say!("wrote {} to {}", show::counted(trials, "trial"), args.out.display());
    let out = show::quoted(&args.out);
    show::next(&format!("open it in Foxglove, or surfaced import {out} FOLDER"));
    Ok(())
}

#[cfg(feature = "mcap")]
fn import_mcap(mcap: &Path, library: &Path) -> Done {
    use super::show;
    let trials = crate::record::mcap::import(mcap, library)?;
    match trials {
        0 => say!("wrote {}", library.display()),
        trials => say!("wrote {} to {}", show::counted(trials, "trial"), library.display()),
    }
    show::next(&format!("surfaced eval {}", show::quoted(library)));
    Ok(())
}

#[cfg(not(feature = "mcap"))]
pub(super) fn export(_: &ExportArgs) -> Done {
    Err(left_out())
}

#[cfg(not(feature = "mcap"))]
fn import_mcap(_: &Path, _: &Path) -> Done {
    Err(left_out())
}

#[cfg(not(feature = "mcap"))]
fn left_out() -> super::Failure {
    super::Failure::usage(
        "this build cannot read or write MCAP; install surfaced from a release, or build it with \
         `cargo install --locked --path . --features mcap`",
    )
}
