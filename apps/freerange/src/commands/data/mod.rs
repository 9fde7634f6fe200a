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
    /// Join what several processes or machines have built: writes the manifest once all shards are there.
    ///
    /// Processes that share one output need no merge: whoever finishes last writes the manifest.
    Merge(merge::Args),
    /// Say what shards hold.
    Inspect(inspect::Args),
    /// Say what building many objects will cost, from a few that are made.
    ///
    /// `freerange data estimate generated` measures generated objects.
    Estimate(estimate::Args),
    /// Compare fits of N Gaussians, slices of N from the level-of-detail tree of a larger fit, and points on the surface: PSNR
    /// in dB on held-out views.
    Quality(quality::Args),
    /// Render a mesh, or each mesh of a folder: posed images as `reconstruct` takes them.
    ///
    /// The mesh is taken to the canonical frame first: +z up, its box centred, within radius 0.5. Where there are enough
    /// views (20 by default), transforms_full.json, transforms_partial.json and transforms_val.json name those that `eval` uses.
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
