//! `freerange render`

use std::path::PathBuf;

use freerange::pictures::{render_splats, render_surface};
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
    /// Also the depth of the surface: NAME_depth.npy, camera z in the file's units, float32; infinite where nothing is.
    #[arg(long)]
    depth: bool,
    /// Also its normals, NAME_normals.png: (n + 1) / 2, x right, y up, z toward the camera. Transparent where nothing is.
    #[arg(long)]
    normals: bool,
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
        eprintln!("{note}");
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
        if args.depth || args.normals {
            let (depth, normals) = render_surface(&splats, camera)?;
            if args.depth {
                output.write(&format!("{name}_depth.npy"), &npy(&depth, [camera.height, camera.width]))?;
            }
            if args.normals {
                output.picture(&format!("{name}_normals.png"), &picture_of(&normals, camera.width))?;
            }
        }
        bar.at(i as u64 + 1, name);
    }
    bar.finish();
    output.commit()?;
    println!("{} images in {}", cameras.len(), args.output.display());
    Ok(())
}

/// A float32 array as NumPy's format 1.0 has it
/// (<https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html>).
fn npy(values: &[f32], [rows, columns]: [u32; 2]) -> Vec<u8> {
    let mut header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({rows}, {columns}), }}");
    // Ten bytes before it, a line feed after it, in all a multiple of 64.
    let padding = (64 - (10 + header.len() + 1) % 64) % 64;
    header.extend(std::iter::repeat_n(' ', padding).chain(['\n']));
    let length = u16::try_from(header.len()).expect("a short header").to_le_bytes();
    let values = values.iter().flat_map(|v| v.to_le_bytes());
    b"\x93NUMPY\x01\x00".iter().copied().chain(length).chain(header.bytes()).chain(values).collect()
}

/// Normals in camera coordinates as a picture with y up and z toward the camera.
fn picture_of(normals: &[[f32; 3]], width: u32) -> image::RgbaImage {
    let byte = |v: f32| (255.0 * (0.5 + 0.5 * v)).round() as u8;
    let pixel = |&[x, y, z]: &[f32; 3]| match [x, y, z] {
        [0.0, 0.0, 0.0] => [0; 4],
        _ => [byte(x), byte(-y), byte(-z), 255],
    };
    let height = (normals.len() / width as usize) as u32;
    let bytes = normals.iter().flat_map(pixel).collect();
    image::RgbaImage::from_raw(width, height, bytes).expect("one normal per pixel")
}
