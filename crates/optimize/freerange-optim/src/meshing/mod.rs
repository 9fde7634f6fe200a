//! A triangle mesh of Gaussians: seen from all around, fused, and cut out where the surface is.
//!
//! Depths are rendered from cameras on a sphere about the object. A grid of voxels keeps the mean distance to the
//! surface along the line of sight, cut off at a few voxels ([`Volume`]). What no camera sees is the inside, so meshes
//! are closed. Marching cubes make triangles of it ([`iso_surface`]), of which edge collapses may leave fewer. Vertices,
//! or the texels of a texture, take their colors from the renders.

mod decimate;
mod fuse;
mod iso;
mod save;
mod shape;
mod texture;

use std::path::{Path, PathBuf};

use freerange_raster::RasterError;
use freerange_util::IoError;

pub use fuse::{MeshConfig, Volume, mesh_of};
pub use iso::iso_surface;
pub use save::{MeshFormat, save};
pub use shape::{Baked, Shape};

/// Why there is no mesh, or no file of it.
#[derive(Debug, thiserror::Error)]
pub enum SurfaceError {
    /// The operating system refused to write a file.
    #[error(transparent)]
    Io(#[from] IoError),
    /// The rasterizer refused the Gaussians.
    #[error(transparent)]
    Raster(#[from] RasterError),
    /// There is nothing to make a mesh of.
    #[error("Gaussians: expected a surface that is opaque from some side, found {found}")]
    Nothing {
        /// What there is.
        found: Box<str>,
    },
    /// A setting that makes no mesh.
    #[error("{setting}: expected {expected}, found {found}")]
    Setting {
        /// Its name.
        setting: &'static str,
        /// What it should be.
        expected: Box<str>,
        /// What was asked for.
        found: usize,
    },
    /// A file that holds no texture.
    #[error("{}: a texture: expected .glb, found .{format}", file.display())]
    NoTexture {
        /// The file.
        file: PathBuf,
        /// Its format.
        format: MeshFormat,
    },
    /// A texture could not be laid out.
    #[error("texture: {0}")]
    Atlas(#[from] uvunwrap::Error),
    /// A name whose extension is of no mesh format that is written.
    #[error("{}: extension: expected .glb, .ply or .obj, found {found}", file.display())]
    Unknown {
        /// The file.
        file: PathBuf,
        /// Its extension.
        found: Box<str>,
    },
}

impl SurfaceError {
    fn unknown(file: &Path) -> Self {
        let extension = file.extension().unwrap_or_default().to_string_lossy();
        let found = if extension.is_empty() { "none".into() } else { format!(".{extension}").into() };
        Self::Unknown { file: file.into(), found }
    }
}
