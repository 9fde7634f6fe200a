//! `freerange data gallery`

use std::path::PathBuf;

use freerange_data::build::{GalleryConfig, gallery};

use crate::{error::CliError, runtime::TrainConfig};

/// Arguments of `data gallery`.
#[derive(clap::Args)]
pub struct Args {
    /// PNG file to write.
    #[arg(short, long, default_value = "gallery.png")]
    output: PathBuf,
    /// Configuration whose generator and lighting are used: tiny, base, paper, or a file.
    #[arg(long, default_value = "tiny")]
    config: PathBuf,
    /// Number of objects.
    #[arg(long, default_value_t = 100)]
    objects: u32,
    /// Objects per row.
    #[arg(long, default_value_t = 10)]
    columns: u32,
    /// Width and height of each image in pixels.
    #[arg(long, default_value_t = 160)]
    tile: u32,
    /// Seed of the first object.
    #[arg(long, default_value_t = 0)]
    first_seed: u64,
}

pub fn run(args: &Args) -> Result<(), CliError> {
    let object = TrainConfig::load(&args.config)?.data.making.object;
    let config = GalleryConfig {
        objects: args.objects,
        columns: args.columns,
        tile: args.tile,
        first_seed: args.first_seed,
        generator: object.generator,
        lighting: object.lighting,
        ..GalleryConfig::default()
    };
    let sheet = gallery(&config)?;
    sheet.save(&args.output).map_err(|e| CliError::file(&args.output, e))?;
    println!("{} objects in {}", args.objects, args.output.display());
    Ok(())
}
