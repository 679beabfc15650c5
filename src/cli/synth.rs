//! `surfaced synth`: writes a synthetic dataset.

use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;
use serde_json::json;

use super::method::at_least_one;
use super::show::counted;
use super::{Done, Failure, say, show};
use crate::dataset::synth::{self, Difficulty, Parameters};
use crate::library::About;
use crate::record::{self, TrialOptions};

/// Write a synthetic dataset, marked as such
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  surfaced synth scene --surfaces 20 --trials 5 --users 3\n\nTime: 5 s for the default size, on two cores"
)]
pub(super) struct Args {
    /// Folder to write; must not exist, or be empty
    out: PathBuf,
    /// Number of surfaces
    #[arg(long, default_value_t = 12, value_name = "COUNT", value_parser = at_least_one)]
    surfaces: usize,
    /// Number of the expert's trials of each surface
    #[arg(long, default_value_t = 4, value_name = "COUNT")]
    trials: u32,
    /// Number of users, each with one trial of each surface
    #[arg(long, default_value_t = 3, value_name = "COUNT")]
    users: u32,
    /// The same seed gives the same dataset
    #[arg(long, default_value_t = 1, value_name = "SEED")]
    seed: u64,
    /// Length of a drag in seconds
    #[arg(long, default_value_t = 4.8, value_name = "X", value_parser = super::seconds)]
    seconds: f64,
    /// Make each source about as hard as in LMT108, instead of easier
    #[arg(long)]
    hard: bool,
    /// Print one JSON document on stdout
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Done {
    if (args.trials, args.users) == (0, 0) {
        return Err(Failure::usage("--trials 0 --users 0 leaves nothing to write"));
    }
    if args.out.read_dir().is_ok_and(|mut inside| inside.next().is_some()) {
        return Err(Failure::at(&args.out, "the folder is not empty; name a new one"));
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
    let done = AtomicUsize::new(0);
    let of = library.entries.len();
    let options = TrialOptions { about: About::default(), durable: false };
    library.entries.par_iter().try_for_each(|entry| {
        record::write_trial(&args.out, &entry.load()?, &library.scene, &options)?;
        say::progress("writing trials", done.fetch_add(1, Ordering::Relaxed) + 1, of);
        Ok::<_, crate::library::LibraryError>(())
    })?;
    let (out, Args { surfaces, seed, .. }) = (args.out.display().to_string(), args);
    let report =
        json!({"out": out, "synthetic": true, "surfaces": surfaces, "trials": of, "seed": seed});
    show::result(args.json, &report, |_| {
        let (trials, count) = (counted(of, "synthetic trial"), counted(*surfaces, "surface"));
        say!("wrote {trials} of {count} to {out}");
        // Naming takes two surfaces, and a second trial of each.
        let command = if *surfaces > 1 && of > *surfaces { "eval" } else { "library list" };
        show::next(&format!("surfaced {command} {}", show::quoted(&args.out)));
    });
    Ok(())
}
