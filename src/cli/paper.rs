//! `surfaced eval DATA --paper`: computes the paper's tables, whole or shard by shard, beside the
//! paper's numbers; `surfaced eval merge` joins shards.

use std::path::{Path, PathBuf};

use super::method::MethodOptions;
use super::show::Made;
use super::{Done, Failure, say, show};
use crate::library::Library;
use crate::library::files::{self, Listed};
use crate::recognise::ReferenceOptions;
use crate::record::replace_file;
use crate::replication::{self, PaperPart, PaperReport, ReportRow, Shard};

/// Join the shards that `surfaced eval --paper --shard` wrote, and show the result
#[derive(clap::Args)]
pub(super) struct MergeArgs {
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

/// Runs the evaluation, or one shard of the evaluation.
pub(super) fn run(
    library: &Library,
    method: &MethodOptions,
    shard: Option<Shard>,
    out: Option<&Path>,
    json: bool,
) -> Done {
    let options = method.reference_options();
    let Some(shard) = shard else {
        return finish(&worked(library, &options, Shard::WHOLE)?, out, json);
    };
    let out = out.unwrap_or(Path::new("."));
    let path = out.join(shard.file_name());
    if let Ok(done) = read(&path) {
        // Data, settings and trials identify a run, so an old shard is checked without an evaluation.
        let expected = replication::work_head(library, &options, shard);
        if done.shard != shard || !done.is_of_run(&expected) {
            let problem = "a shard of another run (other data or settings); name another folder, \
                           or remove it";
            return Err(Failure::at(&path, problem));
        }
        say!("{}: done before", path.display());
        return Ok(());
    }
    write(&path, &show::json_text(&worked(library, &options, shard)?))?;
    say!("wrote {}", path.display());
    Ok(())
}

fn worked(library: &Library, options: &ReferenceOptions, shard: Shard) -> Done<PaperPart> {
    let part = replication::work(library, options, shard, &say::progress)?;
    Ok(PaperPart { library: library.digest(), ..part })
}

pub(super) fn merge(args: &MergeArgs) -> Done {
    let mut found = Vec::new();
    for path in &args.shards {
        if !path.is_dir() {
            found.push(path.clone());
            continue;
        }
        let is_shard =
            |item: &Listed| item.name.starts_with("shard-") && item.name.ends_with(".json");
        let shards = files::list(path)?.into_iter().filter(is_shard);
        found.extend(shards.map(|item| item.path));
    }
    let parts = found.iter().map(|path| read(path)).collect::<Result<Vec<_>, _>>()?;
    let whole = replication::merge(parts).map_err(Failure::Failed)?;
    finish(&whole, args.out.as_deref(), args.json)
}

fn read(path: &Path) -> Done<PaperPart> {
    let text = std::fs::read(path).map_err(|error| Failure::at(path, error))?;
    serde_json::from_slice(&text).map_err(|error| {
        Failure::at(path, format!("{error}; expected what `surfaced eval --paper --shard` wrote"))
    })
}

/// Writes a file completely or not at all.
fn write(path: &Path, text: &str) -> Done {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).map_err(|error| Failure::at(folder, error))?;
    }
    Ok(replace_file(path, text.as_bytes())?)
}

fn finish(part: &PaperPart, out: Option<&Path>, json: bool) -> Done {
    let report = Made::new(PaperReport::new(part), part.seed, part.library.clone());
    if let Some(out) = out {
        let mut files = vec![
            ("report.json", serde_json::to_string_pretty(&report)?),
            ("bars.svg", replication::bars(&report.of)?),
        ];
        if let Some(confusion) = &report.of.confusion {
            files.push(("confusion.svg", replication::confusion(confusion)?));
        }
        files.iter().try_for_each(|(name, text)| write(&out.join(name), text))?;
        say!("wrote {} to {}", show::listed(files.iter().map(|(name, _)| name)), out.display());
    }
    show::result(json, &report, |made| print(&made.of));
    report.of.lacking().map_or(Ok(()), |lacking| Err(Failure::Damaged(lacking)))
}

fn print(report: &PaperReport) {
    let mark = if report.synthetic { ", on synthetic data" } else { "" };
    let measured = || report.rows.iter().filter(|row| row.not_run.is_none());
    if measured().next().is_none() {
        return;
    }
    result!();
    result!("{}{mark} · reference · {}", report.data, report.settings);
    result!("accuracies in percent, mean ± sd over folds");
    let mut rows = Vec::new();
    let mut head = String::new();
    for row in measured() {
        let of_row = format!("{} · {}", row.row.place, row.row.protocol.name());
        if of_row != head {
            rows.push(vec![of_row.clone()]);
            head = of_row;
        }
        add_cells(row, &mut rows);
    }
    show::table(&["", ">ours", ">paper", ">points", ""], rows);
}

/// Adds the cells of a row. If the paper prints a precision, adds a second row for it.
fn add_cells(row: &ReportRow, rows: &mut Vec<Vec<String>>) {
    let figure = |mean: f64, std: Option<f64>| match std {
        Some(std) => format!("{mean:.1} ± {std:4.1}"),
        None => format!("{mean:.1}       "),
    };
    let std = row.accuracy_std.map(|std| std * 100.0);
    let ours = row.accuracy_mean.map_or("no queries".into(), |mean| figure(mean * 100.0, std));
    let published = row.row.published;
    let paper = published.map_or(String::new(), |p| figure(p.accuracy, p.std));
    let points = row.difference_points.map_or(String::new(), |points| format!("{points:+.1}"));
    let lacks = match row.missing.as_slice() {
        [] => String::new(),
        missing => format!("without {}, which the data lack", missing.join(", ")),
    };
    rows.push(vec![format!("  {}", row.row.name), ours, paper, points, lacks]);
    if let Some(precision) = published.and_then(|published| published.precision) {
        let ours = row.precision_mean.map_or(String::new(), |p| figure(p * 100.0, None));
        rows.push(vec!["    its precision".into(), ours, figure(precision, None)]);
    }
}
