//! `freerange convert`

use std::path::{Path, PathBuf};

use freerange_gaussians::Splats;
use freerange_gaussians::formats::{Format, Frame, Frames, SpzVersion, WriteOptions, read, write};
use freerange_optim::meshing::{MeshConfig, MeshFormat, mesh_of, save};
use glam::{DQuat, DVec3};

use crate::{error::CliError, progress::Waiting};

/// Convert Gaussians between formats, by the extensions of the files; merge, crop, clean and scale them.
///
/// .glb and .spz have +y up by definition; --frame names the frame of the others. Gaussians are turned only where two files
/// differ. An .html is a page that shows the Gaussians in any browser, offline. Compressed .ply (SuperSplat), .sog folders
/// (meta.json) and .gltf can be read as well. Several inputs are merged. Order: turn, merge, --box, --sphere,
/// --remove-floaters, --measure.
///
/// --mesh renders depths from all around and fuses them; what no camera sees counts as inside.
#[derive(clap::Args)]
#[command(override_usage = "freerange convert [OPTIONS] <INPUT>... <OUTPUT>")]
pub struct Args {
    /// One or more files to read (INPUT), then the file to write (OUTPUT).
    #[arg(value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Frame of formats that define none: z-up (this program), y-up or y-down [default: z-up, or what a .ply says].
    ///
    /// Most programs that train on COLMAP's cameras are y-down. FROM:TO turns from the frame of the input to that of
    /// the output. FROM overrides what a format says; many .spz are y-down.
    #[arg(long, value_name = "FRAME")]
    frame: Option<Frames>,
    /// Version of .spz to write: 3, 4 (newer readers) or 2 (oldest readers, rotations off by up to 10 degrees) [default: 3].
    #[arg(long, value_name = "VERSION")]
    spz_version: Option<SpzVersion>,
    /// Keep only Gaussians whose centers lie between two corners: X,Y,Z:X,Y,Z, in the written frame.
    #[arg(long, value_name = "CORNER:CORNER", value_parser = parse_box, allow_hyphen_values = true)]
    r#box: Option<(DVec3, DVec3)>,
    /// Keep only Gaussians whose centers lie in a sphere: X,Y,Z:RADIUS.
    #[arg(long, value_name = "CENTER:RADIUS", value_parser = parse_sphere, allow_hyphen_values = true)]
    sphere: Option<(DVec3, f64)>,
    /// Remove small groups of Gaussians that are apart from the object.
    #[arg(long)]
    remove_floaters: bool,
    /// Scale about the origin so that two points are LENGTH apart: X,Y,Z:X,Y,Z=LENGTH.
    #[arg(long, value_name = "A:B=LENGTH", value_parser = parse_measure, allow_hyphen_values = true)]
    measure: Option<f64>,
    /// Write a closed triangle mesh of the surface, with vertex colors or a texture: .glb, .ply or .obj.
    #[arg(long)]
    mesh: bool,
    /// Voxels along the longest side of the mesh's volume.
    #[arg(long, value_name = "COUNT", default_value_t = MeshConfig::default().voxels, requires = "mesh")]
    voxels: usize,
    /// Most triangles of the mesh [default: no limit; 20,000 with --texture].
    #[arg(long, value_name = "COUNT", requires = "mesh")]
    triangles: Option<usize>,
    /// Width of a texture instead of vertex colors: 64 to 4096, .glb only.
    #[arg(long, value_name = "TEXELS", requires = "mesh")]
    texture: Option<usize>,
}

fn parse_point(text: &str) -> Result<DVec3, String> {
    let wrong = || format!("expected a point X,Y,Z, found {text:?}");
    let numbers: Vec<f64> = text.split(',').map(|v| v.trim().parse()).collect::<Result<_, _>>().map_err(|_| wrong())?;
    let point = DVec3::from_array(numbers.try_into().map_err(|_| wrong())?);
    if point.is_finite() { Ok(point) } else { Err(wrong()) }
}

fn parse_box(text: &str) -> Result<(DVec3, DVec3), String> {
    let (a, b) = text.split_once(':').ok_or("expected two corners X,Y,Z:X,Y,Z")?;
    Ok((parse_point(a)?, parse_point(b)?))
}

fn parse_sphere(text: &str) -> Result<(DVec3, f64), String> {
    let (center, radius) = text.split_once(':').ok_or("expected a center and a radius, X,Y,Z:RADIUS")?;
    Ok((parse_point(center)?, parse_length(radius)?))
}

/// The factor that makes two points so far apart.
fn parse_measure(text: &str) -> Result<f64, String> {
    let (points, length) = text.split_once('=').ok_or("expected two points and their distance, X,Y,Z:X,Y,Z=LENGTH")?;
    let (a, b) = parse_box(points)?;
    let factor = parse_length(length)? / a.distance(b);
    if factor.is_normal() { Ok(factor) } else { Err(format!("expected two different points, found {points:?}")) }
}

fn parse_length(text: &str) -> Result<f64, String> {
    let length = text.trim().parse().ok().filter(|v: &f64| v.is_normal() && *v > 0.0);
    length.ok_or_else(|| format!("expected a length above 0, found {text:?}"))
}

pub fn run(args: &Args) -> Result<(), CliError> {
    let (inputs, output) = places(&args.files)?;
    // Before anything is read.
    if args.mesh {
        MeshFormat::with_texture(output, args.texture.is_some())?;
    } else {
        Format::of(output).map_err(|e| CliError::input(format!("{e}; --mesh writes .glb, .ply or .obj")))?;
    }
    if args.spz_version.is_some() && (args.mesh || Format::of(output).ok() != Some(Format::Spz)) {
        let text = format!("--spz-version: expected an .spz file to write, found {}", output.display());
        return Err(CliError::input(text));
    }
    let (mut splats, frame) = merged(inputs, args.frame.unwrap_or_default())?;
    if let Some((a, b)) = args.r#box {
        splats = kept(&splats, &splats.within_box(a, b), "in the box")?;
    }
    if let Some((center, radius)) = args.sphere {
        splats = kept(&splats, &splats.within_sphere(center, radius), "in the sphere")?;
    }
    if args.remove_floaters {
        splats = kept(&splats, &splats.without_floaters(), "no floaters")?;
    }
    if let Some(factor) = args.measure {
        splats.transform(factor, DQuat::IDENTITY, DVec3::ZERO);
        eprintln!("note: scaled by {factor}");
    }
    if args.mesh {
        return mesh(args, &splats, output, frame);
    }
    let notes = write(&splats, output, &WriteOptions { frame, spz_version: args.spz_version.unwrap_or_default() })?;
    notes.iter().for_each(|note| eprintln!("note: {note}"));
    println!("{} ({} Gaussians)", output.display(), splats.cloud.len());
    Ok(())
}

/// The files to read, and the one to write.
fn places(files: &[PathBuf]) -> Result<(&[PathBuf], &Path), CliError> {
    match files.split_last() {
        Some((output, inputs)) if !inputs.is_empty() => Ok((inputs, output.as_path())),
        other => {
            let found = other.map_or("none".into(), |(file, _)| format!("{} alone", file.display()));
            let expected = "expected files to read, then the file to write";
            Err(CliError::input(format!("<INPUT>... <OUTPUT>: {expected}, found {found}")))
        }
    }
}

/// Triangles of a mesh above which a note says how to get fewer.
const MANY: usize = 100_000;

/// Writes a mesh of the Gaussians.
fn mesh(args: &Args, splats: &Splats, output: &Path, frame: Frame) -> Result<(), CliError> {
    let Args { voxels, triangles, texture, .. } = *args;
    let slow = triangles.is_some() || texture.is_some();
    let waiting = Waiting::new("meshing", if slow { "takes a minute or more" } else { "takes some seconds" });
    let shape = mesh_of(splats, &MeshConfig { voxels, triangles, texture, ..MeshConfig::default() })?;
    drop(waiting);
    save(&shape, output, frame.to(Frame::Y_UP))?;
    many(shape.triangles.len(), triangles).iter().for_each(|note| eprintln!("note: {note}"));
    println!("{} ({} triangles)", output.display(), shape.triangles.len());
    Ok(())
}

/// The note on a large mesh, if no number of triangles was `asked` for.
fn many(found: usize, asked: Option<usize>) -> Option<String> {
    (found > MANY && asked.is_none()).then(|| format!("{found} triangles; --triangles N makes fewer"))
}

/// All Gaussians of the files, in one frame.
fn merged(inputs: &[PathBuf], mut frames: Frames) -> Result<(Splats, Frame), CliError> {
    let mut all: Option<(Splats, Frame)> = None;
    for input in inputs {
        let loaded = read(input, frames)?;
        let of = if inputs.len() > 1 { format!("{}: ", input.display()) } else { String::new() };
        loaded.notes.iter().for_each(|note| eprintln!("note: {of}{}", note.text));
        match &mut all {
            None => all = Some((loaded.splats, loaded.frame)),
            Some((splats, _)) => splats.append(&loaded.splats),
        }
        frames.to = Some(loaded.frame); // the first file's is that of all
    }
    all.ok_or_else(|| CliError::file(Path::new(""), "expected a file to read"))
}

fn kept(splats: &Splats, indices: &[usize], which: &str) -> Result<Splats, CliError> {
    let (all, found) = (splats.cloud.len(), indices.len());
    if found == 0 {
        return Err(CliError::input(format!("expected Gaussians {which}, found none of {all}")));
    }
    eprintln!("note: {found} of {all} Gaussians are {which}, {} are left out", all - found);
    Ok(splats.select(indices))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_large_mesh_has_a_note() {
        assert_eq!(many(263_304, None).as_deref(), Some("263304 triangles; --triangles N makes fewer"));
        assert_eq!((many(100_000, None), many(263_304, Some(300_000))), (None, None));
    }
}
