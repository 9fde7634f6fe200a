//! What photos say of the points of a surface.

use super::{DepthMap, Point};
use crate::FitError;
use freerange_camera::View;
use freerange_core::image_ops::shrunk_size;
use freerange_raster::RasterConfig;
use freerange_splat::{Cloud, channel};
use glam::{DQuat, DVec3};
use rayon::prelude::*;

/// Smallest cosine between a normal and the direction to a camera at which its photo shows the surface.
const LEAST_COSINE: f64 = 0.2;
/// Longest side, in pixels, of the depth maps that tell what hides what.
const SIZE: u32 = 256;
/// Standard deviations of a disc, along it and through it, in spacings, and the logit of its opacity.
const DISC: (f64, f64, f32) = (0.5, 0.05, 3.0);

/// A point with what photos say of it.
#[derive(Clone, Debug)]
pub(crate) struct Seen {
    pub point: Point,
    /// The photos that see it, by number, and the cosines at which they do.
    pub photos: Vec<(usize, f64)>,
    /// Mean of their colors, by the fourth power of the cosine: the squarest decides.
    pub color: [f32; 3],
}

/// A flat, opaque Gaussian on a point of a surface whose points are `spacing` apart.
pub(crate) fn disc(point: &Point, spacing: f64, color: [f32; 3]) -> [f32; channel::COUNT] {
    let (wide, thin, logit) = (DISC.0 * spacing, DISC.1 * spacing, DISC.2);
    let mut row = [logit; channel::COUNT];
    row[channel::MEAN].copy_from_slice(&point.place.as_vec3().to_array());
    row[channel::LOG_SCALE].copy_from_slice(&[wide, wide, thin].map(|v| v.ln() as f32));
    let DQuat { x, y, z, w } = DQuat::from_rotation_arc(DVec3::Z, point.normal);
    row[channel::ROTATION].copy_from_slice(&[w, x, y, z].map(|v| v as f32));
    row[channel::COLOR].copy_from_slice(&color);
    row
}

/// Gray Gaussians on all points.
pub(crate) fn discs(points: &[Point], spacing: f64) -> Cloud {
    Cloud::from_rows(points.iter().flat_map(|p| disc(p, spacing, [0.5; 3])).collect())
}

/// Straight RGBA, 0 to 1, of a photo where it shows a point, linear between pixels; `None` outside.
pub(crate) fn sample(view: &View, at: DVec3) -> Option<[f32; 4]> {
    let c = &view.camera;
    let p = c.world_to_camera.transform_point3(at);
    let (x, y) = (c.fx * p.x / p.z + c.cx - 0.5, c.fy * p.y / p.z + c.cy - 0.5);
    let (w, h) = view.image.dimensions();
    if !(p.z > 0.0 && x >= 0.0 && y >= 0.0 && x < f64::from(w - 1) && y < f64::from(h - 1)) {
        return None;
    }
    let (left, top) = (x as u32, y as u32);
    let (u, v) = (x.fract() as f32, y.fract() as f32);
    let mut sum = [0.0; 4];
    for (dx, dy, weight) in [(0, 0, (1.0 - u) * (1.0 - v)), (1, 0, u * (1.0 - v)), (0, 1, (1.0 - u) * v), (1, 1, u * v)]
    {
        let pixel = view.image.get_pixel(left + dx, top + dy).0;
        (0..4).for_each(|c| sum[c] += weight * f32::from(pixel[c]) / 255.0);
    }
    Some(sum)
}

/// What photos say of each point of an opaque surface whose points are `spacing` apart.
pub(crate) fn look(points: &[Point], spacing: f64, photos: &[View]) -> Result<Vec<Seen>, FitError> {
    let cloud = discs(points, spacing);
    let map = |view: &View| {
        let (w, h) = shrunk_size(view.image.dimensions(), SIZE);
        DepthMap::of_cloud(&cloud, view.camera.resized(w, h), &RasterConfig::default())
    };
    let maps = photos.iter().map(map).collect::<Result<Vec<_>, _>>()?;
    let seen = |point: &Point| {
        let (mut seeing, mut sum, mut weights) = (Vec::new(), [0.0; 3], 0.0);
        for (i, (view, map)) in photos.iter().zip(&maps).enumerate() {
            let cosine = point.normal.dot((view.camera.center() - point.place).normalize_or_zero());
            // Discs around it may be before it by as much as the slant and their extent explain.
            let allowed = (2.0 + 1.0 / cosine) * spacing;
            let hidden = || map.before(point.place, 2.0 * spacing).is_none_or(|before| before < -allowed);
            if cosine < LEAST_COSINE || hidden() {
                continue;
            }
            let Some([r, g, b, alpha]) = sample(view, point.place).filter(|rgba| rgba[3] >= 0.5) else { continue };
            let weight = (cosine.powi(4)) as f32 * alpha;
            [r, g, b].iter().zip(&mut sum).for_each(|(v, sum)| *sum += weight * v);
            weights += weight;
            seeing.push((i, cosine));
        }
        let color = if weights > 0.0 { sum.map(|v| v / weights) } else { [0.5; 3] };
        Seen { point: *point, photos: seeing, color }
    };
    Ok(points.par_iter().map(seen).collect())
}
