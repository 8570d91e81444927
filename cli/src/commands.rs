//! The commands. Each module holds a command's raw arguments, resolves them into settings, calls the libraries, and
//! reports.

mod bench;
mod convert;
mod dataset;
mod edit;
mod eval;
mod export;
mod generate;
mod info;
mod invert;
mod render;
mod shell;
mod synth;
mod train;
mod train_parser;

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
    /// Make procedural cartoon portraits with masks and cameras
    Synth(synth::SynthArguments),
    /// Check, align or import a dataset
    #[command(subcommand)]
    Dataset(dataset::DatasetCommand),
    /// Train a model
    Train(Box<train::TrainArguments>),
    /// Train the network that finds regions and head pose in photos
    TrainParser(train_parser::TrainParserArguments),
    /// Make random portraits
    Generate(generate::GenerateArguments),
    /// Turn photos into editable 3D portraits
    Invert(Box<invert::InvertArguments>),
    /// Change regions of a portrait: shape, texture or both
    Edit(edit::EditArguments),
    /// Render a portrait from several views
    Render(render::RenderArguments),
    /// Write a portrait's surface as a mesh
    Export(export::ExportArguments),
    /// Measure a model, or portraits, against held-out data
    #[command(subcommand)]
    Eval(eval::EvalCommand),
    /// Measure speed and exactness beside the plain path
    #[command(subcommand)]
    Bench(bench::BenchCommand),
    /// Read the authors' PyTorch checkpoints
    Convert(convert::ConvertArguments),
    /// Say what a model, portrait or dataset holds
    Info(info::InfoArguments),
    /// Print shell completions
    Completions(shell::CompletionsArguments),
    /// Print the manual page
    Man,
}

/// Runs the command the arguments name.
pub fn run(arguments: Arguments, console: &Console) -> anyhow::Result<Outcome> {
    let seed = arguments.global.seed;
    match arguments.command {
        Command::Synth(synth) => synth.run(seed.unwrap_or(0), console),
        Command::Dataset(dataset) => dataset.run(console),
        Command::Train(train) => train.run(seed, console),
        Command::TrainParser(train) => train.run(seed.unwrap_or(0), console),
        Command::Generate(generate) => generate.run(console),
        Command::Invert(invert) => invert.run(seed.unwrap_or(0), console),
        Command::Edit(edit) => edit.run(seed, console),
        Command::Render(render) => render.run(seed, console),
        Command::Export(export) => export.run(console),
        Command::Eval(eval) => eval.run(seed.unwrap_or(0), console),
        Command::Bench(bench) => bench.run(seed.unwrap_or(0), console),
        Command::Convert(convert) => convert.run(console),
        Command::Info(info) => info.run(console),
        Command::Completions(completions) => completions.run(),
        Command::Man => shell::man(),
    }
}
