//! `surfaced history`: past scans and their corrections.

use std::path::PathBuf;

use serde_json::Value;

use super::{Done, Failure, show};
use crate::history::{CsvWriter, FOLDER, History, Precision};
use crate::printable::table;

/// Show past scans: answers, their states and reasons, and corrections
///
/// `surfaced run` keeps them in LIBRARY/.history, the newest as far as `[history] keep_mb` goes.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced history my-library\n  \
                        surfaced history my-library --csv > scans.csv\n  \
                        surfaced history my-library --precision\n\nTime: a second for ten \
                        thousand scans")]
pub struct Args {
    /// The library that named them
    library: PathBuf,
    /// Show only the newest scans, at most this many
    #[arg(long, value_name = "N")]
    last: Option<usize>,
    /// Show the share of right answers, surface by surface, among corrected scans
    #[arg(long)]
    precision: bool,
    /// Print CSV
    #[arg(long, conflicts_with_all = ["json", "precision"])]
    csv: bool,
    /// Print one line of JSON a scan
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Done {
    let folder = args.library.join(FOLDER);
    if !folder.is_dir() {
        return Err(Failure::Failed(format!(
            "{}: no scans are kept here; `surfaced run --library {}` keeps those that it names",
            folder.display(),
            args.library.display()
        )));
    }
    let history = History::read(&folder)?;
    if args.precision {
        return precision(&history.precision(), args.json);
    }
    let mut csv = if args.csv { Some(CsvWriter::new(std::io::stdout())?) } else { None };
    let mut passed = history.extent().scans.saturating_sub(args.last.unwrap_or(usize::MAX));
    let mut rows = Vec::new();
    history.each(|scan| {
        if passed > 0 {
            passed -= 1;
            return Ok(());
        }
        match &mut csv {
            Some(csv) => csv.scan(&scan)?,
            None if args.json => show::json(&scan),
            None => rows.push(cells(&scan)),
        }
        Ok::<(), Failure>(())
    })?;
    if let Some(csv) = csv {
        csv.finish()?;
    } else if !args.json {
        let head = ["scan", "state", "surface", ">drag", "it was", "reasons"];
        result!("{}", table(&head, &rows).trim_end());
    }
    Ok(())
}

fn cells(scan: &Value) -> Vec<String> {
    let text = |key: &str| scan[key].as_str().unwrap_or_default();
    let list = |key: &str| {
        let all = scan[key].as_array().into_iter().flatten().filter_map(Value::as_str);
        all.collect::<Vec<_>>().join("; ")
    };
    let was = match text_of(&scan["correction"]["was"]) {
        "" => String::new(),
        "surface" => text_of(&scan["correction"]["surface"]).into(),
        other => other.into(),
    };
    let surface = scan["surface"].as_str().unwrap_or("-");
    let drag = format!("{:.1} s", scan["scan_s"].as_f64().unwrap_or(0.0));
    vec![text("id").into(), text("state").into(), surface.into(), drag, was, list("reasons")]
}

fn text_of(value: &Value) -> &str {
    value.as_str().unwrap_or_default()
}

fn precision(all: &[Precision], json: bool) -> Done {
    if json {
        show::json(&all);
        return Ok(());
    }
    let row = |one: &Precision| {
        let [share, low, high] =
            [one.precision, one.precision_low, one.precision_high].map(show::percent);
        let name = one.surface.clone().unwrap_or_else(|| "(unknown)".into());
        let right = format!("{}/{}", one.right, one.corrected);
        vec![name, right, share, format!("{low} to {high}")]
    };
    let rows: Vec<Vec<String>> = all.iter().map(row).collect();
    result!("{}", table(&["surface", ">right", ">share", "95 %"], &rows).trim_end());
    Ok(())
}
