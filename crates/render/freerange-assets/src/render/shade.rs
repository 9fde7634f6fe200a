//! The color of surface points: their material under the baked light and the sun.

use std::f32::consts::PI;

use glam::{Vec2, Vec3, Vec4};

use crate::mesh::Map;
use crate::mesh::Material;
use crate::mesh::Mesh;
use crate::render::bake::OFFSET;
use crate::render::reflect::Reflection;
use crate::render::scene::Scene;

/// Light that is left when the rest of a ray no longer matters.
const FAINT: f32 = 1e-3;

/// Surfaces that a ray looks through at most.
const MAX_LAYERS: usize = 100;

/// Everything about a surface point that shading needs, seen from one side.
pub(crate) struct Surface<'a> {
    pub position: Vec3,
    /// Shading normal on the side that is looked at.
    pub normal: Vec3,
    plane_normal: Vec3,
    albedo: Vec3,
    opacity: f32,
    emission: Vec3,
    roughness: f32,
    metallic: f32,
    /// Diffuse light without the sun.
    light: Vec3,
    material: &'a Material,
}

/// Position and surface coordinates along a triangle's edges from its first corner.
struct Edges {
    positions: [Vec3; 2],
    uvs: [Vec2; 2],
}

impl Edges {
    fn new(mesh: &Mesh, [a, b, c]: [usize; 3]) -> Self {
        let (p, uv) = (&mesh.positions, &mesh.uvs);
        Self { positions: [p[b] - p[a], p[c] - p[a]], uvs: [uv[b] - uv[a], uv[c] - uv[a]] }
    }

    /// Length in (u, v) per unit of length, the same in all directions.
    fn uv_per_unit(&self) -> f32 {
        let area = self.positions[0].cross(self.positions[1]).length();
        (self.uvs[0].perp_dot(self.uvs[1]).abs() / area.max(1e-20)).sqrt()
    }

    /// Unit vectors along the picture's x and upwards in it, at right angles to `normal`; none where the coordinates do
    /// not span the triangle.
    fn tangents(&self, map: &Map, normal: Vec3) -> Option<[Vec3; 2]> {
        let [p, q] = self.uvs.map(|uv| map.transform.transform_vector2(uv));
        let det = p.perp_dot(q);
        let along_u = (self.positions[0] * q.y - self.positions[1] * p.y) * det.signum();
        let up = (self.positions[0] * q.x - self.positions[1] * p.x) * det.signum();
        let x = (along_u - normal * normal.dot(along_u)).try_normalize().filter(|_| det != 0.0)?;
        let y = normal.cross(x);
        Some([x, if y.dot(up) < 0.0 { -y } else { y }])
    }
}

impl Scene {
    /// The point of a triangle's plane that a ray meets, held within the triangle, on the side that the ray comes from.
    /// A pixel's sample is `cone` wide per unit of distance. Also the distance.
    pub(crate) fn surface_along(
        &self,
        triangle: usize,
        origin: Vec3,
        direction: Vec3,
        cone: f32,
    ) -> (Surface<'_>, f32) {
        let [a, b, c] = self.mesh.corners(triangle);
        let (e1, e2) = (a - b, c - a);
        let inwards = e1.cross(e2);
        let det = inwards.dot(direction);
        let r = direction.cross(a - origin);
        let safe = if det.abs() > 1e-20 { 1.0 / det } else { 0.0 };
        let u = (r.dot(e2) * safe).clamp(0.0, 1.0);
        let v = (r.dot(e1) * safe).clamp(0.0, 1.0 - u);
        let back = !self.mesh.solid && det < 0.0;
        let t = inwards.dot(a - origin) * safe;
        (self.surface(triangle, Vec2::new(u, v), back, cone * t.max(0.0)), t)
    }

    /// The point with weights `bary` of the triangle's second and third corner, seen from its back or its front.
    /// Pictures are averaged over the length `footprint`.
    pub(crate) fn surface(&self, triangle: usize, bary: Vec2, back: bool, footprint: f32) -> Surface<'_> {
        let mesh = &self.mesh;
        let corners = mesh.triangles[triangle].map(|v| v as usize);
        let w = [1.0 - bary.x - bary.y, bary.x, bary.y];
        let mix = |values: &[Vec3]| w[0] * values[corners[0]] + w[1] * values[corners[1]] + w[2] * values[corners[2]];
        let uv = w[0] * mesh.uvs[corners[0]] + w[1] * mesh.uvs[corners[1]] + w[2] * mesh.uvs[corners[2]];
        let material = &mesh.materials[usize::from(mesh.triangle_materials[triangle])];
        let edges = Edges::new(mesh, corners);
        let mut plane_normal = edges.positions[0].cross(edges.positions[1]).normalize_or_zero();
        let mut normal = mix(&mesh.normals).try_normalize().unwrap_or(plane_normal);
        let uv_footprint = if material.has_pictures() { footprint * edges.uv_per_unit() } else { 0.0 };
        if let Some((map, scale)) = &material.normal_map
            && let Some([x, y]) = edges.tangents(map, normal)
        {
            let n = map.sample(uv, uv_footprint).truncate() * 2.0 - 1.0;
            normal = (n.x * scale * x + n.y * scale * y + n.z * normal).try_normalize().unwrap_or(normal);
        }
        if back {
            (normal, plane_normal) = (-normal, -plane_normal);
        }
        let (mut roughness, mut metallic) = (material.roughness, material.metallic);
        if let Some(map) = &material.metallic_roughness {
            let m = map.sample(uv, uv_footprint);
            (roughness, metallic) = (roughness * m.y, metallic * m.z);
        }
        let color = material.rgba(mix(&mesh.rest), uv, mesh.tint(corners, w), uv_footprint);
        Surface {
            position: mix(&mesh.positions),
            normal,
            plane_normal,
            albedo: color.truncate(),
            opacity: material.opacity(color.w),
            emission: material.emitted(uv, uv_footprint),
            roughness,
            metallic,
            light: mix(if back { &self.baked.back } else { &self.baked.light }),
            material,
        }
    }

    /// The side of a triangle that surface points are taken from: the front, unless only the back can be seen.
    pub(crate) fn shows_back(&self, triangle: usize) -> bool {
        !self.mesh.solid && self.mesh.triangles[triangle].iter().all(|&v| self.baked.buried[v as usize])
    }

    /// Linear radiance against a ray whose first surface is on `triangle`, times the opacity of everything along it, and
    /// that opacity.
    pub(crate) fn along(&self, mut triangle: usize, origin: Vec3, direction: Vec3, cone: f32) -> Vec4 {
        let (mut sum, mut left) = (Vec3::ZERO, 1.0);
        for _ in 0..MAX_LAYERS {
            let (s, t) = self.surface_along(triangle, origin, direction, cone);
            if s.opacity > 0.0 {
                // Clamped per sample: a highlight must not bleed over the silhouette.
                let radiance = self.radiance(&s, -direction).clamp(Vec3::ZERO, Vec3::ONE);
                sum += left * s.opacity * radiance;
                left *= 1.0 - s.opacity;
            }
            if left < FAINT {
                break;
            }
            let Some(next) = self.intersect_beyond(origin, direction, t * (1.0 + 4.0 * f32::EPSILON) + 1e-6) else {
                break;
            };
            triangle = next.triangle as usize;
        }
        sum.extend(1.0 - left)
    }

    /// Cosine of the sun on the surface times its visibility.
    fn sun_cosine(&self, s: &Surface) -> f32 {
        let l = self.lighting.sun_direction;
        let cos = s.normal.dot(l);
        if self.lighting.sun <= 0.0 || cos <= 0.0 || s.plane_normal.dot(l) <= 0.0 {
            return 0.0;
        }
        cos * self.tracer.transmittance(&self.mesh, s.position + OFFSET * s.plane_normal, l)
    }

    /// Linear radiance averaged over viewing directions: diffuse light and the mean of the reflection.
    pub(crate) fn diffuse_radiance(&self, s: &Surface) -> Vec3 {
        let m = s.material;
        if m.unlit {
            return s.albedo + s.emission;
        }
        let light = s.light + Vec3::splat(self.lighting.sun * self.sun_cosine(s) / PI);
        if m.specular == 0.0 && s.metallic == 0.0 {
            return s.albedo * light + s.emission;
        }
        // The reflection sees roughly what the surface itself sees; 0.6 is about the middle of the cosines.
        let f0 = Vec3::splat(m.specular).lerp(s.albedo, s.metallic);
        let reflected = Reflection::new(f0, s.roughness, 0.6).total;
        (s.albedo * (1.0 - s.metallic) * (Vec3::ONE - reflected) + reflected) * light + s.emission
    }

    /// Linear radiance towards a viewer in the unit direction `to_eye`.
    pub(crate) fn radiance(&self, s: &Surface, to_eye: Vec3) -> Vec3 {
        let m = s.material;
        if m.unlit || m.specular == 0.0 && s.metallic == 0.0 {
            return self.diffuse_radiance(s);
        }
        let cos_sun = self.sun_cosine(s);
        let sun = self.lighting.sun * cos_sun / PI;
        let f0 = Vec3::splat(m.specular).lerp(s.albedo, s.metallic);
        let reflection = Reflection::new(f0, s.roughness, s.normal.dot(to_eye));
        let body = s.albedo * (1.0 - s.metallic) * (Vec3::ONE - reflection.total);
        let mut color = body * (s.light + Vec3::splat(sun)) + reflection.total * s.light + s.emission;
        if cos_sun > 0.0 {
            let direction = self.lighting.sun_direction;
            let half = (to_eye + direction).normalize_or_zero();
            let visible = cos_sun / s.normal.dot(direction);
            let lobe =
                reflection.towards(s.normal.dot(direction), s.normal.dot(half).max(0.0), half.dot(to_eye).max(0.0));
            color += lobe * (self.lighting.sun * visible);
        }
        color
    }
}
