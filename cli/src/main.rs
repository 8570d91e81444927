//! `cnerf`: invert, edit and render portraits in 3D. Arguments, progress bars, files and exit codes; nothing is
//! computed here.

mod commands;
mod console;
mod interrupt;
mod options;
mod portraits;
mod views;

use std::process::ExitCode;

use clap::Parser as _;

/// Tensors of tens of megabytes come and go at every step; without a pooling allocator their page faults cost more
/// than the arithmetic on them.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    let arguments = match commands::Arguments::try_parse() {
        Ok(arguments) => arguments,
        Err(error) => return console::explain(&error),
    };
    if let Some(threads) = arguments.global.threads {
        // SAFETY: no other thread runs yet. candle's matrix products read their thread count here and nowhere else.
        unsafe { std::env::set_var("RAYON_NUM_THREADS", threads.to_string()) };
    }
    let console = console::Console::new(&arguments.global);
    match commands::run(arguments, &console) {
        Ok(outcome) => outcome.into(),
        Err(error) => {
            console.error(&error);
            ExitCode::from(2)
        }
    }
}
