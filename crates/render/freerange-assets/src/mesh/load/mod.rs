//! Meshes from files: glTF 2.0, OBJ with MTL, PLY. Files are taken as hostile: every count, offset and size is checked
//! against the file and against [`LoadLimits`] before memory is taken for it.

mod accessor;
mod finish;
mod gltf;
mod gltf_material;
mod gltf_skin;
mod job;
mod normals;
mod obj;
mod obj_material;
mod obj_text;

mod picture;
mod ply;

use std::fs::File;
use std::io::Read;
use std::path::Path;

use glam::DAffine3;
use serde::{Deserialize, Serialize};

use crate::mesh::error::MeshError;
use crate::mesh::triangles::Mesh;
use job::Job;

/// What a file may cost, and how its axes are read. A file that asks for more is refused with a reason.
///
/// Memory stays below about 700 bytes per triangle, 20 bytes per texture pixel, 300 bytes per JSON item and three times
/// the file's own size, all together.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LoadLimits {
    /// Bytes of the mesh file and of all files that it refers to, together. Default 512 MiB.
    pub max_file_bytes: u64,
    /// Values, objects and arrays in the JSON of a glTF file. Default 2 million.
    pub max_json_items: usize,
    /// Vertices, instances of a glTF mesh counted one by one. Default 10 million.
    pub max_vertices: usize,
    /// Triangles, instances of a glTF mesh counted one by one. Default 5 million.
    pub max_triangles: usize,
    /// Pixels along a side of a texture. Default 8192.
    pub max_texture_side: u32,
    /// Pixels of all textures together. Default 128 Mi (eight of 4096 x 4096).
    pub max_texture_pixels: u64,
    /// The axis that points up in OBJ and PLY files. Default: +y for OBJ, +z for PLY. glTF is +y up by definition.
    pub up: Option<Up>,
}

impl Default for LoadLimits {
    fn default() -> Self {
        Self {
            max_file_bytes: 512 << 20,
            max_json_items: 2_000_000,
            max_vertices: 10_000_000,
            max_triangles: 5_000_000,
            max_texture_side: 8192,
            max_texture_pixels: 128 << 20,
            up: None,
        }
    }
}

/// The axis that points up in a file; the frame is right-handed in both cases.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Up {
    /// +y up; taken to +z up by (x, y, z) to (x, -z, y).
    Y,
    /// +z up.
    Z,
}

/// A format of mesh files.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MeshFormat {
    /// glTF 2.0, binary (`.glb`) or JSON (`.gltf`): told apart by their first bytes.
    Gltf,
    /// Wavefront OBJ with MTL.
    Obj,
    /// Stanford PLY, ascii or binary.
    Ply,
}

impl MeshFormat {
    /// The format that a file name's extension stands for, in any case; `None` for others.
    pub fn from_path(path: &Path) -> Option<Self> {
        match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
            "glb" | "gltf" => Some(Self::Gltf),
            "obj" => Some(Self::Obj),
            "ply" => Some(Self::Ply),
            _ => None,
        }
    }
}

/// A mesh from a file.
#[derive(Clone, Debug)]
pub struct Loaded {
    /// The mesh in the canonical frame: +z up, its bounding box centerd, its farthest vertex 0.5 from the origin.
    pub mesh: Mesh,
    /// What was ignored or repaired.
    pub notes: Vec<String>,
    /// The similarity from the file's frame (for glTF the frame of its scene) to the canonical one.
    pub canonical_from_file: DAffine3,
}

/// Loads a `.glb`, `.gltf`, `.obj` or `.ply` file and the files it refers to, which must lie in its folder or below.
///
/// Fails with the file, the field and the reason if the file is broken, exceeds `limits`, or holds no triangle with an
/// area; a missing texture is an error for glTF and a note for OBJ and PLY.
pub fn load_mesh(path: &Path, limits: &LoadLimits) -> Result<Loaded, MeshError> {
    let format = MeshFormat::from_path(path).ok_or_else(|| MeshError::File {
        path: path.into(),
        field: "file name".into(),
        expected: "an extension of .glb, .gltf, .obj or .ply".into(),
        found: path.extension().map_or("none".into(), |e| e.to_string_lossy().into_owned()),
    })?;
    let mut job = Job::new(path, path.parent(), limits);
    let bytes = job.read_file(path)?;
    load(job, format, &bytes)
}

/// Loads a mesh from memory. External files cannot be reached: where glTF refers to one, that is an error; where OBJ or
/// PLY does, a note. Errors as in [`load_mesh`], with the path `<memory>`.
pub fn load_mesh_bytes(format: MeshFormat, bytes: &[u8], limits: &LoadLimits) -> Result<Loaded, MeshError> {
    let mut job = Job::new(Path::new("<memory>"), None, limits);
    job.charge_bytes(Path::new("<memory>"), bytes.len() as u64)?;
    load(job, format, bytes)
}

fn load(mut job: Job, format: MeshFormat, bytes: &[u8]) -> Result<Loaded, MeshError> {
    let (soup, up) = match format {
        MeshFormat::Gltf => (gltf::read(&mut job, bytes)?, Up::Y),
        MeshFormat::Obj => (obj::read(&mut job, bytes)?, job.limits.up.unwrap_or(Up::Y)),
        MeshFormat::Ply => (ply::read(&mut job, bytes)?, job.limits.up.unwrap_or(Up::Z)),
    };
    finish::finish(job, soup, up)
}

/// Reads at most `limit` bytes; `Ok(None)` if there are more.
fn read_at_most(path: &Path, limit: u64) -> std::io::Result<Option<Vec<u8>>> {
    let file = File::open(path)?;
    if !file.metadata()?.is_file() {
        return Err(std::io::Error::new(std::io::ErrorKind::InvalidInput, "not a regular file"));
    }
    let mut bytes = Vec::new();
    file.take(limit.saturating_add(1)).read_to_end(&mut bytes)?;
    Ok((bytes.len() as u64 <= limit).then_some(bytes))
}
