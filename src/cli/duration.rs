//! `surfaced duration`: T* and the scan duration of each surface and source of a library.

use std::path::PathBuf;

use super::figure::write;
use super::method::at_least_one;
use super::{Done, Failure, show};
use crate::duration::{Question, ReportError, Rule, Settings, figure, report};
use crate::kernel::{PERMUTATIONS, Threshold};
use crate::scene::SourceId;

/// Tell how long a scan must last: T*, the minimum time between independent samples
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced duration lib --source ir\n  \
                        surfaced duration lib --source ir --surface G7EPDMFoam --svg foam.svg\n  \
                        surfaced duration LMT_108_SurfaceMaterials_Database --source mi2 --as-time")]
pub struct Args {
    /// A library, or any recordings that `eval` reads
    lib: PathBuf,
    /// Sources, with commas between them (default: all of domain `time`)
    #[arg(long, value_delimiter = ',', value_name = "ID,…", value_parser = SourceId::new)]
    source: Vec<SourceId>,
    /// Surfaces, with commas between them (default: all)
    #[arg(long, value_delimiter = ',', value_name = "NAME,…")]
    surface: Vec<String>,
    /// Whose trials (default: for each surface, those of the user with the most)
    #[arg(long, value_name = "NAME")]
    user: Option<String>,
    /// Take the named sources as series in time, whatever their domain is
    #[arg(long, requires = "source")]
    as_time: bool,
    /// Upper bound of HSIC: the quantile of its values (Algorithm 1 as printed), or the upper end
    /// of the interval of their mean (the authors' program)
    #[arg(long, value_enum, default_value_t = RuleName::MeanCi)]
    rule: RuleName,
    /// Independent samples that a scan must yield
    #[arg(long, default_value_t = 400, value_name = "N", value_parser = at_least_one)]
    samples: usize,
    /// R, the draws of a start for each lag
    #[arg(long, default_value_t = 500, value_name = "R", value_parser = at_least_one)]
    draws: usize,
    /// Latest start t1,max, in samples
    #[arg(long, default_value_t = 20_000, value_name = "SAMPLES", value_parser = at_least_one)]
    latest_start: usize,
    /// Largest lag to look at, in samples
    #[arg(long, default_value_t = 1000, value_name = "SAMPLES", value_parser = at_least_one)]
    largest_lag: usize,
    /// Significance level of κ
    #[arg(long, default_value_t = 0.05, value_name = "ALPHA")]
    alpha: f64,
    /// Permutations for each κ
    #[arg(long, default_value_t = PERMUTATIONS, value_name = "COUNT", value_parser = at_least_one)]
    permutations: usize,
    /// κ from the exact permutation moments instead of permutations: faster
    #[arg(long, conflicts_with = "permutations")]
    gamma: bool,
    /// Look at every lag upwards instead of a coarse grid that is refined
    #[arg(long)]
    exhaustive: bool,
    /// Stop at the first lag, as Algorithm 1 is printed, even if dependence returns beyond it
    #[arg(long)]
    first: bool,
    /// Seed of everything that is drawn at random
    #[arg(long, default_value_t = 1, value_name = "SEED")]
    seed: u64,
    /// Draw the curves (HSIC, κ, T*) as SVG
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// Print one JSON document on stdout
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum RuleName {
    Quantile,
    MeanCi,
}

impl Args {
    fn question(&self) -> Question {
        let threshold =
            if self.gamma { Threshold::Gamma } else { Threshold::Permutations(self.permutations) };
        Question {
            sources: self.source.clone(),
            surfaces: self.surface.clone(),
            user: self.user.clone(),
            as_time: self.as_time,
            samples: self.samples,
            settings: Settings {
                rule: match self.rule {
                    RuleName::Quantile => Rule::Quantile,
                    RuleName::MeanCi => Rule::MeanCi,
                },
                draws: self.draws,
                latest_start: self.latest_start,
                alpha: self.alpha,
                threshold,
                largest_lag: self.largest_lag,
                exhaustive: self.exhaustive,
                look_beyond: !self.first,
                seed: self.seed,
            },
        }
    }
}

/// Runs the command.
pub fn run(args: &Args) -> Done {
    let library = super::open(&args.lib)?;
    let steps = show::Steps::new();
    let answer = report(&library, &args.question(), |done, of| steps.show("surfaces", done, of));
    drop(steps);
    let answer = answer.map_err(|error| match error {
        ReportError::Library(error) => Failure::Failed(error.to_string()),
        ReportError::Duration(error) => Failure::Usage(error.to_string()),
        ReportError::Scene(error) => Failure::Usage(error.to_string()),
        ReportError::Nothing(problem) => {
            Failure::Failed(format!("{}: {problem}", super::shown(&args.lib)))
        }
    })?;
    if let Some(path) = &args.svg {
        write(path, &figure(&answer.durations)?)?;
    }
    if args.json {
        show::json(&answer);
    } else {
        say!("{}", answer.table().trim_end());
        let mut remarks: Vec<_> = answer.durations.iter().flat_map(|d| &d.remarks).collect();
        remarks.sort();
        remarks.dedup();
        for remark in remarks {
            say!("  {remark}");
        }
    }
    Ok(())
}
