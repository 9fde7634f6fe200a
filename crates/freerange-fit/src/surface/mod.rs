//! The surface that Gaussians and photos know of, and one opaque layer of Gaussians on it.
//!
//! * [`Field`]: a signed distance on a grid, from depth maps of the Gaussians all around and the photos' outlines.
//! * [`smooth`]: points of a surface without the noise of its grid, bends and edges kept, nothing shrunk.
//! * [`look`]: what photos say of each point: which see it, how squarely, in what color.
//! * [`layered`]: flat Gaussians on the points that photos see, among those that are elsewhere.
//!
//! What is measured of it, and what is left to do: `docs/research/surface.md`.

mod depth;
mod field;
mod layer;
mod look;
mod smooth;
#[cfg(test)]
mod tests;

pub(crate) use depth::DepthMap;
pub(crate) use field::{Field, Point};
pub(crate) use layer::layered;
#[cfg(test)]
use {
    look::{discs, look},
    smooth::smooth,
};

use crate::{FitError, hold::around};
use freerange_camera::{Camera, View};
use freerange_raster::RasterConfig;
use freerange_splat::Cloud;

/// Depth maps, and their width and height in pixels.
const MAPS: (usize, u32) = (32, 192);
/// What these stand for, in pixels: [`RasterConfig::shrunk`].
const FULL_SIZE: f32 = 512.0;
/// Corners per side of the grid.
pub(crate) const SIDE: usize = 128;

/// The surface of several clouds of one object within `radius` of the origin, of which `photos` show the outline: the mean of each one's.
pub(crate) fn surface_of(clouds: &[Cloud], photos: &[View], radius: f64) -> Result<Field, FitError> {
    let raster = RasterConfig::default().shrunk(MAPS.1 as f32 / FULL_SIZE);
    let outlines: Vec<_> = photos.iter().map(DepthMap::outline).collect();
    let field = |cloud: &Cloud| {
        let map = |camera: Camera| DepthMap::of_cloud(cloud, camera, &raster);
        let maps = around(MAPS.0, MAPS.1, radius).map(map).collect::<Result<Vec<_>, _>>()?;
        Ok::<_, FitError>(Field::fuse(&maps, &outlines, radius, SIDE))
    };
    Ok(Field::mean(&clouds.iter().map(field).collect::<Result<Vec<_>, _>>()?))
}
