//! Ray queries against a triangle mesh.

use std::time::Duration;

use glam::{Vec2, Vec3};
use obvhs::BvhBuildParams;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::builder::build_bvh2_from_tris;
use obvhs::ray::{Ray, RayHit};
use obvhs::rt_triangle::RtTriangle;
use obvhs::triangle::Triangle;

use crate::mesh::AlphaMode;
use crate::mesh::Mesh;

/// Slack of the inside test in barycentric coordinates: rays through a shared edge must not slip between.
const EDGE: f32 = -1e-6;

/// Surfaces that a ray looks through at most.
const MAX_LAYERS: usize = 100;

/// The nearest intersection.
#[derive(Clone, Copy, Debug)]
pub struct RawHit {
    /// Distance in units of the ray's direction.
    pub t: f32,
    /// Triangle index in the mesh.
    pub triangle: u32,
    /// Weights of the second and third corner.
    pub bary: Vec2,
    /// True if the ray met the triangle from behind.
    pub back: bool,
}

/// A bounding volume hierarchy over triangles.
pub struct Tracer {
    bvh: Bvh2,
    /// In the order of the hierarchy's leaves.
    triangles: Vec<RtTriangle>,
    /// True if some material is not opaque.
    veiled: bool,
}

fn intersect(t: &RtTriangle, ray: &Ray) -> f32 {
    let c = t.v0 - ray.origin;
    let r = ray.direction.cross(c);
    let inv_det = 1.0 / t.ng.dot(ray.direction);
    let (u, v) = (r.dot(t.e2) * inv_det, r.dot(t.e1) * inv_det);
    // Comparisons with NaN (a ray in the plane of the triangle) are false, so that is a miss.
    if u >= EDGE && v >= EDGE && u + v <= 1.0 - EDGE {
        let distance = t.ng.dot(c) * inv_det;
        if distance >= ray.tmin && distance <= ray.tmax {
            return distance;
        }
    }
    f32::INFINITY
}

impl Tracer {
    pub fn new(mesh: &Mesh) -> Self {
        let triangles: Vec<Triangle> = (0..mesh.triangles.len())
            .map(|i| mesh.corners(i))
            .map(|[a, b, c]| Triangle { v0: a.into(), v1: b.into(), v2: c.into() })
            .collect();
        let params = BvhBuildParams { pre_split: false, ..BvhBuildParams::fast_build() };
        let bvh = build_bvh2_from_tris(&triangles, params, &mut Duration::default());
        let triangles = bvh.primitive_indices.iter().map(|&i| RtTriangle::from(&triangles[i as usize])).collect();
        let veiled = mesh.materials.iter().any(|m| m.alpha != AlphaMode::Opaque);
        Self { bvh, triangles, veiled }
    }

    /// The nearest intersection beyond `tmin`.
    pub fn closest(&self, origin: Vec3, direction: Vec3, tmin: f32) -> Option<RawHit> {
        let ray = Ray::new(origin.into(), direction.into(), tmin, f32::INFINITY);
        let mut hit = RayHit::none();
        self.bvh.ray_traverse(ray, &mut hit, |ray, id| intersect(&self.triangles[id], ray));
        let t = self.triangles.get(hit.primitive_id as usize)?;
        let det = t.ng.dot(ray.direction);
        let r = ray.direction.cross(t.v0 - ray.origin);
        Some(RawHit {
            t: hit.t,
            triangle: self.bvh.primitive_indices[hit.primitive_id as usize],
            bary: Vec2::new(r.dot(t.e2), r.dot(t.e1)) / det,
            // The stored normal points inwards.
            back: det < 0.0,
        })
    }

    /// True if anything lies along the ray beyond `tmin`.
    pub fn occluded(&self, origin: Vec3, direction: Vec3, tmin: f32) -> bool {
        let ray = Ray::new(origin.into(), direction.into(), tmin, f32::INFINITY);
        !self.bvh.ray_traverse_miss(ray, |ray, id| intersect(&self.triangles[id], ray))
    }

    /// Where a ray ends that passes through a surface with the probability of its transparency: at the first surface
    /// behind which less than the share `chance` of the light is left.
    pub fn closest_by_chance(&self, mesh: &Mesh, origin: Vec3, direction: Vec3, chance: f32) -> Option<RawHit> {
        let mut left = 1.0;
        self.through(origin, direction, |hit| {
            if self.veiled {
                left *= 1.0 - mesh.opacity(hit.triangle as usize, hit.bary);
            } else {
                left = 0.0;
            }
            left > chance
        })
    }

    /// The share of light that arrives along a ray from infinity.
    pub fn transmittance(&self, mesh: &Mesh, origin: Vec3, direction: Vec3) -> f32 {
        if !self.veiled {
            return f32::from(u8::from(!self.occluded(origin, direction, 0.0)));
        }
        let mut left = 1.0;
        self.through(origin, direction, |hit| {
            left *= 1.0 - mesh.opacity(hit.triangle as usize, hit.bary);
            left > 0.0
        });
        left
    }

    /// Visits the surfaces along a ray from the front to the back until `go_on` says no, and returns the last one then.
    pub fn through(&self, origin: Vec3, direction: Vec3, mut go_on: impl FnMut(&RawHit) -> bool) -> Option<RawHit> {
        let mut start = 0.0;
        for _ in 0..MAX_LAYERS {
            let hit = self.closest(origin, direction, start)?;
            if !go_on(&hit) {
                return Some(hit);
            }
            start = hit.t * (1.0 + 4.0 * f32::EPSILON) + 1e-6;
        }
        None
    }
}
