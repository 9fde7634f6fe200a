//! Points of a surface, smoothed where it is smooth.

use super::Point;
use glam::DVec3;
use rayon::prelude::*;
use std::collections::HashMap;

/// Neighbors count less, the less their normals agree: by a factor of e at this difference of 1 - cosine, half of a right angle's
/// worth being 0.3.
const ALIKE: f64 = 0.15;

/// Points by the cube in which they are.
pub(crate) struct Cubes {
    cubes: HashMap<[i32; 3], Vec<(usize, DVec3)>>,
    side: f64,
}

impl Cubes {
    pub fn new(points: impl Iterator<Item = DVec3>, side: f64) -> Self {
        let mut cubes: HashMap<_, Vec<_>> = HashMap::new();
        points.enumerate().for_each(|(i, p)| cubes.entry(Self::cube(p, side)).or_default().push((i, p)));
        Self { cubes, side }
    }

    fn cube(p: DVec3, side: f64) -> [i32; 3] {
        (p / side).floor().as_ivec3().to_array()
    }

    /// Numbers of the points that are no farther away than a cube's side, in a fixed order.
    pub fn near(&self, p: DVec3) -> impl Iterator<Item = usize> {
        let [x, y, z] = Self::cube(p, self.side);
        let around = (0..27).map(move |k| [x + k % 3 - 1, y + k / 3 % 3 - 1, z + k / 9 - 1]);
        let inside = around.filter_map(|cube| self.cubes.get(&cube)).flatten();
        inside.filter(move |(_, q)| q.distance(p) <= self.side).map(|(i, _)| *i)
    }
}

/// Each point moved along its normal to where its neighbors' tangent planes and its own agree, the nearer and the more alike the more. `reach` is
/// the standard deviation of their weight.
///
/// A sphere stays what it is: its points lie behind the tangent plane of a neighbor by as much as its neighbors do behind theirs.
pub(crate) fn smooth(points: &[Point], reach: f64) -> Vec<Point> {
    let cubes = Cubes::new(points.iter().map(|p| p.place), 2.0 * reach);
    let moved = |p: &Point| {
        let (mut weight, mut shift, mut normal) = (0.0, 0.0, DVec3::ZERO);
        for other in cubes.near(p.place).map(|i| &points[i]) {
            let to = other.place - p.place;
            let w = ((p.normal.dot(other.normal) - 1.0) / ALIKE - 0.5 * to.length_squared() / (reach * reach)).exp();
            weight += w;
            shift += w * 0.5 * (p.normal + other.normal).dot(to);
            normal += w * other.normal;
        }
        Point { place: p.place + p.normal * (shift / weight), normal: normal.try_normalize().unwrap_or(p.normal) }
    };
    points.par_iter().map(moved).collect()
}
