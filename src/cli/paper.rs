//! `surfaced eval DATA --paper`: the paper's tables beside ours, whole or shard by shard, and
//! `surfaced eval merge`, which joins shards.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::method::MethodArgs;
use super::{Done, Failure, show, shown};
use crate::evaluate::paper::{self, MergeError, PaperPart, PaperReport, ReportRow, Shard};
use crate::library::Library;

/// Join the shards that `surfaced eval --paper --shard` wrote, and show the result
#[derive(clap::Args)]
pub struct MergeArgs {
    /// Files of shards, or folders that hold them
    #[arg(required = true, value_name = "DIR|FILES")]
    shards: Vec<PathBuf>,
    /// Folder for report.json, bars.svg and confusion.svg
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Print one JSON document on stdout
    #[arg(long)]
    json: bool,
}

/// Runs the evaluation, or one shard of it.
pub fn run(
    library: &Library,
    method: &MethodArgs,
    shard: Option<Shard>,
    out: Option<&Path>,
    json: bool,
) -> Done {
    let options = method.reference_options();
    let steps = show::Steps::new();
    let progress = |step, done, of| steps.show(step, done, of);
    let Some(shard) = shard else {
        let part = paper::work(library, &options, Shard::WHOLE, &progress)?;
        drop(steps);
        return finish(&part, out, json);
    };
    let out = out.unwrap_or(Path::new("."));
    let path = out.join(shard.file_name());
    let done = if path.exists() { read(&path).ok() } else { None };
    // Data, settings and trials identify a run, and cost nothing to find out.
    let expected = paper::work_head(library, &options, shard);
    if let Some(done) = done {
        if done.shard != shard || !done.is_of_run(&expected) {
            return Err(Failure::Failed(format!(
                "{}: a shard of another run (other data or settings); name another folder, or \
                 remove it",
                shown(&path)
            )));
        }
        drop(steps);
        say!("{}: done before", shown(&path));
        return Ok(());
    }
    let part = paper::work(library, &options, shard, &progress)?;
    drop(steps);
    // Plain numbers and text: nothing here that JSON cannot express.
    write(&path, &serde_json::to_string(&part).expect("plain data"))?;
    say!("wrote {}", shown(&path));
    Ok(())
}

/// Joins shards.
pub fn merge(args: &MergeArgs) -> Done {
    let mut files = Vec::new();
    for path in &args.shards {
        if !path.is_dir() {
            files.push(path.clone());
            continue;
        }
        let listed = std::fs::read_dir(path).map_err(|error| failed(path, error))?;
        for item in listed {
            let file = item.map_err(|error| failed(path, error))?.path();
            let name = file.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            if name.starts_with("shard-") && name.ends_with(".json") {
                files.push(file);
            }
        }
    }
    let parts = files.iter().map(|path| read(path)).collect::<Result<Vec<_>, _>>()?;
    let whole = paper::merge(parts).map_err(mended)?;
    finish(&whole, args.out.as_deref(), args.json)
}

/// The reason why shards cannot be joined, with a hint if no shard was named.
fn mended(error: MergeError) -> Failure {
    Failure::Failed(match error {
        MergeError::Nothing => format!(
            "{error}; name the files that `surfaced eval --paper --shard` wrote, or their folder"
        ),
        other => other.to_string(),
    })
}

fn failed(path: &Path, error: impl std::fmt::Display) -> Failure {
    Failure::Failed(format!("{}: {error}", shown(path)))
}

fn read(path: &Path) -> Result<PaperPart, Failure> {
    let text = std::fs::read(path).map_err(|error| failed(path, error))?;
    serde_json::from_slice(&text).map_err(|error| {
        failed(path, format!("{error}; expected what `surfaced eval --paper --shard` wrote"))
    })
}

/// Writes a file so that it is there whole or not at all.
fn write(path: &Path, text: &str) -> Done {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).map_err(|error| failed(folder, error))?;
    }
    let unfinished = path.with_extension(format!("{}.unfinished", std::process::id()));
    std::fs::write(&unfinished, text).map_err(|error| failed(&unfinished, error))?;
    std::fs::rename(&unfinished, path).map_err(|error| failed(path, error))
}

fn finish(part: &PaperPart, out: Option<&Path>, json: bool) -> Done {
    let report = PaperReport::new(part);
    if let Some(out) = out {
        // Plain numbers and text: nothing here that JSON cannot express.
        let text = serde_json::to_string_pretty(&report).expect("plain data");
        write(&out.join("report.json"), &text)?;
        write(&out.join("bars.svg"), &paper::bars(&report)?)?;
        let mut written = "report.json, bars.svg";
        if let Some(confusion) = &report.confusion {
            let figure = paper::confusion(confusion)?;
            write(&out.join("confusion.svg"), &figure)?;
            written = "report.json, bars.svg, confusion.svg";
        }
        say!("wrote {written} to {}", shown(out));
    }
    if json {
        show::json(&report);
    } else {
        print(&report);
    }
    Ok(())
}

fn print(report: &PaperReport) {
    let mark = if report.synthetic { ", on synthetic data" } else { "" };
    result!();
    result!("{}{mark} · reference · {}", report.data, report.settings);
    result!("accuracies in percent, mean ± sd over folds");
    result!("{:<54} {:>14} {:>14} {:>7}", "", "ours", "paper", "points");
    let mut head = (String::new(), "");
    let (measured, not_run): (Vec<_>, Vec<_>) =
        report.rows.iter().partition(|row| row.not_run.is_none());
    for row in &measured {
        let of_row = (row.place.to_string(), row.protocol);
        if of_row != head {
            result!("{} · {}", row.place, row.protocol);
            head = of_row;
        }
        print_row(row);
    }
    if !not_run.is_empty() {
        let why: BTreeSet<&str> = not_run.iter().filter_map(|row| row.not_run.as_deref()).collect();
        let why = why.into_iter().collect::<Vec<_>>().join("; ");
        let all = show::counted(report.rows.len(), "row");
        result!("\nmeasured {} of {all}; not measured: {why}", measured.len());
    }
}

fn print_row(row: &ReportRow) {
    let figure = |mean: f64, std: Option<f64>| match std {
        Some(std) => format!("{mean:.1} ± {std:4.1}"),
        None => format!("{mean:.1}       "),
    };
    let ours = match row.accuracy_mean {
        Some(mean) => figure(mean * 100.0, row.accuracy_std.map(|std| std * 100.0)),
        None => "no queries".into(),
    };
    let paper = row.published.map_or(String::new(), |p| figure(p.accuracy, p.std));
    let points = row.difference_points.map_or(String::new(), |points| format!("{points:+.1}"));
    let lacks = match row.missing.as_slice() {
        [] => String::new(),
        missing => format!("  without {}, which the data lack", missing.join(", ")),
    };
    result!("  {:<52} {ours:>14} {paper:>14} {points:>7}{lacks}", row.name);
    if let Some(Some(precision)) = row.published.map(|p| p.precision) {
        let ours = row.precision_mean.map_or(String::new(), |p| figure(p * 100.0, None));
        result!("  {:<52} {ours:>14} {:>14}", "  its precision", figure(precision, None));
    }
}
