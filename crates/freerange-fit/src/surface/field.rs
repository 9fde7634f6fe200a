//! A signed distance on a grid, fused from depth maps (Curless and Levoy 1996).

use super::DepthMap;
use glam::{DVec3, USizeVec3};
use rayon::prelude::*;

/// Distances are cut to so many cells.
const BAND: f64 = 4.0;
/// Steps of depth from pixel to pixel that are one surface, in cells.
const STEP: f64 = 4.0;
/// Cubes in which points are looked for, in cells: the first try.
const FIRST_SIZE: f64 = 1.2;

/// A point of a surface.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Point {
    pub place: DVec3,
    /// Unit, outward.
    pub normal: DVec3,
}

/// Distances at the corners of a grid of cubes, world units: negative inside.
pub(crate) struct Field {
    side: usize,
    pitch: f64,
    low: DVec3,
    values: Vec<f32>, // [side, side, side], x fastest
}

/// Corner `k` of a cube.
fn corner(k: usize) -> USizeVec3 {
    USizeVec3::new(k & 1, k >> 1 & 1, k >> 2)
}

impl Field {
    /// The field of a function on the cube about the sphere of a radius.
    pub fn new(radius: f64, side: usize, value: impl Fn(DVec3) -> f64 + Sync) -> Self {
        let (pitch, low) = (2.0 * radius / (side - 1) as f64, DVec3::splat(-radius));
        let place = |i: usize| low + pitch * USizeVec3::new(i % side, i / side % side, i / (side * side)).as_dvec3();
        let values = (0..side.pow(3)).into_par_iter().map(|i| value(place(i)) as f32).collect();
        Self { side, pitch, low, values }
    }

    /// What depth maps say: the mean, over those that see a point or what is little before it, of how far it is before their surface.
    /// Inside where none does, and outside where one of `outlines` is empty.
    ///
    /// It is not to be smoothed: outside it rises more steeply than inside, where rays at a slant end, and its zero would move inward.
    pub fn fuse(maps: &[DepthMap], outlines: &[DepthMap], radius: f64, side: usize) -> Self {
        let pitch = 2.0 * radius / (side - 1) as f64;
        let band = BAND * pitch;
        Self::new(radius, side, |at| {
            if outlines.iter().any(|outline| outline.is_empty_at(at)) {
                return band;
            }
            let seen = maps.iter().filter_map(|map| map.before(at, STEP * pitch)).filter(|before| *before >= -band);
            let (sum, count) = seen.fold((0.0, 0), |(sum, count), before| (sum + before.min(band), count + 1));
            if count == 0 { -band } else { sum / f64::from(count) }
        })
    }

    /// The mean of fields on one grid.
    pub fn mean(fields: &[Self]) -> Self {
        let share = 1.0 / fields.len() as f32;
        let values = (0..fields[0].values.len()).into_par_iter();
        let values = values.map(|i| fields.iter().map(|field| share * field.values[i]).sum()).collect();
        Self { values, ..fields[0] }
    }

    /// The value at a point by linear interpolation; outside the grid that of the nearest point within.
    fn value(&self, at: DVec3) -> f64 {
        let last = (self.side - 1) as f64;
        let local = ((at - self.low) / self.pitch).clamp(DVec3::ZERO, DVec3::splat(last));
        let cell = local.floor().min(DVec3::splat(last - 1.0));
        let (f, cell) = (local - cell, cell.as_usizevec3());
        let part = |k: usize| {
            let c = corner(k);
            let weight: f64 = (0..3).map(|a| if c[a] == 1 { f[a] } else { 1.0 - f[a] }).product();
            let USizeVec3 { x, y, z } = cell + c;
            weight * f64::from(self.values[(z * self.side + y) * self.side + x])
        };
        (0..8).map(part).sum()
    }

    /// The gradient at a point, by differences over two cells.
    fn gradient(&self, at: DVec3) -> DVec3 {
        let along = |axis: DVec3| self.value(at + self.pitch * axis) - self.value(at - self.pitch * axis);
        DVec3::new(along(DVec3::X), along(DVec3::Y), along(DVec3::Z)) / (2.0 * self.pitch)
    }

    /// About `count` points of the surface, none where there is none, and how far apart they are.
    pub fn points(&self, count: usize) -> (Vec<Point>, f64) {
        let mut size = FIRST_SIZE;
        // Points go as the inverse square of the size of the cubes.
        for _ in 0..3 {
            let found = self.points_of_cubes(size).len();
            if found == 0 {
                return (Vec::new(), size * self.pitch);
            }
            size = (size * (found as f64 / count as f64).sqrt()).clamp(0.25, self.side as f64 / 4.0);
        }
        (self.points_of_cubes(size), size * self.pitch)
    }

    /// One point in each cube of `size` cells that the surface passes: the mean of where it crosses the cube's edges (Gibson 1998).
    fn points_of_cubes(&self, size: f64) -> Vec<Point> {
        let step = size * self.pitch;
        let count = ((self.side - 1) as f64 / size) as usize;
        let row = count + 1;
        let place = |c: USizeVec3| self.low + step * c.as_dvec3();
        let at = |i: usize| self.value(place(USizeVec3::new(i % row, i / row % row, i / (row * row))));
        let values: Vec<f64> = (0..row.pow(3)).into_par_iter().map(at).collect();
        let point = |i: usize| {
            let base = USizeVec3::new(i % count, i / count % count, i / (count * count));
            let corners: [USizeVec3; 8] = std::array::from_fn(|k| base + corner(k));
            let values = corners.map(|c| values[(c.z * row + c.y) * row + c.x]);
            let inside = values.iter().filter(|v| **v < 0.0).count();
            if inside == 0 || inside == 8 {
                return None;
            }
            let edges = (0..8).flat_map(|k| [1, 2, 4].map(|axis| (k, k | axis))).filter(|(a, b)| a != b);
            let crossed = edges.filter(|&(a, b)| (values[a] < 0.0) != (values[b] < 0.0));
            let crossing =
                |(a, b): (usize, usize)| place(corners[a]).lerp(place(corners[b]), values[a] / (values[a] - values[b]));
            let (sum, crossings) = crossed.fold((DVec3::ZERO, 0.0), |(sum, n), edge| (sum + crossing(edge), n + 1.0));
            let place = sum / crossings;
            Some(Point { place, normal: self.gradient(place).try_normalize()? })
        };
        (0..count.pow(3)).into_par_iter().filter_map(point).collect()
    }
}
