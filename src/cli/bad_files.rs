//! Recordings that cannot be read: all named at once, and left out where `--skip-bad` says so.

use std::path::Path;

use super::{Done, Failure, show};
use crate::dataset;
use crate::library::audit::{self, Unreadable};
use crate::library::{Entry, Library, LibraryError, Opened};
use crate::scene::Scene;

/// Treatment of recordings that cannot be read.
#[derive(Debug, clap::Args)]
pub(super) struct BadFileArgs {
    /// Go on without recordings that cannot be read; they are listed, and the exit code is 3
    #[arg(long)]
    skip_bad: bool,
}

/// The recordings that were left out, an error each.
#[derive(Default)]
pub(super) struct Skipped(Vec<LibraryError>);

impl BadFileArgs {
    /// Opens recordings, and says on stderr what was found. `narrow` chooses the sources in use.
    ///
    /// # Errors
    /// If nothing can be used; without `--skip-bad`, if anything cannot be, naming all of it.
    pub fn open(
        &self,
        path: &Path,
        narrow: impl FnOnce(Scene) -> Result<Scene, Failure>,
    ) -> Result<(Library, Skipped), Failure> {
        let Opened { mut library, bad } = dataset::open_usable(path, &Scene::lmt108())?;
        if !self.skip_bad && bad.is_empty() {
            show::library(&library);
            return Ok((library, Skipped::default()));
        }
        let scene = narrow(library.scene.clone())?;
        library.entries = library.entries.into_iter().map(|entry| entry.within(&scene)).collect();
        let unreadable = audit::unreadable(&library.entries);
        library.entries = audit::without(library.entries, &unreadable);
        let bad: Vec<LibraryError> = bad.into_iter().chain(errors(unreadable)).collect();
        if !self.skip_bad {
            return Err(failure(bad));
        }
        show::library(&library);
        let skipped = Skipped(bad);
        skipped.why().for_each(|why| say!("warning: {why}"));
        Ok((library, skipped))
    }
}

impl Skipped {
    /// The reasons, a line each.
    pub fn why(&self) -> impl Iterator<Item = String> {
        self.0.iter().map(|error| format!("not used: {error}"))
    }

    /// The end of the command.
    pub fn verdict(&self) -> Done {
        match self.0.len() {
            0 => Ok(()),
            1 => Err(Failure::Damaged("done; 1 unreadable recording was skipped".into())),
            n => Err(Failure::Damaged(format!("done; {n} unreadable recordings were skipped"))),
        }
    }
}

/// The failure of work with `entries`. It names all unreadable recordings, if they are the reason.
pub(super) fn explain(entries: &[Entry], error: impl Into<Failure>) -> Failure {
    match audit::unreadable(entries) {
        unreadable if unreadable.is_empty() => error.into(),
        unreadable => failure(errors(unreadable).collect()),
    }
}

fn errors(unreadable: Vec<Unreadable>) -> impl Iterator<Item = LibraryError> {
    unreadable.into_iter().map(|unreadable| unreadable.error)
}

fn failure(bad: Vec<LibraryError>) -> Failure {
    let all = LibraryError::of_all(bad).map_or_else(String::new, |error| error.to_string());
    Failure::Failed(format!("{all}\nrepair or remove them, or skip them with --skip-bad"))
}
