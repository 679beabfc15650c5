//! `surfaced export` and `surfaced import`: recordings as MCAP, and back.

use std::path::PathBuf;

use super::Done;

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
#[cfg(feature = "mcap")]
pub fn export(args: &ExportArgs) -> Done {
    use super::{show, shown};
    use crate::record::mcap;
    super::hold(&args.recording);
    let library = mcap::open(&args.recording, &crate::scene::Scene::lmt108())?;
    let trials = mcap::export(&args.recording, &library, &args.out)?;
    say!("wrote {} to {}", show::counted(trials, "trial"), shown(&args.out));
    let out = show::quoted(&args.out);
    show::next(&format!("open it in Foxglove, or surfaced import {out} FOLDER"));
    Ok(())
}

/// Runs `surfaced import`.
#[cfg(feature = "mcap")]
pub fn import(args: &ImportArgs) -> Done {
    use super::{show, shown};
    let trials = crate::record::mcap::import(&args.mcap, &args.library)?;
    match trials {
        0 => say!("wrote {}", shown(&args.library)),
        trials => say!("wrote {} to {}", show::counted(trials, "trial"), shown(&args.library)),
    }
    show::next(&format!("surfaced eval {}", show::quoted(&args.library)));
    Ok(())
}

/// Refuses `surfaced export`: this build has no MCAP.
#[cfg(not(feature = "mcap"))]
pub fn export(_: &ExportArgs) -> Done {
    Err(left_out())
}

/// Refuses `surfaced import`: this build has no MCAP.
#[cfg(not(feature = "mcap"))]
pub fn import(_: &ImportArgs) -> Done {
    Err(left_out())
}

#[cfg(not(feature = "mcap"))]
fn left_out() -> super::Failure {
    super::Failure::Usage(
        "this build cannot read or write MCAP; install surfaced from a release, or build it with \
         `cargo install --locked --path . --features mcap`"
            .into(),
    )
}
