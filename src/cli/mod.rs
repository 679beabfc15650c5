//! The command line: arguments are checked, turned into what the library works with, and results
//! shown.
//!
//! With `--json` a command prints JSON on stdout; other text goes to stderr.

#[macro_use]
mod say;

mod answers;
mod bad_files;
mod chart;
mod check;
mod choose;
mod common;
mod compare;
mod devices;
mod duration;
mod enroll;
mod eval;
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
mod outputs;
mod paper;
mod plan;
mod replay;
mod samples;
mod serve;
mod show;
mod stress;
mod synth;
mod tally;
mod terminal;

use std::process::ExitCode;

use clap::{CommandFactory, Parser, Subcommand};
use tracing::Level;

use self::common::{Done, Failure, SourceArgs, hold, open, open_held};
use self::show::shown;

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
    /// Also say on which measurements and settings an answer rests
    #[arg(long, short, global = true)]
    verbose: bool,
    /// Stop at recordings that cannot be used, instead of going on without them and ending with 3
    #[arg(long, global = true)]
    strict: bool,
}

#[derive(Subcommand)]
enum CliCommand {
    Replay(replay::Args),
    Run(live::Args),
    Fleet(fleet::Args),
    Outputs(outputs::Args),
    Enroll(enroll::EnrollArgs),
    Record(enroll::RecordArgs),
    Eval(eval::Args),
    Check(check::Args),
    Library(library::Args),
    History(history::Args),
    Chart(chart::Args),
    Plan(plan::Args),
    Stress(stress::Args),
    Compare(compare::Args),
    Dependence(compare::DependenceArgs),
    Duration(duration::Args),
    Synth(synth::Args),
    Devices(devices::Args),
    Export(export::ExportArgs),
    Import(export::ImportArgs),
    Completion(CompletionArgs),
}

/// The exit code of [`Failure::Damaged`].
const DAMAGED: u8 = 3;

/// Runs the command that the process was started with.
pub fn run() -> ExitCode {
    say::start_log();
    let Cli { command, verbose, strict } = Cli::parse();
    say::be_verbose(verbose);
    bad_files::be_strict(strict);
    let done = match command {
        CliCommand::Replay(args) => replay::run(&args),
        CliCommand::Run(args) => live::run(&args),
        CliCommand::Fleet(args) => fleet::run(&args),
        CliCommand::Outputs(args) => outputs::run(&args),
        CliCommand::Enroll(args) => enroll::enroll(&args),
        CliCommand::Record(args) => enroll::record(&args),
        CliCommand::Eval(args) => eval::run(&args),
        CliCommand::Check(args) => check::run(&args),
        CliCommand::Library(args) => library::run(&args),
        CliCommand::History(args) => history::run(&args),
        CliCommand::Chart(args) => chart::run(&args),
        CliCommand::Plan(args) => plan::run(&args),
        CliCommand::Stress(args) => stress::run(&args),
        CliCommand::Compare(args) => compare::run(&args),
        CliCommand::Dependence(args) => compare::dependence(&args),
        CliCommand::Duration(args) => duration::run(&args),
        CliCommand::Synth(args) => synth::run(&args),
        CliCommand::Devices(args) => devices::run(&args),
        CliCommand::Export(args) => export::export(&args),
        CliCommand::Import(args) => export::import(&args),
        CliCommand::Completion(args) => completion(&args, Cli::command()),
    };
    let (code, level, message) = match done.and_then(|()| bad_files::verdict()) {
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

fn completion(args: &CompletionArgs, mut program: clap::Command) -> Done {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut program, "surfaced", &mut script);
    // Printed here, since `generate` panics if the reader has gone away.
    Ok(std::io::Write::write_all(&mut std::io::stdout(), &script)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The commands of a page: indented lines that begin with `surfaced`, without their comments.
    fn commands(page: &str) -> impl Iterator<Item = &str> {
        let indented = page.lines().filter_map(|line| line.strip_prefix("    "));
        let plain = |line| str::split(line, "  #").next().unwrap_or_default().trim();
        indented.map(plain).filter(|line| line.starts_with("surfaced "))
    }

    #[test]
    fn every_command_of_the_pages_can_be_typed() {
        let pages = [
            include_str!("../../README.md"),
            include_str!("../evaluate/README.md"),
            include_str!("../library/README.md"),
            include_str!("../outputs/README.md"),
            include_str!("../serve/README.md"),
            include_str!("../../configs/README.md"),
            include_str!("../../firmware/README.md"),
        ];
        for command in pages.into_iter().flat_map(commands) {
            let words = command.split(" > ").next().unwrap_or_default().split_whitespace();
            let parsed = Cli::try_parse_from(words);
            assert!(parsed.is_ok(), "{command}: {}", parsed.err().unwrap());
        }
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
                // A shell would take these away.
                let plain = example.split(" > ").next().unwrap_or_default();
                let words = plain.split_whitespace().map(|word| word.trim_matches('\''));
                let parsed = Cli::try_parse_from(std::iter::once("surfaced").chain(words));
                assert!(parsed.is_ok(), "surfaced {example}: {}", parsed.err().unwrap());
                assert!(example.starts_with(name), "surfaced {example} stands under {name}");
            }
        }
        assert!(cli.get_after_help().is_some(), "`surfaced --help` has no example");
    }
}
