//! Writes figures, and their numbers as JSON beside them, so that figures can be drawn again.

use std::path::{Path, PathBuf};

use serde::Serialize;

use super::choose::SplitArgs;
use super::{Done, Failure, SourceArgs};
use crate::draw::Look;

/// The data of a figure, and the file to write.
#[derive(clap::Args)]
pub(super) struct FigureArgs {
    /// SVG file to write; the JSON and any other pictures are written beside it
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    #[command(flatten)]
    pub look: Look,
    #[command(flatten)]
    pub split: SplitArgs,
    #[command(flatten)]
    pub sources: SourceArgs,
    /// Print the JSON on stdout, too
    #[arg(long)]
    pub json: bool,
}

impl FigureArgs {
    /// Refuses a picture named `.json`, since the file of its numbers has that name.
    pub(super) fn check(&self) -> Done {
        if self.out.extension().is_some_and(|e| e == "json") {
            let problem = "name the picture, such as chart.svg; the JSON is written beside it";
            return Err(Failure::usage_at(&self.out, problem));
        }
        Ok(())
    }

    /// Writes the picture and, beside it, its numbers as JSON. Returns the paths of both.
    pub(super) fn keep(
        &self,
        svg: &str,
        numbers: &impl Serialize,
    ) -> Result<Vec<PathBuf>, Failure> {
        let beside = self.out.with_extension("json");
        write(&self.out, svg)?;
        write(&beside, &(serde_json::to_string_pretty(numbers)? + "\n"))?;
        Ok(vec![self.out.clone(), beside])
    }
}

/// Whether a path is the JSON file of an earlier run, not a recording.
pub(super) fn is_earlier(path: &Path) -> bool {
    path.extension().is_some_and(|e| e == "json") && path.is_file()
}

pub(super) fn write(path: &Path, text: &str) -> Done {
    std::fs::write(path, text).map_err(|error| Failure::at(path, error))
}
