//! What all loaders share: the budget, the notes, files beside the mesh, and the mesh under construction.

use std::path::{Component, Path, PathBuf};

use base64::Engine;
use glam::{DVec3, Vec2, Vec3, Vec4};

use super::{LoadLimits, read_at_most};
use freerange_util::IoError;

use crate::mesh::error::MeshError;
use crate::mesh::material::Material;

/// Notes beyond this many are dropped: a file must not fill the memory with them.
const MAX_NOTES: usize = 64;

/// One file being loaded.
pub struct Job<'a> {
    pub path: PathBuf,
    /// Where external files may lie; `None` for a mesh in memory.
    folder: Option<PathBuf>,
    pub limits: &'a LoadLimits,
    bytes_left: u64,
    pixels_left: u64,
    primitives_left: usize,
    pub notes: Vec<String>,
}

impl<'a> Job<'a> {
    pub fn new(path: &Path, folder: Option<&Path>, limits: &'a LoadLimits) -> Self {
        Self {
            path: path.into(),
            folder: folder.map(Into::into),
            limits,
            bytes_left: limits.max_file_bytes,
            pixels_left: limits.max_texture_pixels,
            primitives_left: limits.max_triangles,
            notes: Vec::new(),
        }
    }

    /// An error at `field` of the mesh file.
    pub fn error(
        &self,
        field: impl Into<String>,
        expected: impl Into<String>,
        found: impl std::fmt::Display,
    ) -> MeshError {
        MeshError::File {
            path: self.path.clone(),
            field: field.into(),
            expected: expected.into(),
            found: shorten(&found.to_string()),
        }
    }

    pub fn unsupported(&self, what: impl Into<String>) -> MeshError {
        MeshError::Unsupported { path: self.path.clone(), what: what.into() }
    }

    /// Adds a note unless it is there already.
    pub fn note(&mut self, note: impl Into<String>) {
        let note = shorten(&note.into());
        if self.notes.len() < MAX_NOTES && !self.notes.contains(&note) {
            self.notes.push(note);
        }
    }

    /// Takes `bytes` from the budget.
    pub fn charge_bytes(&mut self, path: &Path, bytes: u64) -> Result<(), MeshError> {
        self.bytes_left = self.bytes_left.checked_sub(bytes).ok_or_else(|| self.too_big(path))?;
        Ok(())
    }

    fn too_big(&self, path: &Path) -> MeshError {
        MeshError::File {
            path: path.into(),
            field: "size".into(),
            expected: format!("at most {} bytes with all the files it refers to", self.limits.max_file_bytes),
            found: "more".into(),
        }
    }

    /// Takes the pixels of a texture from the budget, before it is decoded.
    pub fn charge_pixels(&mut self, name: &str, [width, height]: [u32; 2]) -> Result<(), MeshError> {
        let side = self.limits.max_texture_side;
        if width == 0 || height == 0 || width > side || height > side {
            return Err(self.error(
                name,
                format!("a texture of 1 to {side} pixels a side (max_texture_side)"),
                format!("{width} x {height}"),
            ));
        }
        self.pixels_left = self.pixels_left.checked_sub(u64::from(width) * u64::from(height)).ok_or_else(|| {
            let most = self.limits.max_texture_pixels;
            self.error(name, format!("textures of at most {most} pixels together (max_texture_pixels)"), "more")
        })?;
        Ok(())
    }

    /// Counts a primitive: many instances of an empty one take time, though no memory.
    pub fn charge_primitive(&mut self) -> Result<(), MeshError> {
        let most = self.limits.max_triangles;
        self.primitives_left = self
            .primitives_left
            .checked_sub(1)
            .ok_or_else(|| self.error("primitives", format!("at most {most} (max_triangles)"), "more"))?;
        Ok(())
    }

    /// Reads a file within the budget.
    pub fn read_file(&mut self, path: &Path) -> Result<Vec<u8>, MeshError> {
        let bytes =
            read_at_most(path, self.bytes_left).map_err(IoError::at(path))?.ok_or_else(|| self.too_big(path))?;
        self.charge_bytes(path, bytes.len() as u64)?;
        Ok(bytes)
    }

    /// Where a relative reference leads, if it stays inside the mesh's folder. Symbolic links in there are followed:
    /// they were made by the folder's owner, not by the file.
    pub fn resolve(&self, field: &str, reference: &str) -> Result<PathBuf, MeshError> {
        let Some(folder) = &self.folder else {
            return Err(self.error(field, "no external file for a mesh in memory", reference));
        };
        let mut depth = 0usize;
        for part in Path::new(reference).components() {
            depth = match part {
                Component::Normal(_) => depth + 1,
                Component::CurDir => depth,
                Component::ParentDir if depth > 0 => depth - 1,
                _ => return Err(self.error(field, "a relative path inside the mesh's folder", reference)),
            };
        }
        if depth == 0 || reference.contains('\0') {
            return Err(self.error(field, "a relative path inside the mesh's folder", reference));
        }
        Ok(folder.join(reference))
    }

    /// The bytes behind a URI: a data URI, or a percent-encoded relative path.
    pub fn read_uri(&mut self, field: &str, uri: &str) -> Result<Vec<u8>, MeshError> {
        if let Some(data) = uri.strip_prefix("data:") {
            let Some((_, text)) = data.split_once(";base64,") else {
                return Err(self.error(field, "a base64 data URI", uri));
            };
            // Some writers leave out the padding.
            let engine = base64::engine::GeneralPurpose::new(
                &base64::alphabet::STANDARD,
                base64::engine::GeneralPurposeConfig::new()
                    .with_decode_padding_mode(base64::engine::DecodePaddingMode::Indifferent)
                    .with_decode_allow_trailing_bits(true),
            );
            return engine.decode(text.trim()).map_err(|e| self.error(field, "valid base64", e));
        }
        let decoded = percent_encoding::percent_decode_str(uri).decode_utf8_lossy().into_owned();
        // A scheme makes the first component contain a colon; such a name is not portable as a file either.
        if decoded.split('/').next().is_some_and(|first| first.contains(':')) {
            return Err(self.error(field, "a data URI or a relative path inside the mesh's folder", uri));
        }
        let path = self.resolve(field, &decoded)?;
        self.read_file(&path)
    }
}

/// Cuts a text from a file to a length that suits a message.
fn shorten(text: &str) -> String {
    match text.char_indices().nth(200) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text.into(),
    }
}

/// The mesh under construction, in the file's frame.
#[derive(Default)]
pub struct Soup {
    pub positions: Vec<DVec3>,
    /// Zero where the file has none. `[vertices]`
    pub normals: Vec<Vec3>,
    pub uvs: Vec<Vec2>,
    /// Linear RGBA. `[vertices]`
    pub colors: Vec<Vec4>,
    pub triangles: Vec<[u32; 3]>,
    pub triangle_materials: Vec<u16>,
    pub materials: Vec<Material>,
}

impl Soup {
    /// Fails if `vertices` and `triangles` more would exceed the limits.
    pub fn check_room(&self, job: &Job, field: &str, vertices: u64, triangles: u64) -> Result<(), MeshError> {
        // Indices are 32 bits, and splitting at creases can take three vertices per triangle.
        let most_vertices = job.limits.max_vertices.min(1 << 30) as u64;
        let most_triangles = job.limits.max_triangles.min(1 << 30) as u64;
        if vertices > most_vertices.saturating_sub(self.positions.len() as u64) {
            return Err(job.error(field, format!("at most {most_vertices} vertices (max_vertices)"), vertices));
        }
        if triangles > most_triangles.saturating_sub(self.triangles.len() as u64) {
            return Err(job.error(field, format!("at most {most_triangles} triangles (max_triangles)"), triangles));
        }
        Ok(())
    }

    /// Adds a vertex and returns its index. Broken normals, texture coordinates and colors become neutral; positions
    /// are checked at the end, where it is known which ones are used.
    pub fn vertex(&mut self, position: DVec3, normal: Vec3, uv: Vec2, color: Vec4) -> u32 {
        self.positions.push(position);
        self.normals.push(normal.try_normalize().unwrap_or(Vec3::ZERO));
        self.uvs.push(if uv.is_finite() { uv } else { Vec2::ZERO });
        self.colors.push(if color.is_finite() { color.clamp(Vec4::ZERO, Vec4::ONE) } else { Vec4::ONE });
        (self.positions.len() - 1) as u32
    }

    pub fn triangle(&mut self, corners: [u32; 3], material: u16) {
        self.triangles.push(corners);
        self.triangle_materials.push(material);
    }

    /// Adds a material and returns its index.
    pub fn material(&mut self, job: &Job, material: Material) -> Result<u16, MeshError> {
        let index = u16::try_from(self.materials.len())
            .map_err(|_| job.error("materials", "at most 65536", self.materials.len() + 1))?;
        self.materials.push(material);
        Ok(index)
    }
}
