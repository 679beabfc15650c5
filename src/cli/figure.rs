//! Pictures with their numbers beside them as JSON, from which they can be drawn again.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::{Done, Failure, SourceArgs, shown};
use crate::evaluate::Protocol;

/// The data of a figure, and the file to write.
#[derive(clap::Args)]
pub struct FigureArgs {
    /// Picture to write, an SVG; the JSON, and other pictures if there are any, go beside it
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// How queries and library are split (default: the first of these that fits)
    #[arg(long, value_enum)]
    pub protocol: Option<Protocol>,
    #[command(flatten)]
    pub sources: SourceArgs,
    /// Print the JSON on stdout, too
    #[arg(long)]
    pub json: bool,
}

impl FigureArgs {
    /// Refuses a picture named `.json`, which is the name of the file of its numbers.
    pub fn check(&self) -> Done {
        if self.out.extension().is_some_and(|e| e == "json") {
            return Err(Failure::Usage(format!(
                "{}: name the picture, such as chart.svg; the JSON is written beside it",
                shown(&self.out)
            )));
        }
        Ok(())
    }

    /// The path of the JSON.
    pub fn beside(&self) -> PathBuf {
        self.out.with_extension("json")
    }
}

/// Whether a path is an earlier run's JSON, not recordings.
pub fn is_earlier(path: &Path) -> bool {
    path.extension().is_some_and(|e| e == "json") && path.is_file()
}

/// Reads the JSON that the command named `command` wrote beside its picture.
pub fn earlier<T: DeserializeOwned>(path: &Path, command: &str) -> Result<T, Failure> {
    let failed = |error: &dyn Display| {
        Failure::Failed(format!(
            "{}: {error}; expected what `surfaced {command}` writes beside its picture",
            shown(path)
        ))
    };
    let text = std::fs::read_to_string(path).map_err(|error| failed(&error))?;
    serde_json::from_str(&text).map_err(|error| failed(&error))
}

/// Writes a file that a person named.
pub fn write(path: &Path, text: &str) -> Done {
    std::fs::write(path, text).map_err(|error| Failure::Failed(format!("{}: {error}", shown(path))))
}

/// The numbers of a picture, as the text of a JSON file.
pub fn json(numbers: &impl Serialize) -> Result<String, Failure> {
    Ok(serde_json::to_string_pretty(numbers)? + "\n")
}
