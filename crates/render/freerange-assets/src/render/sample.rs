//! Points on the surface of a mesh.

use glam::Vec2;
use rand::Rng;

use crate::mesh::linear_to_srgb;
use crate::render::scene::Scene;

/// A point on the surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// Position in the object's frame.
    pub position: [f32; 3],
    /// Unit outward shading normal.
    pub normal: [f32; 3],
    /// Shaded color averaged over viewing directions, sRGB-encoded, within [0, 1].
    pub color: [f32; 3],
    /// Area that the point stands for, in squared units.
    pub area: f32,
}

/// Spreads `count` points over the visible surface, uniformly by area: one in each of `count` equal slices of the
/// cumulative area, with a low-discrepancy sequence inside triangles. Parts buried inside others are left out.
pub fn sample_surface(scene: &Scene, count: usize, rng: &mut impl Rng) -> Vec<SurfacePoint> {
    let mesh = scene.mesh();
    let mut total = 0.0f64;
    let cumulative: Vec<f64> = (0..mesh.triangles.len())
        .map(|i| {
            if !scene.is_buried(i) {
                total += f64::from(mesh.area(i));
            }
            total
        })
        .collect();
    if total <= 0.0 {
        return Vec::new();
    }
    let footprint = (total / count.max(1) as f64).sqrt() as f32;
    // The two-dimensional golden-ratio sequence, started at a random point.
    let (mut a, mut b): (f32, f32) = (rng.random(), rng.random());
    let mut triangle = 0;
    (0..count)
        .map(|i| {
            let target = (i as f64 + rng.random::<f64>()) / count as f64 * total;
            while triangle + 1 < cumulative.len() && cumulative[triangle] <= target {
                triangle += 1;
            }
            a = (a + 0.754_877_7).fract();
            b = (b + 0.569_840_3).fract();
            let root = a.sqrt();
            // Pictures are averaged over the area that the point stands for.
            let bary = Vec2::new(root * (1.0 - b), root * b);
            let surface = scene.surface(triangle, bary, scene.shows_back(triangle), footprint);
            let c = scene.diffuse_radiance(&surface);
            SurfacePoint {
                position: surface.position.to_array(),
                normal: surface.normal.to_array(),
                color: c.to_array().map(linear_to_srgb),
                area: (total / count as f64) as f32,
            }
        })
        .collect()
}
