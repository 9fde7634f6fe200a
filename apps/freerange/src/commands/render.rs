//! `freerange render`

use std::path::PathBuf;

use freerange::pictures::render_view;
use freerange_camera::{image_ops::to_picture, load_cameras};
use freerange_formats::{Frame, Loaded, read};
use freerange_splat::ply_origin;

use crate::{error::CliError, output::OutputFolder, progress::Progress};

/// Render Gaussians from given cameras: one PNG per frame, on white.
#[derive(clap::Args)]
pub struct Args {
    /// Gaussians: .ply, .splat, .spz, .sog, .glb, or .html that this program wrote.
    file: PathBuf,
    /// transforms.json, or the folder that holds it; images are not needed where it says `w` and `h`.
    #[arg(long, value_name = "TRANSFORMS.json")]
    cameras: PathBuf,
    /// Frame of the cameras: .glb and .spz, which have +y up, are turned into it; z-up, y-up or y-down.
    #[arg(long, default_value = "z-up")]
    frame: Frame,
    /// Where the pictures go.
    #[arg(short, long, default_value = "renders")]
    output: PathBuf,
}

pub fn run(args: &Args) -> Result<(), CliError> {
    let Loaded { cloud, notes } = read(&args.file, args.frame)?;
    for note in notes {
        eprintln!("note: {note}");
    }
    let mut cameras = load_cameras(&args.cameras)?;
    // Positions in the file may be relative to an origin.
    if let Some(origin) = ply_origin(&args.file)? {
        cameras.iter_mut().for_each(|(_, camera)| *camera = camera.relative_to(origin.into()));
    }
    let output = OutputFolder::create("render", &args.output)?;
    let mut bar = Progress::new("rendering", cameras.len() as u64);
    for (i, (name, camera)) in cameras.iter().enumerate() {
        let picture = to_picture(&render_view(&cloud, camera)?, camera.width, camera.height);
        let name = name.rsplit(['/', '\\']).next().unwrap_or("view");
        output.picture(&format!("{name}.png"), &picture)?;
        bar.at(i as u64 + 1, name);
    }
    bar.finish();
    output.commit()?;
    println!("{} pictures in {}", cameras.len(), args.output.display());
    Ok(())
}
