//! The surface that Gaussians and photos know of, and one opaque layer of Gaussians on it.
//!
//! * [`Field`]: a signed distance on a grid, from depth maps of the Gaussians all around and the photos' outlines.
//! * [`smooth`]: points of a surface without the noise of its grid, bends and edges kept, nothing shrunk.
//! * [`look`]: what photos say of each point: which see it, how squarely, in what color.
//! * [`sweep`]: moves points that two photos see to where the photos agree.
//! * [`Layer`]: flat Gaussians on the points that photos see, among those that are elsewhere.
//!
//! What is measured of it, and what is left to do: `docs/research/surface.md`.

mod depth;
mod field;
mod layer;
mod look;
mod smooth;
mod sweep;
#[cfg(test)]
mod tests;

pub(crate) use depth::DepthMap;
pub(crate) use field::{Field, Point};
pub(crate) use layer::Layer;
#[cfg(test)]
use look::discs;
pub(crate) use look::{Seen, look};
pub(crate) use smooth::smooth;
pub(crate) use sweep::sweep;

use crate::{FitError, hold::around};
use freerange_camera::{Camera, View};
use freerange_raster::RasterConfig;
use freerange_splat::Cloud;
use glam::DVec3;

/// Depth maps, and their width and height in pixels.
const MAPS: (usize, u32) = (32, 192);
/// What these stand for, in pixels: [`RasterConfig::shrunk`].
const FULL_SIZE: f32 = 512.0;
/// Corners per side of the grid.
const SIDE: usize = 128;
/// Rounds of smoothing, and how far they reach, in spacings of the points.
const SMOOTHING: (usize, f64) = (2, 2.0);

/// Points of a surface, about as far apart everywhere.
pub(crate) struct Surface {
    pub points: Vec<Point>,
    /// Distance of neighbors, world units.
    pub spacing: f64,
}

impl Surface {
    /// About `count` points of the surface of `cloud`, an object within `radius` of the origin, of which `photos` show the outline.
    pub fn of(cloud: &Cloud, photos: &[View], radius: f64, count: usize) -> Result<Self, FitError> {
        let raster = RasterConfig::default().shrunk(MAPS.1 as f32 / FULL_SIZE);
        let map = |camera: Camera| DepthMap::of_cloud(cloud, camera, &raster);
        let maps = around(MAPS.0, MAPS.1, radius).map(map).collect::<Result<Vec<_>, _>>()?;
        let outlines: Vec<_> = photos.iter().map(DepthMap::outline).collect();
        let (mut points, spacing) = Field::fuse(&maps, &outlines, radius, SIDE).points(count);
        for _ in 0..SMOOTHING.0 {
            points = smooth(&points, SMOOTHING.1 * spacing);
        }
        Ok(Self { points, spacing })
    }

    /// About `count` points of a surface from which any point has a known distance, negative inside.
    pub fn at(distance: impl Fn(DVec3) -> f64 + Sync, radius: f64, count: usize) -> Self {
        let (points, spacing) = Field::new(radius, SIDE, distance).points(count);
        Self { points, spacing }
    }
}
