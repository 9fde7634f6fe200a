//! `freerange data`

mod build;
mod estimate;
mod gallery;
mod inspect;
mod merge;
mod quality;
mod views;

use crate::error::CliError;

/// Build and inspect training data.
#[derive(clap::Subcommand)]
pub enum Command {
    /// Build shards of training objects from mesh files.
    ///
    /// Run the same command again to continue a stopped build.
    Build(build::Args),
    /// Build shards of generated training objects.
    Generate(build::GenerateArgs),
    /// Join the outputs of several builds and write the manifest once all shards are present.
    ///
    /// Processes that share one output need no merge: the last one writes the manifest.
    Merge(merge::Args),
    /// Print the contents of shards.
    Inspect(inspect::Args),
    /// Estimate the cost of many objects from a few.
    ///
    /// `freerange data estimate generated` measures generated objects.
    Estimate(estimate::Args),
    /// Compare fits of N Gaussians with slices of the level-of-detail tree and surface points, by held-out PSNR.
    Quality(quality::Args),
    /// Render posed images of a mesh, or of each mesh of a folder, for `reconstruct` and `eval`.
    ///
    /// The mesh is moved to the canonical frame: +z up, its box centered, within radius 0.5. With 20 views or more,
    /// transforms_full.json, transforms_partial.json and transforms_val.json name the view sets of `eval`.
    Views(views::Args),
    /// Draw a contact sheet of generated objects.
    Gallery(gallery::Args),
}

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
