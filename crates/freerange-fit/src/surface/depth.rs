//! Depth maps, and what they say of a point.

use crate::FitError;
use freerange_camera::{Camera, View};
use freerange_raster::{RasterConfig, surface_depth};
use freerange_splat::Cloud;
use glam::DVec3;

/// Alpha from which a pixel is the object's.
const OPAQUE: u8 = 128;

/// How far a surface is at each pixel of a camera.
pub(crate) struct DepthMap {
    camera: Camera,
    /// Camera z; infinite where nothing is. `[height, width]`
    depth: Vec<f32>,
}

impl DepthMap {
    /// Where the surface of Gaussians is.
    pub fn of_cloud(cloud: &Cloud, camera: Camera, raster: &RasterConfig) -> Result<Self, FitError> {
        Ok(Self { camera, depth: surface_depth(cloud.rows(), &camera, raster)? })
    }

    /// Where a photo shows nothing: infinite there, and 0 elsewhere.
    pub fn outline(view: &View) -> Self {
        let depth = view.image.pixels().map(|p| if p[3] < OPAQUE { f32::INFINITY } else { 0.0 });
        Self { camera: view.camera, depth: depth.collect() }
    }

    /// Image coordinates and camera z of a point that is within the image.
    fn project(&self, at: DVec3) -> Option<[f64; 3]> {
        let c = &self.camera;
        let p = c.world_to_camera.transform_point3(at);
        let (x, y) = (c.fx * p.x / p.z + c.cx, c.fy * p.y / p.z + c.cy);
        let inside = p.z > 0.0 && x >= 0.0 && y >= 0.0 && x < f64::from(c.width) && y < f64::from(c.height);
        inside.then_some([x, y, p.z])
    }

    fn at(&self, x: f64, y: f64) -> f64 {
        let clamped = |v: f64, size: u32| v.clamp(0.0, f64::from(size - 1)) as usize;
        let (x, y) = (clamped(x, self.camera.width), clamped(y, self.camera.height));
        self.depth[y * self.camera.width as usize + x].into()
    }

    /// How far a point is before the surface along z, infinitely where there is none; `None` outside the image. Depths that differ by no more
    /// than `step` from pixel to pixel are one surface, linear between pixels.
    pub fn before(&self, at: DVec3, step: f64) -> Option<f64> {
        let [x, y, z] = self.project(at)?;
        let (x0, y0) = ((x - 0.5).floor(), (y - 0.5).floor());
        let depths = [0, 1, 2, 3].map(|k| self.at(x0 + f64::from(k & 1), y0 + f64::from(k >> 1)));
        let nearest = depths.iter().copied().fold(f64::INFINITY, f64::min);
        let farthest = depths.iter().copied().fold(0.0, f64::max);
        let surface = if farthest - nearest <= step {
            let (u, v) = (x - 0.5 - x0, y - 0.5 - y0);
            (depths[0] * (1.0 - u) + depths[1] * u) * (1.0 - v) + (depths[2] * (1.0 - u) + depths[3] * u) * v
        } else {
            self.at(x, y)
        };
        Some(surface - z)
    }

    /// Whether nothing is where a point is seen.
    pub fn is_empty_at(&self, at: DVec3) -> bool {
        self.project(at).is_some_and(|[x, y, _]| self.at(x, y) == f64::INFINITY)
    }
}
