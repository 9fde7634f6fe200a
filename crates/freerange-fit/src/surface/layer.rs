//! One opaque layer of flat Gaussians where photos look, beside what is there elsewhere.

use super::{Field, look::disc, look::look, smooth::Cubes, smooth::smooth};
use crate::FitError;
use freerange_camera::View;
use freerange_splat::Cloud;

/// Rounds of smoothing, and how far they reach, in spacings of the points.
const SMOOTHING: (usize, f64) = (2, 2.0);
/// Other Gaussians whose centers are nearer to the layer go, in spacings of the layer.
const CLEAR: f64 = 2.0;
/// Layers that are tried for the number of Gaussians.
const TRIES: usize = 3;

/// Flat Gaussians in the photos' colors on the surface of a field where photos see it, before those of `cloud` that are elsewhere: about `most`
/// in all.
pub(crate) fn layered(cloud: &Cloud, field: &Field, photos: &[View], most: usize) -> Result<Cloud, FitError> {
    let mut count = most;
    let mut all = Cloud::default();
    for _ in 0..TRIES {
        all = layer_of(cloud, field, photos, count)?;
        if all.len() <= most {
            break;
        }
        count = (count as f64 * most as f64 / all.len() as f64) as usize;
    }
    Ok(all)
}

/// The same with about `count` points on the whole surface.
fn layer_of(cloud: &Cloud, field: &Field, photos: &[View], count: usize) -> Result<Cloud, FitError> {
    let (mut points, spacing) = field.points(count);
    for _ in 0..SMOOTHING.0 {
        points = smooth(&points, SMOOTHING.1 * spacing);
    }
    let mut seen = look(&points, spacing, photos)?;
    seen.retain(|s| !s.photos.is_empty());
    let cubes = Cubes::new(seen.iter().map(|s| s.point.place), CLEAR * spacing);
    let mut all = Cloud::default();
    seen.iter().for_each(|s| all.push(&disc(&s.point, spacing, s.color)));
    let elsewhere = (0..cloud.len()).filter(|&i| cubes.near(cloud.mean(i)).next().is_none());
    elsewhere.for_each(|i| all.push(cloud.row(i)));
    Ok(all)
}
