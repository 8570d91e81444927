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

/// The terminal, as quiet or talkative as asked.
pub struct Console {
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
        Self { quiet: options.quiet, json: options.json, progress: !options.quiet && !options.no_progress }
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

    /// A warning, on stderr even when quiet.
    pub fn warn(&self, line: impl std::fmt::Display) {
        eprintln!("warning: {line}");
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
        let text = if self.json { serde_json::to_string(value)? } else { summary() };
        // A closed pipe (`cnerf info x | head -1`) is the reader's choice, not a fault.
        let _ = writeln!(std::io::stdout(), "{text}");
        Ok(())
    }
}
