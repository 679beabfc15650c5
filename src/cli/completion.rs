//! `surfaced completion`: what a shell needs to complete commands, made from their definitions.

use clap_complete::Shell;

use super::common::Done;

/// Print what a shell needs to complete commands and options
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  surfaced completion bash > surfaced.bash\n  \
                        surfaced completion zsh > _surfaced\n  \
                        surfaced completion fish > surfaced.fish\n\n\
                        For all users: bash, /usr/share/bash-completion/completions/surfaced; zsh, \
                        /usr/share/zsh/vendor-completions/_surfaced; fish, \
                        /usr/share/fish/vendor_completions.d/surfaced.fish.\n\nTime: immediate")]
pub struct Args {
    /// The shell
    #[arg(value_enum)]
    shell: Shell,
}

pub fn run(args: &Args, mut program: clap::Command) -> Done {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut program, "surfaced", &mut script);
    // A reader that has gone away wants no more.
    Ok(std::io::Write::write_all(&mut std::io::stdout(), &script)?)
}
