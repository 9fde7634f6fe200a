//! `freerange data`

use std::path::PathBuf;

use freerange_data::{GenerateConfig, generate_shards, inspect};

use crate::{error::CliError, progress::Progress};

/// Make and look at training data.
#[derive(clap::Subcommand)]
pub enum Command {
    /// Make objects and write them as tar shards. Run the same command again to go on where it was stopped.
    Generate(Generate),
    /// Say what a folder of shards holds.
    Inspect(Inspect),
}

/// Arguments of `data generate`.
#[derive(clap::Args)]
pub struct Generate {
    /// Folder for the shards.
    #[arg(short, long)]
    output: PathBuf,
    /// Training configuration whose [data.object] and depths are used, such as configs/tiny.toml.
    #[arg(long)]
    config: PathBuf,
    /// Objects to make.
    #[arg(long, default_value_t = 1000)]
    objects: u64,
    /// Objects per shard.
    #[arg(long, default_value_t = 100)]
    objects_per_shard: u64,
    /// Seed of the first object.
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

/// Arguments of `data inspect`.
#[derive(clap::Args)]
pub struct Inspect {
    /// Folder of shards.
    folder: PathBuf,
    /// Write a contact sheet of the first objects to this PNG file.
    #[arg(long, value_name = "FILE")]
    sheet: Option<PathBuf>,
    /// Compare all checksums.
    #[arg(long)]
    verify: bool,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(command: &Command) -> Result<(), CliError> {
    match command {
        Command::Generate(args) => generate(args),
        Command::Inspect(args) => look(args),
    }
}
