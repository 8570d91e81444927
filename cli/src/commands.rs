//! The commands. Each module holds a command's raw arguments, resolves them into settings, calls the libraries, and
//! reports.

mod shell;
mod train;

use clap::{Parser, Subcommand};

use crate::{
    console::{Console, Outcome},
    options::GlobalOptions,
};

/// Invert, edit and render portraits in 3D.
#[derive(Parser, Debug)]
#[command(name = "cnerf", version, max_term_width = 110, propagate_version = true)]
pub struct Arguments {
    #[command(flatten)]
    pub global: GlobalOptions,
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand, Debug)]
enum Command {
    /// Train a model
    Train(Box<train::TrainArguments>),
    /// Print shell completions
    Completions(shell::CompletionsArguments),
    /// Print the manual page
    Man,
}

/// Runs the command the arguments name.
pub fn run(arguments: Arguments, console: &Console) -> anyhow::Result<Outcome> {
    let seed = arguments.global.seed;
    match arguments.command {
        Command::Train(train) => train.run(seed, console),
        Command::Completions(completions) => completions.run(),
        Command::Man => shell::man(),
    }
}
