//! `surfaced train`: writes a model file of a library.

use std::path::PathBuf;

use super::condition::WhereArgs;
use super::figure::can_write;
use super::method::{AccuracyArgs, ComparingArgs};
use super::naming::{Trained, trained};
use super::show::quoted;
use super::{Done, Failure, bad_files, say, show};
use crate::recognise::{MethodName, ModelFile, ModelFileError};

/// Write the model of a library as one file, which names scans without the library
///
/// The file holds the trained model, but no samples. `replay --model` and `run --model` give the same
/// answers by it as by the library.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced train my-library --out model.surfaced\n  \
                  surfaced train my-library --plan plan.toml --out model.surfaced\n  \
                  surfaced train my-library --sources mi2 --out sound.surfaced\n\nTime: about 6 s for LMT108's 200 dragging sounds, on two cores; less where the library's caches are up to date")]
pub(super) struct Args {
    /// Recordings: a library, or the LMT108 database
    lib: PathBuf,
    /// File to write
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    #[command(flatten)]
    comparing: ComparingArgs,
    #[command(flatten)]
    accuracy: AccuracyArgs,
    #[command(flatten)]
    only: WhereArgs,
}

pub(super) fn run(args: &Args) -> Done {
    let how = args.comparing.resolve(None)?;
    if how.method.name() != MethodName::Embedding {
        return Err(Failure::usage(ModelFileError::Method(how.method.name().as_str())));
    }
    can_write(&args.out, &["surfaced"])?;
    let library = args.only.open(&args.lib)?;
    let file = bad_files::work(&args.lib, library, |library| {
        let step = |done, of| say::progress("preparing the library", done, of);
        let Trained { scene, state, model, .. } = trained(&args.lib, library, &how, None, &step)?;
        let (scan_s, scan_s_why) = how.lasting(&args.accuracy, &model)?;
        Ok(ModelFile {
            program: env!("CARGO_PKG_VERSION").into(),
            library: state.name,
            digest: library.digest(),
            is_synthetic: state.synthetic,
            scene,
            method: how.method.clone(),
            surfaces: state.surfaces,
            sources: state.sources,
            scan_s,
            scan_s_why,
            query_s: how.query_seconds,
            model,
        })
    })?;
    let bytes = file.write(&args.out).map_err(|error| Failure::at(&args.out, error))?;
    say!("wrote {}, {:.1} MB", args.out.display(), bytes as f64 / 1e6);
    file.scan_s_why.iter().for_each(|line| say!("{line}"));
    show::next(&format!("surfaced run --model {}", quoted(&args.out)));
    Ok(())
}
