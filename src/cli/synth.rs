//! `surfaced synth`: writes a synthetic dataset.

use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::method::at_least_one;
use super::{Done, Failure, show};
use crate::dataset::synth::{self, Difficulty, Parameters};
use crate::library::About;
use crate::record::{self, TrialOptions};

/// Write a synthetic dataset, marked as such
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  surfaced synth scene --surfaces 20 --trials 5 --users 3\n\nTime: 5 s for the default size, on two cores"
)]
pub struct Args {
    /// Folder to write; must not exist, or be empty
    out: PathBuf,
    /// Number of surfaces
    #[arg(long, default_value_t = 12, value_name = "COUNT", value_parser = at_least_one)]
    surfaces: usize,
    /// Trials of each surface by the expert
    #[arg(long, default_value_t = 4, value_name = "COUNT")]
    trials: u32,
    /// Users, with one trial of each surface
    #[arg(long, default_value_t = 3, value_name = "COUNT")]
    users: u32,
    /// The same seed gives the same dataset
    #[arg(long, default_value_t = 1, value_name = "SEED")]
    seed: u64,
    /// Length of a drag
    #[arg(long, default_value_t = 4.8, value_name = "X", value_parser = super::common::seconds)]
    seconds: f64,
    /// Make each source about as hard as in LMT108, instead of easier
    #[arg(long)]
    hard: bool,
    /// Print one JSON document on stdout
    #[arg(long)]
    json: bool,
}

#[derive(serde::Serialize)]
struct SynthReport {
    out: String,
    synthetic: bool,
    surfaces: usize,
    trials: usize,
    seed: u64,
}

pub fn run(args: &Args) -> Done {
    if args.trials + args.users == 0 {
        return Err(Failure::Usage("--trials 0 --users 0 leaves nothing to write".into()));
    }
    if args.out.read_dir().is_ok_and(|mut inside| inside.next().is_some()) {
        return Err(Failure::Failed(format!(
            "{}: the folder is not empty; name a new one",
            args.out.display()
        )));
    }
    let library = synth::library(&Parameters {
        surfaces: args.surfaces,
        trials: args.trials,
        users: args.users,
        seed: args.seed,
        drag_seconds: args.seconds,
        twins: None,
        difficulty: if args.hard { Difficulty::lmt108() } else { Difficulty::default() },
    });
    record::write_library_toml(&args.out, &library.scene, &library.name, true)?;
    let steps = show::Steps::new();
    let done = AtomicUsize::new(0);
    let of = library.entries.len();
    let options = TrialOptions { about: About::default(), durable: false };
    library.entries.par_iter().try_for_each(|entry| {
        record::write_trial(&args.out, &entry.load()?, &library.scene, &options)?;
        steps.show("writing trials", done.fetch_add(1, Ordering::Relaxed) + 1, of);
        Ok::<_, crate::library::LibraryError>(())
    })?;
    drop(steps);
    let report = SynthReport {
        out: super::shown(&args.out),
        synthetic: true,
        surfaces: args.surfaces,
        trials: of,
        seed: args.seed,
    };
    if args.json {
        show::json(&report);
    } else {
        say!("wrote {of} synthetic trials of {} surfaces to {}", args.surfaces, report.out);
        show::next(&format!("surfaced eval {}", show::quoted(&args.out)));
    }
    Ok(())
}
