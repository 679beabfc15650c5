//! `surfaced history`: past scans and their corrections.

use std::path::PathBuf;

use super::{Done, Failure, show};
use crate::history::{COLUMNS, FOLDER, History, HistoryRow, Precision, Truth, Wanted, write_csv};

/// Show past scans: answers, their states and reasons, and corrections
///
/// `surfaced run` keeps the newest scans in LIBRARY/.history, up to the size `[history] keep_mb`.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced history my-library\n  \
                        surfaced history my-library --csv > scans.csv\n  \
                        surfaced history my-library --precision\n\nTime: a second for ten \
                        thousand scans")]
pub(super) struct Args {
    /// The library that named the scans
    library: PathBuf,
    /// Show only the newest scans, at most this many
    #[arg(long, value_name = "N", conflicts_with = "precision")]
    last: Option<usize>,
    /// Show the share of right answers among corrected scans, for each surface
    #[arg(long)]
    precision: bool,
    /// Print CSV
    #[arg(long, conflicts_with_all = ["json", "precision"])]
    csv: bool,
    /// Print one line of JSON for each scan
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Done {
    let folder = args.library.join(FOLDER);
    if !folder.is_dir() {
        let library = args.library.display();
        let run = format!("`surfaced run --library {library}` keeps the scans that it names");
        return Err(Failure::at(&folder, format!("no scans are kept here; {run}")));
    }
    let history = History::read(&folder)?;
    if args.precision {
        return precision(&history.precision(), args.json);
    }
    let passed = history.extent().scans.saturating_sub(args.last.unwrap_or(usize::MAX));
    if args.csv {
        let values = history.values(Wanted::default()).skip(passed);
        return Ok(write_csv(std::io::stdout(), COLUMNS, values)?);
    }
    let mut rows = Vec::new();
    for row in history.rows(Wanted::default()).skip(passed) {
        if args.json { show::json(&row?) } else { rows.push(cells(row?)) }
    }
    if !args.json {
        show::table(&["scan", "state", "surface", ">drag", "it was", "reasons"], rows);
    }
    Ok(())
}

fn cells(row: HistoryRow) -> Vec<String> {
    let HistoryRow { head, scan_s, reasons, correction, .. } = row;
    let surface = head.surface.unwrap_or_else(|| "-".into());
    let was = match correction.map(|correction| correction.truth) {
        None => String::new(),
        Some(Truth::Surface { surface }) => surface,
        Some(Truth::Unknown) => "unknown".into(),
        Some(Truth::Bad) => "bad".into(),
    };
    let (state, drag) = (head.state.to_string(), format!("{scan_s:.1} s"));
    vec![head.id, state, surface, drag, was, reasons.join("; ")]
}

fn precision(all: &[Precision], json: bool) -> Done {
    let row = |one: &Precision| {
        let [share, low, high] =
            [one.precision, one.precision_low, one.precision_high].map(show::percent);
        let name = one.surface.clone().unwrap_or_else(|| "(unknown)".into());
        let right = format!("{}/{}", one.right, one.corrected);
        vec![name, right, share, format!("{low} to {high}")]
    };
    let head = ["surface", ">right", ">share", "95 %"];
    show::result(json, &all, |all| show::table(&head, all.iter().map(row)));
    Ok(())
}
