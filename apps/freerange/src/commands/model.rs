//! `freerange model`

use std::path::PathBuf;

use crate::{error::CliError, runtime};

/// Look at models.
#[derive(clap::Subcommand)]
pub enum Command {
    /// Shapes, parameters per part, arithmetic and memory of a configuration or a checkpoint; nothing is allocated.
    Info(Info),
}

/// Arguments of `model info`.
#[derive(clap::Args)]
pub struct Info {
    /// Training configuration (.toml) or checkpoint (.safetensors) [default: the shipped checkpoint].
    file: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(command: &Command) -> Result<(), CliError> {
    let Command::Info(args) = command;
    runtime::model_info(args.file.as_deref(), args.json)
}
