//! A mesh ready to be rendered: rays and baked light.

use glam::{Vec2, Vec3};

use crate::mesh::Mesh;
use crate::mesh::MeshError;
use crate::render::bake::{self, BakeConfig, bake};
use crate::render::lighting::Lighting;
use crate::render::refine::{orient, refine, simplify_alpha};
use crate::render::trace::Tracer;

/// Farther out, lengths that suit the canonical frame (radius 0.5) have no meaning.
const MAX_COORDINATE: f32 = 1e3;

/// A mesh ready to be rendered: ray queries and baked light.
pub struct Scene {
    pub(crate) mesh: Mesh,
    pub(crate) lighting: Lighting,
    pub(crate) tracer: Tracer,
    pub(crate) baked: bake::Baked,
    bounds: (Vec3, Vec3),
}

/// Where a ray meets the surface.
#[derive(Clone, Copy, Debug)]
pub struct Hit {
    /// Distance from the ray's origin in units of its direction's length.
    pub t: f32,
    /// Triangle index.
    pub triangle: u32,
    /// Weights of the triangle's second and third corner.
    pub bary: Vec2,
}

impl Scene {
    /// Builds the ray structure and bakes the light as finely as [`BakeConfig::default`] says. Fails on a malformed
    /// mesh.
    pub fn new(mesh: Mesh, lighting: &Lighting) -> Result<Self, MeshError> {
        Self::with_config(mesh, lighting, &BakeConfig::default())
    }

    /// Builds the ray structure and bakes the light. Unless it is [`Mesh::solid`], the mesh is changed first: triangles
    /// that turn their back to their vertex normals are turned over, and long edges are split. Fails on a malformed
    /// mesh, one with coordinates beyond 1000, or a malformed configuration.
    pub fn with_config(mut mesh: Mesh, lighting: &Lighting, config: &BakeConfig) -> Result<Self, MeshError> {
        mesh.validate()?;
        config.validate()?;
        if let Some(p) = mesh.positions.iter().find(|p| p.abs().max_element() > MAX_COORDINATE) {
            let expected = format!("coordinates within {MAX_COORDINATE} of the origin");
            return Err(MeshError::Mesh { field: "positions", expected, found: format!("{p}") });
        }
        if !mesh.solid {
            orient(&mut mesh);
            simplify_alpha(&mut mesh);
            refine(&mut mesh, config.max_edge, config.max_triangles);
        }
        let tracer = Tracer::new(&mesh);
        let baked = bake(&mesh, &tracer, lighting, config);
        let bounds = mesh
            .positions
            .iter()
            .fold((Vec3::splat(f32::MAX), Vec3::splat(f32::MIN)), |(lo, hi), &p| (lo.min(p), hi.max(p)));
        Ok(Self { mesh, lighting: *lighting, tracer, baked, bounds })
    }

    /// The mesh as it is rendered.
    pub fn mesh(&self) -> &Mesh {
        &self.mesh
    }

    /// The lighting it was baked with.
    pub fn lighting(&self) -> &Lighting {
        &self.lighting
    }

    /// Lower and upper corner of the bounding box.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        self.bounds
    }

    /// The first intersection of a ray with the surface, opaque or not.
    pub fn intersect(&self, origin: Vec3, direction: Vec3) -> Option<Hit> {
        self.intersect_beyond(origin, direction, 0.0)
    }

    pub(crate) fn intersect_beyond(&self, origin: Vec3, direction: Vec3, start: f32) -> Option<Hit> {
        let hit = self.tracer.closest(origin, direction, start)?;
        Some(Hit { t: hit.t, triangle: hit.triangle, bary: hit.bary })
    }

    /// True if nobody can see the triangle: it lies wholly inside another part of the object, or behind closed walls.
    pub fn is_buried(&self, triangle: usize) -> bool {
        self.mesh.triangles[triangle].iter().all(|&v| self.baked.hidden[v as usize])
    }
}
