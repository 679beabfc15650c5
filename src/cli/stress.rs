//! `surfaced stress`: disturbs queries or the library until each method fails.

use std::ffi::OsStr;
use std::fmt::Display;
use std::path::{Path, PathBuf};

use super::choose::Choice;
use super::figure::{FigureArgs, can_draw, draw, is_earlier, write};
use super::method::{OneOrAll, at_least_one};
use super::show::Made;
use super::{Done, Failure, bad_files, one_of, say, show};
use crate::evaluate::stress::{
    self, Disturbance, Measure, StressPlan, StressReport, disturb, figure,
};
use crate::library::Library;
use crate::recognise::{MethodName, MethodSpec, ReferenceOptions, STAGES};
use crate::scene::SourceSpec;

/// Disturb queries, and the library, until each method breaks
///
/// Writes a chart of the accuracy, the numbers as JSON, and a Markdown table of where each method
/// loses 5 points, and two queries or more, unless it may name by chance. Beside the chart, NAME-unknown and NAME-calibration show the rejection of unknown
/// surfaces and the stated probabilities. `reference` runs with --halving. If LIB is the
/// JSON of an earlier run, its figures are drawn again.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced stress LMT_108_SurfaceMaterials_Database --sources \
                        mi2 --out stress.svg\n  surfaced stress lib --out s.svg --only \
                        dead-sensors,gain --methods embedding,svm\n\nTime: 10 minutes for LMT108's 200 dragging sounds, on two cores; each method is written as it is done, so it may be interrupted")]
pub(super) struct Args {
    /// Recordings: a library, or the LMT108 database; or an earlier run's JSON
    lib: PathBuf,
    #[command(flatten)]
    figure: FigureArgs,
    /// Methods, with commas between them
    #[arg(long, value_delimiter = ',', value_name = "METHOD,…", value_parser = one_of(OneOrAll::each()), default_value = "all")]
    methods: Vec<OneOrAll>,
    /// Disturbances, with commas between them (default: all that the data can show)
    #[arg(long = "only", value_delimiter = ',', value_name = "NAME,…")]
    disturbances: Vec<String>,
    /// Largest number of queries
    #[arg(long, default_value_t = 40, value_name = "N", value_parser = at_least_one)]
    queries: usize,
    /// Seed of the disturbances
    #[arg(long, default_value_t = 1, value_name = "SEED")]
    seed: u64,
}

pub(super) fn run(args: &Args) -> Done {
    can_draw(&args.figure.out)?;
    let report = if is_earlier(&args.lib) {
        earlier(&args.lib)?
    } else {
        let library = args.figure.only.open(&args.lib)?;
        bad_files::work(&args.lib, library, |library| measured(args, library))?
    };
    show::wrote(&keep(args, &report)?);
    say::results_aside(args.figure.json);
    result!("\n{}", report.of.markdown());
    if args.figure.json {
        show::json(&report);
    }
    show::next("look for the row where your method fails first, and mend that at the station");
    Ok(())
}

/// Reads the report that an earlier run wrote beside its chart.
fn earlier(path: &Path) -> Done<Made<StressReport>> {
    let failed = |error: &dyn Display| {
        let expected = "expected what `surfaced stress` writes beside its picture";
        Failure::at(path, format!("{error}; {expected}"))
    };
    let text = std::fs::read_to_string(path).map_err(|error| failed(&error))?;
    serde_json::from_str(&text).map_err(|error| failed(&error))
}

fn measured(args: &Args, library: &Library) -> Done<Made<StressReport>> {
    let scene = args.figure.sources.narrow(library.scene.clone())?;
    let Choice { scene, entries, split } = args.figure.split.choose(&args.lib, library, scene)?;
    let folds = StressPlan::limited(split.folds, args.queries);
    let held: Vec<&SourceSpec> = (scene.sources())
        .filter(|spec| entries.iter().any(|entry| entry.sources.contains(&spec.id)))
        .collect();
    let disturbances = chosen(&args.disturbances, &held)?;
    let plan = StressPlan {
        scene: &scene,
        entries: &entries,
        folds: &folds,
        disturbances: &disturbances,
        seed: args.seed,
    };
    let unknown = plan.unknown();
    let report = StressReport {
        data: library.name.clone(),
        synthetic: library.synthetic,
        protocol: split.name,
        left_out: split.left_out,
        sources: held.iter().map(|spec| spec.id.to_string()).collect(),
        queries: folds.iter().map(|fold| fold.queries.len()).sum(),
        unknown_queries: (folds.iter().flat_map(|fold| &fold.queries))
            .filter(|query| unknown[**query])
            .count(),
        methods: Vec::new(),
    };
    let mut report = Made::new(report, args.seed, library.digest());
    let methods = OneOrAll::list(&args.methods);
    for (done, method) in methods.iter().enumerate() {
        say!("{}/{}  {}", done + 1, methods.len(), method.as_str());
        let method = quick(*method).build(&scene);
        report.of.methods.push(stress::run(&*method, &plan, &say::progress)?);
        // The report is written after each method, so that it remains if a later method fails.
        keep(args, &report)?;
    }
    Ok(report)
}

/// A method with its default settings, except that `reference` uses successive halving for speed.
fn quick(method: MethodName) -> MethodSpec {
    match method {
        MethodName::Reference => MethodSpec::Reference(ReferenceOptions {
            halving: STAGES.to_vec(),
            ..ReferenceOptions::default()
        }),
        other => other.into(),
    }
}

fn chosen(only: &[String], held: &[&SourceSpec]) -> Done<Vec<Disturbance>> {
    let all = disturb::all();
    if let Some(unknown) = only.iter().find(|name| !all.iter().any(|d| d.name == **name)) {
        let known = show::listed(all.iter().map(|d| d.name));
        return Err(Failure::Usage(format!("no disturbance `{unknown}`; there are {known}")));
    }
    let wanted = |d: &Disturbance| only.is_empty() || only.iter().any(|name| name == d.name);
    let found: Vec<_> = all.into_iter().filter(wanted).filter_map(|d| d.fitted(held)).collect();
    if found.is_empty() {
        return Err(Failure::usage("these disturbances change nothing of these sources"));
    }
    Ok(found)
}

/// Writes the pictures and their numbers, and returns the paths of the files.
fn keep(args: &Args, made: &Made<StressReport>) -> Done<Vec<PathBuf>> {
    let (out, report) = (&args.figure.out, &made.of);
    let mut written =
        args.figure.keep(&figure(report, Measure::Accuracy, args.figure.look.into())?, made)?;
    let table = out.with_extension("md");
    write(&table, report.markdown())?;
    written.push(table);
    let part = |of: Option<&OsStr>| of.unwrap_or_default().to_string_lossy().into_owned();
    let (stem, extension) = (part(out.file_stem()), part(out.extension()));
    for (name, measure) in
        [("unknown", Measure::UnknownRejected), ("calibration", Measure::CalibrationError)]
    {
        // If no method gives probabilities, there is no figure.
        if let Ok(svg) = figure(report, measure, args.figure.look.into()) {
            let path = out.with_file_name(format!("{stem}-{name}.{extension}"));
            draw(&path, &svg)?;
            written.push(path);
        }
    }
    Ok(written)
}
