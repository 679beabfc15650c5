//! The command line: checks arguments, calls the library crate, and shows the results.
//!
//! With `--json` a command prints JSON on stdout; other text goes to stderr.

#[macro_use]
mod say;

mod bad_files;
mod chart;
mod check;
mod choose;
mod compare;
mod condition;
mod config;
mod devices;
mod duration;
mod enroll;
mod eval;
mod eval_report;
mod export;
mod figure;
mod fleet;
mod history;
mod import_csv;
mod json_lines;
mod keys;
mod library;
mod live;
mod method;
mod naming;
mod outputs;
mod paper;
mod plan;
mod replay;
mod serve;
mod show;
mod stress;
mod synth;
mod system;
mod tally;
mod terminal;
mod train;

use std::fmt::Display;
use std::path::Path;
use std::process::ExitCode;
use std::str::FromStr;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use clap::{CommandFactory, Parser, Subcommand};
use tracing::Level;

use crate::library::Library;
use crate::record::edit::LibraryLock;
use crate::scene::{Scene, SourceId};
use crate::station::config::StationConfig;

/// Names the surface a sensorised stylus is dragged over, by the kernel two-sample test.
#[derive(Parser)]
#[command(
    name = "surfaced",
    version,
    max_term_width = 100,
    after_help = "Examples:\n  surfaced replay\n  surfaced replay --speed 1.0 --serve\n  \
                  surfaced run --library my-library --serve"
)]
struct Cli {
    #[command(subcommand)]
    command: CliCommand,
    /// Also print the measurements and settings that an answer is based on
    #[arg(long, short, global = true)]
    verbose: bool,
    /// Stop at recordings that cannot be used, instead of skipping them and ending with code 3
    #[arg(long, global = true)]
    strict: bool,
}

macro_rules! commands {
    ($($name:ident($args:ty) => $run:path,)*) => {
        #[derive(Subcommand)]
        enum CliCommand {
            $($name($args),)*
        }

        impl CliCommand {
            fn run(&self) -> Done {
                match self {
                    $(Self::$name(args) => $run(args),)*
                }
            }
        }
    };
}

// Lists each command with its arguments and the function that runs it.
commands! {
    Replay(replay::Args) => replay::run,
    Run(live::Args) => live::run,
    Fleet(fleet::Args) => fleet::run,
    Outputs(outputs::Args) => outputs::run,
    Config(config::Args) => config::run,
    Enroll(enroll::EnrollArgs) => enroll::enroll,
    Record(enroll::RecordArgs) => enroll::record,
    Eval(eval::Args) => eval::run,
    Check(check::Args) => check::run,
    Train(train::Args) => train::run,
    Library(library::Args) => library::run,
    History(history::Args) => history::run,
    Chart(chart::Args) => chart::run,
    Plan(plan::Args) => plan::run,
    Stress(stress::Args) => stress::run,
    Compare(compare::Args) => compare::run,
    Dependence(compare::DependenceArgs) => compare::dependence,
    Duration(duration::Args) => duration::run,
    Synth(synth::Args) => synth::run,
    Devices(devices::Args) => devices::run,
    Export(export::ExportArgs) => export::export,
    Import(export::ImportArgs) => export::import,
    Completion(CompletionArgs) => completion,
}

/// The exit code of [`Failure::Damaged`].
const DAMAGED: u8 = 3;

pub fn run() -> ExitCode {
    surfaced_method::system::keep_freed_memory();
    say::start_log();
    let Cli { command, verbose, strict } = Cli::parse();
    say::be_verbose(verbose);
    bad_files::be_strict(strict);
    let (code, level, message) = match command.run().and_then(|()| bad_files::verdict()) {
        Ok(()) => return ExitCode::SUCCESS,
        Err(Failure::Failed(message)) => (1, Level::ERROR, message),
        Err(Failure::Usage(message)) => (2, Level::ERROR, message),
        Err(Failure::Damaged(message)) => (DAMAGED, Level::WARN, message),
    };
    say!("{}{}{message}", say::priority(level), say::word(level));
    ExitCode::from(code)
}

/// Print what a shell needs to complete commands and options
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced completion bash > surfaced.bash\n  \
                        surfaced completion zsh > _surfaced\n  \
                        surfaced completion fish > surfaced.fish\n\n\
                        For all users: bash, /usr/share/bash-completion/completions/surfaced; zsh, \
                        /usr/share/zsh/vendor-completions/_surfaced; fish, \
                        /usr/share/fish/vendor_completions.d/surfaced.fish.\n\nTime: immediate")]
struct CompletionArgs {
    /// The shell
    #[arg(value_enum)]
    shell: clap_complete::Shell,
}

fn completion(args: &CompletionArgs) -> Done {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut Cli::command(), "surfaced", &mut script);
    // The script is printed here, since `generate` would panic if the reader has closed stdout.
    match std::io::Write::write_all(&mut std::io::stdout(), &script) {
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        written => Ok(written?),
    }
}

/// The reason why a command did not complete its work, by exit code.
#[derive(Debug)]
enum Failure {
    /// Exit code 1.
    Failed(String),
    /// Exit code 2.
    Usage(String),
    /// Exit code 3. The work is done, but something in use was lost or damaged.
    Damaged(String),
}

impl Failure {
    fn usage(why: impl Display) -> Self {
        Self::Usage(why.to_string())
    }

    /// Makes the failure of a user who named a wrong file or folder.
    fn usage_at(path: &Path, why: impl Display) -> Self {
        Self::Usage(format!("{}: {why}", path.display()))
    }

    /// Makes the failure of an operation on a file or folder.
    fn at(path: &Path, why: impl Display) -> Self {
        Self::Failed(format!("{}: {why}", path.display()))
    }

    fn text(self) -> String {
        let (Self::Failed(text) | Self::Usage(text) | Self::Damaged(text)) = self;
        text
    }
}

/// Errors of the library crate end a command with exit code 1.
impl<E: std::error::Error> From<E> for Failure {
    fn from(error: E) -> Self {
        Self::Failed(error.to_string())
    }
}

type Done<T = ()> = Result<T, Failure>;

/// The sources that a comparison uses.
#[derive(Clone, Debug, clap::Args)]
struct SourceArgs {
    /// Sources to compare, with commas between them (default: all that the data have)
    #[arg(long, value_delimiter = ',', value_name = "ID,…", value_parser = SourceId::new)]
    sources: Vec<SourceId>,
}

impl SourceArgs {
    /// The scene with only the sources that the user named.
    fn narrow(&self, scene: Scene) -> Done<Scene> {
        if self.sources.is_empty() {
            return Ok(scene);
        }
        scene.only(&self.sources).map_err(Failure::usage)
    }
}

/// Reads the configuration of a station from a file; without a file, returns the defaults.
fn config(file: Option<&Path>) -> Done<StationConfig> {
    let read = |path| StationConfig::read(path).map_err(Failure::usage);
    file.map_or_else(|| Ok(StationConfig::embedded()), read)
}

/// Locks a library against edits until the command ends; `path` is the library or one of its trials.
fn hold(path: &Path) {
    let path = path.canonicalize().unwrap_or_else(|_| path.to_path_buf());
    // A trial lies two folders below its library, so the library is one of these three folders.
    for folder in path.ancestors().take(3).filter(|folder| folder.is_dir()) {
        std::mem::forget(LibraryLock::for_reading(folder));
    }
}

/// Opens recordings in any form, locks them against edits, and summarises them on stderr.
fn open(path: &Path) -> Done<Library> {
    hold(path);
    open_held(path)
}

/// Like [`open`], for callers that have already locked the recordings.
fn open_held(path: &Path) -> Done<Library> {
    let library = bad_files::open(path, &Scene::lmt108())?;
    show::library(&library);
    Ok(library)
}

/// A value of an option, its name and its help (empty for none).
type Named<T> = (T, &'static str, &'static str);

/// Parses the name of one of `all`, where its type is of a package that knows nothing of clap.
fn one_of<T: Copy + Send + Sync + 'static>(
    all: impl IntoIterator<Item = Named<T>>,
) -> impl TypedValueParser<Value = T> {
    let all: Vec<Named<T>> = all.into_iter().collect();
    let value = |&(_, name, help): &Named<T>| {
        PossibleValue::new(name).help((!help.is_empty()).then_some(help))
    };
    PossibleValuesParser::new(all.iter().map(value)).try_map(move |text| {
        let named = all.iter().find(|(_, name, _)| *name == text);
        named.map(|(one, _, _)| *one).ok_or("no such name")
    })
}

/// The longest drag that an option may give, in seconds (an hour).
const LONGEST_S: f64 = 3600.0;

/// Parses a value that `is_valid`; an error says what was `expected`.
fn parsed<T: FromStr>(
    text: &str,
    is_valid: impl Fn(&T) -> bool,
    expected: impl Display,
) -> Result<T, String> {
    text.parse().ok().filter(is_valid).ok_or_else(|| format!("expected {expected}"))
}

fn seconds(text: &str) -> Result<f64, String> {
    let expected = format!("a positive number of seconds, at most {LONGEST_S}");
    parsed(text, |x| *x > 0.0 && *x <= LONGEST_S, expected)
}

fn share(text: &str) -> Result<f64, String> {
    parsed(text, |x| *x > 0.0 && *x < 1.0, "a fraction above 0 and below 1, such as 0.01")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The commands in a page, that is, its indented lines that begin with `surfaced`.
    fn commands(page: &str) -> impl Iterator<Item = &str> {
        let indented = page.lines().filter_map(|line| line.strip_prefix("    "));
        let plain = |line| str::split(line, "  #").next().unwrap_or_default().trim();
        indented.map(plain).filter(|line| line.starts_with("surfaced "))
    }

    #[track_caller]
    fn assert_typed(command: &str) {
        // A shell would take redirections and quotes away, so they are removed here.
        let plain = command.split(" > ").next().unwrap_or_default();
        let words = plain.split_whitespace().map(|word| word.trim_matches('\''));
        let parsed = Cli::try_parse_from(words);
        assert!(parsed.is_ok(), "{command}: {}", parsed.err().unwrap());
    }

    #[test]
    fn every_command_of_the_pages_can_be_typed() {
        let pages = [
            include_str!("../../README.md"),
            include_str!("../method/evaluate/README.md"),
            include_str!("../method/library/README.md"),
            include_str!("../outputs/README.md"),
            include_str!("../serve/README.md"),
            include_str!("../../configs/README.md"),
            include_str!("../../firmware/README.md"),
        ];
        pages.into_iter().flat_map(commands).for_each(assert_typed);
    }

    #[test]
    fn every_help_has_an_example_that_can_be_typed() {
        let mut cli = Cli::command();
        cli.build();
        for command in cli.get_subcommands().filter(|command| command.get_name() != "help") {
            let name = command.get_name();
            let after = command.get_after_help().map(ToString::to_string).unwrap_or_default();
            let examples: Vec<&str> =
                after.lines().filter_map(|line| line.trim().strip_prefix("surfaced ")).collect();
            assert!(!examples.is_empty(), "`surfaced {name} --help` has no example");
            assert!(after.contains("\n\nTime: "), "`surfaced {name} --help` does not say how long");
            for example in examples {
                assert_typed(&format!("surfaced {example}"));
                assert!(example.starts_with(name), "surfaced {example} stands under {name}");
            }
        }
        assert!(cli.get_after_help().is_some(), "`surfaced --help` has no example");
    }
}
