//! `cnerf completions` and `cnerf man`: made from the same definitions the arguments are parsed by.

use std::io::Write as _;

use clap::{Args, CommandFactory as _};

use crate::{commands::Arguments, console::Outcome};

/// Arguments of `cnerf completions`.
#[derive(Args, Debug)]
pub struct CompletionsArguments {
    /// The shell to complete in
    shell: clap_complete::Shell,
}

impl CompletionsArguments {
    /// Prints the script.
    pub fn run(self) -> anyhow::Result<Outcome> {
        let mut script = Vec::new();
        clap_complete::generate(self.shell, &mut Arguments::command(), "cnerf", &mut script);
        std::io::stdout().write_all(&script)?;
        Ok(Outcome::Done)
    }
}

/// Prints the manual page.
pub fn man() -> anyhow::Result<Outcome> {
    let mut page = Vec::new();
    clap_mangen::Man::new(Arguments::command()).render(&mut page)?;
    std::io::stdout().write_all(&page)?;
    Ok(Outcome::Done)
}
