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

/// Keeps memory that tensors have left for the next ones. By default mimalloc gives back to the system what was free for
/// a second, and the system clears every page of it anew: a third of an inversion's processor time.
fn keep_memory() {
    /// `mi_option_purge_delay`, milliseconds; -1 is never. The binding does not name it.
    const PURGE_DELAY: libmimalloc_sys::mi_option_t = 15;
    // SAFETY: sets a number inside the allocator; no other thread runs yet.
    unsafe { libmimalloc_sys::mi_option_set(PURGE_DELAY, -1) };
}

fn main() -> ExitCode {
    keep_memory();
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
