//! A triangle mesh with its materials.

use glam::{Quat, Vec2, Vec3, Vec4};

use crate::mesh::error::MeshError;
use crate::mesh::material::{AlphaMode, Material};

/// A triangle mesh with materials. Vertices are split where the surface has an edge or a texture seam.
/// Triangles are counter-clockwise seen from outside.
#[derive(Clone, Debug, Default)]
pub struct Mesh {
    /// Vertex positions in the canonical frame, +z up. `[vertices]`
    pub positions: Vec<Vec3>,
    /// Unit shading normals, pointing outwards. `[vertices]`
    pub normals: Vec<Vec3>,
    /// Positions before the object's final rotation, in the same unit: where solid textures are evaluated. `[vertices]`
    pub rest: Vec<Vec3>,
    /// Surface coordinates: for pictures from files v runs down and (0, 0) is the upper left, for printed textures
    /// v runs up and (0, 0) is the lower left. `[vertices]`
    pub uvs: Vec<Vec2>,
    /// Linear colors and alphas, multiplied onto the base color; may be empty for none. `[vertices]` or `[]`
    pub colors: Vec<Vec4>,
    /// Vertex indices. `[triangles]`
    pub triangles: Vec<[u32; 3]>,
    /// Index into `materials`. `[triangles]`
    pub triangle_materials: Vec<u16>,
    /// The materials.
    pub materials: Vec<Material>,
    /// True if every part is a closed, opaque surface that faces outwards, as those of generated objects are. Other
    /// meshes may be open sheets, and are shaded and lit on both sides.
    pub solid: bool,
}

impl Mesh {
    /// Checks that the arrays fit together, indices are in range and all coordinates are finite.
    pub fn validate(&self) -> Result<(), MeshError> {
        let fail = |field, expected: String, found: String| Err(MeshError::Mesh { field, expected, found });
        let n = self.positions.len();
        if self.triangles.is_empty() {
            return fail("triangles", "at least one".into(), "none".into());
        }
        for (field, len) in [("normals", self.normals.len()), ("rest", self.rest.len()), ("uvs", self.uvs.len())] {
            if len != n {
                return fail(field, format!("{n} entries, one per position"), len.to_string());
            }
        }
        if self.triangle_materials.len() != self.triangles.len() {
            return fail(
                "triangle_materials",
                format!("{} entries, one per triangle", self.triangles.len()),
                self.triangle_materials.len().to_string(),
            );
        }
        if let Some(&i) = self.triangles.iter().flatten().find(|&&i| i as usize >= n) {
            return fail("triangles", format!("indices below {n}"), i.to_string());
        }
        if let Some(&m) = self.triangle_materials.iter().find(|&&m| usize::from(m) >= self.materials.len()) {
            return fail("triangle_materials", format!("indices below {}", self.materials.len()), m.to_string());
        }
        for (field, values) in [("positions", &self.positions), ("normals", &self.normals), ("rest", &self.rest)] {
            if let Some(v) = values.iter().find(|v| !v.is_finite()) {
                return fail(field, "finite numbers".into(), format!("{v}"));
            }
        }
        if let Some(v) = self.uvs.iter().find(|v| !v.is_finite()) {
            return fail("uvs", "finite numbers".into(), format!("{v}"));
        }
        if !self.colors.is_empty() && self.colors.len() != n {
            return fail("colors", format!("none, or {n} entries, one per position"), self.colors.len().to_string());
        }
        if let Some(v) = self.colors.iter().find(|v| !v.is_finite()) {
            return fail("colors", "finite numbers".into(), format!("{v}"));
        }
        Ok(())
    }

    /// Corner positions of triangle `i`.
    pub fn corners(&self, i: usize) -> [Vec3; 3] {
        self.triangles[i].map(|v| self.positions[v as usize])
    }

    /// Area of triangle `i`.
    pub fn area(&self, i: usize) -> f32 {
        let [a, b, c] = self.corners(i);
        0.5 * (b - a).cross(c - a).length()
    }

    /// How much of what lies behind a point of triangle `i` is hidden, within [0, 1]; `bary` weighs its second and third
    /// corner.
    pub fn opacity(&self, i: usize, bary: Vec2) -> f32 {
        let material = &self.materials[usize::from(self.triangle_materials[i])];
        if material.alpha == AlphaMode::Opaque {
            return 1.0;
        }
        let corners = self.triangles[i].map(|v| v as usize);
        let w = [1.0 - bary.x - bary.y, bary.x, bary.y];
        let rest = (0..3).map(|k| w[k] * self.rest[corners[k]]).sum();
        let uv = (0..3).map(|k| w[k] * self.uvs[corners[k]]).sum();
        material.opacity(material.rgba(rest, uv, self.tint(corners, w), 0.0).w)
    }

    /// The vertex color at a point given by its weights; white without vertex colors.
    pub fn tint(&self, corners: [usize; 3], weights: [f32; 3]) -> Vec4 {
        if self.colors.is_empty() {
            return Vec4::ONE;
        }
        (0..3).map(|k| weights[k] * self.colors[corners[k]]).sum()
    }

    /// Rotates about the origin; `rest` stays.
    pub fn rotate(&mut self, rotation: Quat) {
        for v in self.positions.iter_mut().chain(&mut self.normals) {
            *v = rotation * *v;
        }
    }

    /// Centers the bounding box at the origin and scales the farthest vertex to distance 0.5.
    pub fn normalize(&mut self) {
        let (lo, hi) = self
            .positions
            .iter()
            .fold((Vec3::splat(f32::MAX), Vec3::splat(f32::MIN)), |(lo, hi), &p| (lo.min(p), hi.max(p)));
        let center = 0.5 * (lo + hi);
        let radius = self.positions.iter().map(|&p| (p - center).length()).fold(1e-9, f32::max);
        // A hair less than 0.5, so that rounding cannot push a vertex out of the sphere.
        let scale = 0.499_999 / radius;
        for p in &mut self.positions {
            *p = (*p - center) * scale;
        }
    }
}
