//! What a person sees: progress and logs on stderr, results on stdout.

use std::{process::ExitCode, time::Duration};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;

use crate::options::GlobalOptions;

/// How a command ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// Everything was done.
    Done,
    /// Some inputs failed; the others are written.
    Partial,
}

impl From<Outcome> for ExitCode {
    fn from(outcome: Outcome) -> Self {
        match outcome {
            Outcome::Done => Self::SUCCESS,
            Outcome::Partial => Self::from(1),
        }
    }
}

/// Shows what the argument parser has to say: help and version as they are, a mistake in one line.
pub fn explain(error: &clap::Error) -> ExitCode {
    let whole_help = error.kind() == clap::error::ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand;
    if whole_help || !error.use_stderr() {
        // A closed pipe (`cnerf help | head -1`) is the reader's choice.
        let _ = error.print();
        return if whole_help { ExitCode::from(2) } else { ExitCode::SUCCESS };
    }
    eprintln!("{}", one_line(&error.to_string()));
    ExitCode::from(2)
}

/// The argument parser's message without its usage, its lines joined.
fn one_line(message: &str) -> String {
    let said = message
        .lines()
        .map(str::trim)
        .take_while(|line| !line.starts_with("Usage:") && !line.starts_with("For more information"))
        .filter(|line| !line.is_empty());
    let mut joined = String::new();
    for line in said {
        joined.push_str(if joined.is_empty() {
            ""
        } else if joined.ends_with(':') {
            " "
        } else {
            "; "
        });
        joined.push_str(line);
    }
    format!("{joined}; try --help")
}

/// The terminal, as quiet or talkative as asked.
pub struct Console {
    mute: bool,
    quiet: bool,
    json: bool,
    progress: bool,
}

impl Console {
    /// Sets up logging and threads as well: both are process-wide.
    pub fn new(options: &GlobalOptions) -> Self {
        let level = match (options.quiet, options.verbose) {
            (true, _) => "error",
            (_, 0) => "warn",
            (_, 1) => "info",
            (_, 2) => "debug",
            _ => "trace",
        };
        let filter = tracing_subscriber::EnvFilter::try_from_env("CNERF_LOG")
            .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new(level));
        // Both fail only if set twice in a process, which `main` never does.
        let _ =
            tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).without_time().try_init();
        if let Some(threads) = options.threads {
            let _ = rayon::ThreadPoolBuilder::new().num_threads(usize::from(threads)).build_global();
        }
        let progress = !options.quiet && !options.no_progress;
        Self { mute: false, quiet: options.quiet, json: options.json, progress }
    }

    /// One that shows nothing: of processes that work together one speaks.
    pub fn mute() -> Self {
        Self { mute: true, quiet: true, json: false, progress: false }
    }

    /// A progress bar of `length` steps on stderr; invisible where it would not be one.
    pub fn bar(&self, length: u64, what: impl Into<String>) -> ProgressBar {
        let bar = ProgressBar::with_draw_target(Some(length), self.target());
        let template = "{prefix:<12} {bar:32} {pos}/{len} {elapsed} left {eta} {wide_msg}";
        bar.set_style(ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()));
        bar.set_prefix(what.into());
        bar
    }

    /// A spinner for work of unknown length.
    pub fn spinner(&self, what: impl Into<String>) -> ProgressBar {
        let bar = ProgressBar::with_draw_target(None, self.target());
        bar.set_message(what.into());
        bar.enable_steady_tick(Duration::from_millis(120));
        bar
    }

    fn target(&self) -> ProgressDrawTarget {
        if self.progress { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() }
    }

    /// A line for a person, on stderr.
    pub fn note(&self, line: impl std::fmt::Display) {
        if !self.quiet {
            eprintln!("{line}");
        }
    }

    /// Whether only errors and the result are wanted.
    pub fn is_quiet(&self) -> bool {
        self.quiet
    }

    /// A warning, on stderr even when quiet.
    pub fn warn(&self, line: impl std::fmt::Display) {
        if !self.mute {
            eprintln!("warning: {line}");
        }
    }

    /// A fault in one line, on stderr.
    pub fn error(&self, error: &anyhow::Error) {
        let mut line = format!("{error:#}");
        if let Some(end) = line.find('\n') {
            line.truncate(end);
        }
        eprintln!("error: {line}");
    }

    /// The result: as one JSON object with `--json`, else as `summary`.
    pub fn result<T: Serialize>(&self, value: &T, summary: impl FnOnce() -> String) -> anyhow::Result<()> {
        use std::io::Write as _;

        if self.mute {
            return Ok(());
        }
        let text = if self.json { serde_json::to_string(value)? } else { summary() };
        // A closed pipe (`cnerf info x | head -1`) is the reader's choice, not a fault.
        if !text.is_empty() {
            let _ = writeln!(std::io::stdout(), "{text}");
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::one_line;

    #[test]
    fn a_mistake_is_told_in_one_line() {
        let message = "error: unexpected argument '--sedes' found\n\n  tip: a similar argument exists: '--seeds'\n\n\
                       Usage: cnerf generate --out <DIR>\n\nFor more information, try '--help'.\n";
        let expected =
            "error: unexpected argument '--sedes' found; tip: a similar argument exists: '--seeds'; try --help";
        assert_eq!(one_line(message), expected);
        let missing = "error: the following required arguments were not provided:\n  --out <DIR>\n\nUsage: cnerf\n";
        assert_eq!(
            one_line(missing),
            "error: the following required arguments were not provided: --out <DIR>; try --help"
        );
    }
}
