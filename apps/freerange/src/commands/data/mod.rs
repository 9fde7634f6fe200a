//! `freerange data`

mod build;
mod estimate;
mod gallery;
mod inspect;
mod merge;
mod quality;
mod views;

use crate::error::CliError;

/// Make and look at training data.
#[derive(clap::Subcommand)]
pub enum Command {
    /// Make training objects of mesh files and write them as shards. Run the same command again to go on where it was
    /// stopped.
    Build(build::Args),
    /// Make training objects from nothing and write them as shards.
    Generate(build::GenerateArgs),
    /// Join what several processes or machines have built.
    Merge(merge::Args),
    /// Say what shards hold.
    Inspect(inspect::Args),
    /// Say what building many objects will cost, from a few that are made.
    Estimate(estimate::Args),
    /// Compare fits, slices of the level-of-detail tree and points on the surface.
    Quality(quality::Args),
    /// Render a mesh: posed images as `reconstruct` takes them.
    Views(views::Args),
    /// Draw a contact sheet of generated objects.
    Gallery(gallery::Args),
}

/// Runs the command.
pub fn run(command: &Command) -> Result<(), CliError> {
    match command {
        Command::Build(args) => build::run(args),
        Command::Generate(args) => build::run_generate(args),
        Command::Merge(args) => merge::run(args),
        Command::Inspect(args) => inspect::run(args),
        Command::Estimate(args) => estimate::run(args),
        Command::Quality(args) => quality::run(args),
        Command::Views(args) => views::run(args),
        Command::Gallery(args) => gallery::run(args),
    }
}
