//! `surfaced export` and `surfaced import`: recordings as MCAP, and back.

use std::path::PathBuf;

use super::show::quoted;
use super::{Done, show, shown};
use crate::record::mcap;
use crate::scene::Scene;

/// Write a recording as MCAP, which Foxglove and other tools open
///
/// The file holds samples and pictures as messages to look at, and the recording's own files, so
/// that `surfaced import` gives them back byte for byte.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced export my-library my-library.mcap\n  \
                        surfaced export my-library/oak/expert-01 oak.mcap\n\nTime: as long as copying the files takes")]
pub struct ExportArgs {
    /// A library, one trial of it, or the LMT108 database
    recording: PathBuf,
    /// The file to write; it must not be there yet
    out: PathBuf,
}

/// Write back a recording that was exported as MCAP
#[derive(clap::Args)]
#[command(
    after_help = "Examples:\n  surfaced import my-library.mcap my-library\n\nTime: as long as copying the files takes"
)]
pub struct ImportArgs {
    /// The file
    mcap: PathBuf,
    /// The library to make; it must not be there yet
    library: PathBuf,
}

/// Runs `surfaced export`.
pub fn export(args: &ExportArgs) -> Done {
    super::hold(&args.recording);
    let library = mcap::open(&args.recording, &Scene::lmt108())?;
    let trials = mcap::export(&args.recording, &library, &args.out)?;
    say!("wrote {} to {}", show::counted(trials, "trial"), shown(&args.out));
    let out = quoted(&args.out);
    show::next(&format!("open it in Foxglove, or surfaced import {out} FOLDER"));
    Ok(())
}

/// Runs `surfaced import`.
pub fn import(args: &ImportArgs) -> Done {
    let trials = mcap::import(&args.mcap, &args.library)?;
    match trials {
        0 => say!("wrote {}", shown(&args.library)),
        trials => say!("wrote {} to {}", show::counted(trials, "trial"), shown(&args.library)),
    }
    show::next(&format!("surfaced eval {}", quoted(&args.library)));
    Ok(())
}
