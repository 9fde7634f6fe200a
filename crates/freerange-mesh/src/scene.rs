use std::f32::consts::PI;

use glam::{Vec2, Vec3};

use crate::bake::{self, OFFSET, bake};
use crate::error::MeshError;
use crate::lighting::Lighting;
use crate::mesh::Mesh;
use crate::texture::Material;
use crate::trace::Tracer;

/// A mesh ready to be rendered: ray queries and baked light.
pub struct Scene {
    mesh: Mesh,
    lighting: Lighting,
    tracer: Tracer,
    baked: bake::Baked,
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

/// Everything about a surface point that shading needs.
pub(crate) struct Surface<'a> {
    pub position: Vec3,
    pub normal: Vec3,
    plane_normal: Vec3,
    albedo: Vec3,
    light: Vec3,
    material: &'a Material,
}

impl Scene {
    /// Builds the ray structure and bakes the light. Fails on a malformed mesh.
    pub fn new(mesh: Mesh, lighting: &Lighting) -> Result<Self, MeshError> {
        mesh.validate()?;
        let tracer = Tracer::new((0..mesh.triangles.len()).map(|i| mesh.corners(i)));
        let baked = bake(&mesh, &tracer, lighting);
        let bounds = mesh
            .positions
            .iter()
            .fold((Vec3::splat(f32::MAX), Vec3::splat(f32::MIN)), |(lo, hi), &p| (lo.min(p), hi.max(p)));
        Ok(Self { mesh, lighting: *lighting, tracer, baked, bounds })
    }

    /// The mesh.
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

    /// The first intersection of a ray with the surface.
    pub fn intersect(&self, origin: Vec3, direction: Vec3) -> Option<Hit> {
        let hit = self.tracer.closest(origin, direction, 0.0)?;
        Some(Hit { t: hit.t, triangle: hit.triangle, bary: hit.bary })
    }

    /// True if the triangle lies wholly inside another part of the object, so that nobody can see it.
    pub fn is_buried(&self, triangle: usize) -> bool {
        self.mesh.triangles[triangle].iter().all(|&v| self.baked.buried[v as usize])
    }

    /// The point of a triangle's plane that a ray meets, held within the triangle.
    pub(crate) fn surface_along(&self, triangle: usize, origin: Vec3, direction: Vec3) -> Surface<'_> {
        let [a, b, c] = self.mesh.corners(triangle);
        let (e1, e2) = (a - b, c - a);
        let det = e1.cross(e2).dot(direction);
        let r = direction.cross(a - origin);
        let safe = if det.abs() > 1e-20 { 1.0 / det } else { 0.0 };
        let u = (r.dot(e2) * safe).clamp(0.0, 1.0);
        let v = (r.dot(e1) * safe).clamp(0.0, 1.0 - u);
        self.surface(triangle, Vec2::new(u, v))
    }

    pub(crate) fn surface(&self, triangle: usize, bary: Vec2) -> Surface<'_> {
        let corners = self.mesh.triangles[triangle].map(|v| v as usize);
        let w = [1.0 - bary.x - bary.y, bary.x, bary.y];
        let mix = |values: &[Vec3]| w[0] * values[corners[0]] + w[1] * values[corners[1]] + w[2] * values[corners[2]];
        let uvs = &self.mesh.uvs;
        let uv = w[0] * uvs[corners[0]] + w[1] * uvs[corners[1]] + w[2] * uvs[corners[2]];
        let material = &self.mesh.materials[usize::from(self.mesh.triangle_materials[triangle])];
        let plane_normal = Tracer::plane_normal(self.mesh.corners(triangle));
        Surface {
            position: mix(&self.mesh.positions),
            normal: mix(&self.mesh.normals).try_normalize().unwrap_or(plane_normal),
            plane_normal,
            albedo: material.albedo(mix(&self.mesh.rest), uv),
            light: mix(&self.baked.light),
            material,
        }
    }

    /// Cosine of the sun on the surface times its visibility.
    fn sun_cosine(&self, s: &Surface) -> f32 {
        let l = self.lighting.sun_direction;
        let cos = s.normal.dot(l);
        if self.lighting.sun <= 0.0
            || cos <= 0.0
            || s.plane_normal.dot(l) <= 0.0
            || self.tracer.occluded(s.position + OFFSET * s.plane_normal, l, 0.0)
        {
            return 0.0;
        }
        cos
    }

    /// Linear radiance averaged over viewing directions: diffuse light and the mean of the reflection.
    pub(crate) fn diffuse_radiance(&self, s: &Surface) -> Vec3 {
        let m = s.material;
        let sun = self.lighting.sun * self.sun_cosine(s) / PI;
        let body = s.albedo * (s.light + Vec3::splat(sun));
        // The reflection sees roughly what the surface itself sees.
        body * (1.0 - m.metallic) * (1.0 - m.specular) + s.light * (m.specular * (1.0 - m.metallic)) + body * m.metallic
    }

    /// Linear radiance towards a viewer in the unit direction `to_eye`.
    pub(crate) fn radiance(&self, s: &Surface, to_eye: Vec3) -> Vec3 {
        let m = s.material;
        if m.specular == 0.0 && m.metallic == 0.0 {
            return self.diffuse_radiance(s);
        }
        let cos_sun = self.sun_cosine(s);
        let sun = self.lighting.sun * cos_sun / PI;
        let cos_eye = s.normal.dot(to_eye).clamp(0.02, 1.0);
        let f0 = Vec3::splat(m.specular).lerp(s.albedo, m.metallic);
        // Rough surfaces lose most of the grazing reflection.
        let grazing = (1.0 - cos_eye).powi(5) * (1.0 - m.roughness).powi(2);
        let fresnel = f0 + (Vec3::ONE - f0).max(Vec3::ZERO) * grazing;
        let mut color = s.albedo * (1.0 - m.metallic) * (Vec3::ONE - fresnel) * (s.light + Vec3::splat(sun));
        color += fresnel * s.light;
        if cos_sun > 0.0 {
            let half = (to_eye + self.lighting.sun_direction).normalize_or_zero();
            let a2 = m.roughness.max(0.12).powi(4);
            let n_h = s.normal.dot(half).max(0.0);
            let d = a2 / (PI * (n_h * n_h * (a2 - 1.0) + 1.0).powi(2));
            let h_v = half.dot(to_eye).max(0.05);
            // Visibility term of Schlick-Smith in its simplest form: 1 / (4 max(h.v, ..)^2).
            color += fresnel * (self.lighting.sun * cos_sun * d / (4.0 * h_v * h_v).max(0.5));
        }
        color
    }
}
