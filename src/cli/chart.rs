//! `surfaced chart`: charts the accuracy of every method against latency and against scan time.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::Instant;

use super::figure::{FigureArgs, can_draw, is_earlier};
use super::method::{OneOrAll, at_least_one, options_of};
use super::show::{Made, quoted};
use super::{Done, Failure, bad_files, one_of, show};
use crate::evaluate::chart::{Chart, charted, drag_s, figure, measure};
use crate::library::Library;
use crate::scene::SourceId;

/// Chart accuracy against latency and scan time, for every method
///
/// Each point is measured in this run, together with two negative controls: the accuracy from the
/// band below 80 Hz alone, and from loudness alone. JSON is written beside the picture.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced chart LMT_108_SurfaceMaterials_Database --sources \
                        mi2 --out chart.svg\n\nTime: some minutes for LMT108's 200 dragging sounds, on two cores; what is measured is written at once, so it may be interrupted")]
pub(super) struct Args {
    /// Recordings (a library, or the LMT108 database)
    lib: PathBuf,
    #[command(flatten)]
    figure: FigureArgs,
    /// Use this many surfaces at most, evenly spread over their names
    #[arg(long, value_name = "N", value_parser = at_least_one)]
    surfaces: Option<usize>,
    /// Methods, with commas between them; `reference` is the slowest by far
    #[arg(long, value_delimiter = ',', value_name = "METHOD,…", value_parser = one_of(OneOrAll::each()), default_value = "all")]
    methods: Vec<OneOrAll>,
    /// Measure only one setting of each method, on whole drags with all sources
    #[arg(long)]
    brief: bool,
}

pub(super) fn run(args: &Args) -> Done {
    can_draw(&args.figure.out)?;
    if is_earlier(&args.lib) {
        let problem = "expected recordings; earlier charts are drawn by `tools/peers/run --draw`";
        return Err(Failure::usage_at(&args.lib, problem));
    }
    let library = args.figure.only.open(&args.lib)?;
    let made = bad_files::work(&args.lib, library, |library| measured(args, library))?;
    say!(
        "bars: {}; hollow: some of the sources; grey line: the best trade-offs; dashed: negative controls",
        made.of.bars()
    );
    show::wrote(&args.figure.keep(&figure(&made.of, args.figure.look.into())?, &made)?);
    let lib = quoted(&args.lib);
    let next = format!("surfaced plan {lib} chooses the cheapest setting that is good enough");
    show::result(args.figure.json, &made, |_| show::next(&next));
    Ok(())
}

/// Measures one setting after the other, and writes the results after each one. They remain if a
/// later setting fails or the run is interrupted.
fn measured(args: &Args, library: &Library) -> Done<Made<Chart>> {
    let scene = args.figure.sources.narrow(library.scene.clone())?;
    let mut choice = args.figure.split.choose(&args.lib, library, scene)?;
    if let Some(most) = args.surfaces {
        choice.keep_surfaces(most)?;
    }
    let sources = choice.held();
    choice.scene = choice.scene.only(&sources)?;
    let chart = Chart {
        data: library.name.clone(),
        synthetic: library.synthetic,
        protocol: choice.split.name.clone(),
        left_out: choice.split.left_out.clone(),
        sources: sources.iter().map(SourceId::to_string).collect(),
        surfaces: choice.surfaces().collect::<BTreeSet<_>>().len(),
        library_trials: choice.split.folds.iter().map(|fold| fold.library.len()).max().unwrap_or(0),
        threads: rayon::current_num_threads(),
        drag_s: drag_s(&choice.entries, &choice.scene)?,
        points: Vec::new(),
    };
    let all = charted(&choice.scene, chart.drag_s, &OneOrAll::list(&args.methods), args.brief);
    // Every method of a chart has its default seed.
    let mut made = Made::new(chart, 1, library.digest());
    let (start, mut warned) = (Instant::now(), BTreeSet::new());
    for (done, one) in all.iter().enumerate() {
        let so_far_s = start.elapsed().as_secs_f64();
        let left_s = so_far_s * (all.len() - done) as f64 / done as f64;
        let left = match done {
            0 => String::new(),
            _ => format!("   ({so_far_s:.0} s so far, roughly {left_s:.0} s to go)"),
        };
        let options = one.method.as_ref().map(options_of).unwrap_or_default();
        let name = one.control.clone().unwrap_or(options);
        say!("{}/{}  {name}{left}", done + 1, all.len());
        let (measured, left_out) = measure(&choice.entries, &choice.split, one, &name)?;
        let fresh =
            show::left_out(&left_out).into_iter().filter(|line| warned.insert(line.clone()));
        fresh.for_each(|line| say!("warning: {line}"));
        for point in measured {
            let part = point.query_seconds.map_or("whole drag".into(), |s| format!("first {s} s"));
            let [accuracy, low, high] =
                [point.accuracy, point.interval.low, point.interval.high].map(show::percent);
            say!("       {part}: {accuracy} ({low} to {high}), {:.2} ms", point.query_ms_p50);
            made.of.points.push(point);
        }
        args.figure.keep(&figure(&made.of, args.figure.look.into())?, &made)?;
    }
    Ok(made)
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::cli::method::ComparingArgs;
    use crate::evaluate::chart::settings;

    /// Parses the options of a method alone, without a command.
    #[derive(clap::Parser)]
    struct Parsed {
        #[command(flatten)]
        comparing: ComparingArgs,
    }

    #[test]
    fn every_setting_is_called_by_the_options_that_ask_for_it() {
        for (method, ..) in settings() {
            let words = options_of(&method);
            let words = std::iter::once("surfaced").chain(words.split(' '));
            let parsed = Parsed::try_parse_from(words).unwrap();
            assert_eq!(parsed.comparing.resolve(None).ok().map(|how| how.method), Some(method));
        }
    }
}
