//! `freerange render`

use std::path::PathBuf;

use freerange::pictures::render_splats;
use freerange_gaussians::RenderMode;
use freerange_gaussians::formats::{Format, Frames, Loaded, read};
use freerange_scene::camera::{image_ops::to_picture, load_cameras};

use crate::{error::CliError, output::OutputFolder, progress::Progress};

/// Render Gaussians from given cameras: one PNG per frame, on white.
///
/// Colors follow the viewing direction where the file has spherical harmonics (degree 0 to 3).
#[derive(clap::Args)]
pub struct Args {
    /// Gaussians: .ply, .splat, .spz, .sog (or its meta.json), .glb, .gltf, or .html that this program wrote.
    file: PathBuf,
    /// File transforms.json or its folder; images are not needed if it has `w` and `h`.
    #[arg(long, value_name = "TRANSFORMS.json")]
    cameras: PathBuf,
    /// Frame of the cameras: z-up, y-up or y-down. FROM:TO also sets that of the Gaussians.
    ///
    /// .glb and .spz have +y up and are turned to the cameras' frame. FROM overrides what a file says.
    #[arg(long, default_value = "z-up")]
    frame: Frames,
    /// Antialiasing: default (0.3 square pixels) or mip (0.1, with compensated opacities) [default: the file's].
    #[arg(long, value_name = "MODE", value_parser = parse_mode)]
    mode: Option<RenderMode>,
    /// Output folder.
    #[arg(short, long, default_value = "renders")]
    output: PathBuf,
}

fn parse_mode(text: &str) -> Result<RenderMode, String> {
    match text {
        "default" => Ok(RenderMode::Default),
        "mip" => Ok(RenderMode::Mip),
        _ => Err("expected default or mip".into()),
    }
}

pub fn run(args: &Args) -> Result<(), CliError> {
    let Loaded { splats, notes, .. } = read(&args.file, args.frame)?;
    for note in notes {
        eprintln!("note: {note}");
    }
    // Some writers of .spz mark all of their files.
    let told = if Format::of_input(&args.file)? == Format::Spz { RenderMode::Default } else { splats.mode };
    let mode = args.mode.unwrap_or(told);
    if args.mode.is_none() && splats.mode == RenderMode::Mip {
        eprintln!(
            "note: drawn in mode {}",
            if mode == RenderMode::Mip { "mip" } else { "default; --mode mip heeds the mark" }
        );
    }
    let cameras = load_cameras(&args.cameras)?;
    let output = OutputFolder::create("render", &args.output)?;
    let mut bar = Progress::new("rendering", cameras.len() as u64);
    for (i, (name, camera)) in cameras.iter().enumerate() {
        let picture = to_picture(&render_splats(&splats, camera, mode)?, camera.width, camera.height);
        let name = name.rsplit(['/', '\\']).next().unwrap_or("view");
        output.picture(&format!("{name}.png"), &picture)?;
        bar.at(i as u64 + 1, name);
    }
    bar.finish();
    output.commit()?;
    println!("{} images in {}", cameras.len(), args.output.display());
    Ok(())
}
