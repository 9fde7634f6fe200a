//! What results are written as, besides `gaussians.ply`.

use freerange::{Gaussians, View};
use freerange_gaussians::Splats;
use freerange_gaussians::formats::{Format, Frame, WriteOptions};
use freerange_optim::meshing::{MeshConfig, MeshFormat, mesh_of, save};
use freerange_scene::write_colmap;
use freerange_util::Note;

use crate::{error::CliError, output::OutputFolder, progress::Waiting};

/// What results are written as.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Written {
    /// A file of Gaussians.
    Gaussians(Format),
    /// COLMAP's sparse model.
    Colmap,
    /// A triangle mesh.
    Mesh(MeshFormat),
}

/// The name of a format.
pub fn parse_written(text: &str) -> Result<Written, String> {
    match text {
        "colmap" => Ok(Written::Colmap),
        "mesh.glb" => Ok(Written::Mesh(MeshFormat::Glb)),
        "mesh.ply" => Ok(Written::Mesh(MeshFormat::Ply)),
        "mesh.obj" => Ok(Written::Mesh(MeshFormat::Obj)),
        other => other
            .parse()
            .map(Written::Gaussians)
            .map_err(|expected: String| format!("{expected}, colmap, mesh.glb, mesh.ply, mesh.obj")),
    }
}

impl std::fmt::Display for Written {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Gaussians(format) => format.fmt(f),
            Self::Colmap => f.write_str("colmap"),
            Self::Mesh(format) => write!(f, "mesh.{format}"),
        }
    }
}

/// Opacity below which a Gaussian is no point of the surface.
const FAINT: f64 = 0.1;

/// Gaussians as points: middles and colors.
fn points(cloud: &Gaussians) -> Vec<(glam::DVec3, [u8; 3])> {
    let byte = |v: f64| (255.0 * v.clamp(0.0, 1.0)).round() as u8;
    let solid = (0..cloud.len()).filter(|i| cloud.opacity(*i) >= FAINT);
    solid.map(|i| (cloud.mean(i), cloud.color(i).to_array().map(byte))).collect()
}

/// Where the files of a sample go.
pub struct Place<'a> {
    pub output: &'a OutputFolder,
    /// Of their names.
    pub suffix: &'a str,
    /// In which the Gaussians are.
    pub frame: Frame,
    /// What was subtracted from all positions.
    pub origin: [f64; 3],
}

impl Place<'_> {
    /// Writes a sample in these formats; what was left out.
    pub fn write(&self, splats: &Splats, formats: &[Written], inputs: &[View]) -> Result<Vec<Note>, CliError> {
        let Self { output, suffix, frame, origin } = *self;
        let mut notes = Vec::new();
        let mut mesh = None; // one for all of its formats
        for format in formats {
            let format = match format {
                Written::Mesh(format) => {
                    let name = format!("mesh{suffix}.{format}");
                    let made = || {
                        let _waiting = Waiting::new("meshing", "takes some seconds");
                        mesh_of(splats, &MeshConfig::default())
                    };
                    match mesh.get_or_insert_with(made) {
                        Ok(mesh) => save(mesh, &output.path(&name)?, frame.to(Frame::Y_UP))?,
                        // The Gaussians are there all the same.
                        Err(e) => notes.push(Note::dropped(format!("{name}: {e}"))),
                    }
                    continue;
                }
                Written::Gaussians(Format::Ply) => continue,
                Written::Gaussians(format) => format,
                Written::Colmap => {
                    let folder = output.path(&format!("colmap{suffix}/sparse"))?;
                    let folder = folder.parent().unwrap_or(&folder);
                    write_colmap(folder, inputs, origin.into(), &points(&splats.cloud))?;
                    continue;
                }
            };
            let name = if *format == Format::Html { "view" } else { "gaussians" };
            let options = WriteOptions { frame, ..WriteOptions::default() };
            let path = output.path(&format!("{name}{suffix}.{format}"))?;
            let lost = freerange_gaussians::formats::write(splats, &path, &options)?;
            notes.extend(lost.into_iter().map(|note| Note::dropped(format!("{name}{suffix}.{format}: {note}"))));
        }
        Ok(notes)
    }
}
