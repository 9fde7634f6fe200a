//! Gaussians straight from a mesh: points by area, flat along the normal, colored as rendered, opaque.

use freerange_assets::render::{Scene, sample_surface};
use freerange_gaussians::{Gaussians, channel};
use glam::{Mat3, Quat, Vec3};
use rand_chacha::ChaCha8Rng;

/// How surface points become Gaussians.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SurfaceConfig {
    /// Surface points, the leaves of the tree.
    pub points: usize,
    /// Standard deviation along the surface, in units of the square root of the area that a point stands for. Less leaves
    /// holes between the points; more reaches beyond the silhouette, which is where most of the error is. Fits start
    /// from wider ones, whatever this says.
    pub spread: f32,
    /// Standard deviation along the normal, in the same units.
    pub thickness: f32,
    /// Opacity. Fits start from `fit.initial_opacity` instead.
    pub opacity: f32,
}

impl Default for SurfaceConfig {
    fn default() -> Self {
        Self { points: 4096, spread: 0.5, thickness: 0.04, opacity: 0.95 }
    }
}

/// One Gaussian per surface point.
pub fn surface_gaussians(mesh: &Scene, config: &SurfaceConfig, rng: &mut ChaCha8Rng) -> Gaussians {
    let points = sample_surface(mesh, config.points, rng);
    let logit = (config.opacity / (1.0 - config.opacity)).ln();
    let mut rows = Vec::with_capacity(points.len() * channel::COUNT);
    for p in &points {
        let side = p.area.max(1e-12).sqrt();
        let [along, across] = [config.spread, config.thickness].map(|s| (s * side).ln());
        let q = tangent_frame(Vec3::from(p.normal));
        rows.extend_from_slice(&p.position);
        rows.extend_from_slice(&[along, along, across]);
        rows.extend_from_slice(&[q.w, q.x, q.y, q.z]);
        rows.push(logit);
        rows.extend_from_slice(&p.color);
    }
    Gaussians::from_rows(rows)
}

/// The rotation that takes the local z axis to `normal`.
fn tangent_frame(normal: Vec3) -> Quat {
    let (x, y) = normal.any_orthonormal_pair();
    Quat::from_mat3(&Mat3::from_cols(x, y, normal)).normalize()
}
