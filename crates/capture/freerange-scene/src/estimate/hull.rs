//! The visual hull: which region of space lies within the masks, and where it appears in the views.

use super::picture::Picture;
use glam::DVec3;
use rayon::prelude::*;
use std::collections::HashMap;

/// Voxels along the longest side in the first of two passes.
const COARSE: usize = 56;

/// Whether a mask reaches the picture's border: then nothing is known of what lies beyond.
pub fn reaches_border(mask: &[bool], w: usize, h: usize) -> bool {
    mask.iter().enumerate().any(|(i, m)| *m && (i % w == 0 || i % w + 1 == w || i < w || i + w >= w * h))
}

/// Number of mask pixels left of and above each pixel corner, `[h + 1, w + 1]`.
fn sums(mask: &[bool], w: usize, h: usize) -> Vec<u32> {
    let mut sums = vec![0u32; (w + 1) * (h + 1)];
    for y in 0..h {
        let mut row = 0;
        for x in 0..w {
            row += u32::from(mask[y * w + x]);
            sums[(y + 1) * (w + 1) + x + 1] = sums[y * (w + 1) + x + 1] + row;
        }
    }
    sums
}

/// The views, ready to be asked whether a point is outside of their masks.
struct Outside<'a> {
    pictures: &'a [Picture],
    /// For each: [`sums`], and whether the mask reaches the border.
    masks: Vec<(Vec<u32>, bool)>,
}

impl<'a> Outside<'a> {
    fn new(pictures: &'a [Picture], masks: &[Vec<bool>]) -> Self {
        let masks = pictures
            .iter()
            .zip(masks)
            .map(|(p, m)| (sums(m, p.width(), p.height()), reaches_border(m, p.width(), p.height())))
            .collect();
        Self { pictures, masks }
    }

    /// Tells `out` of each view that does not have the cube about a point in its mask, within half a pixel, until it answers no: then
    /// None. Else how many views tell of the point at all.
    fn each(&self, point: DVec3, half: f64, mut out: impl FnMut(usize) -> bool) -> Option<usize> {
        let mut shown = 0;
        for (i, (picture, (sums, cropped))) in self.pictures.iter().zip(&self.masks).enumerate() {
            let (x, y, z) = picture.project(point);
            let (w, h) = (picture.width() as f64, picture.height() as f64);
            let beyond = z <= half || x < 0.0 || y < 0.0 || x >= w || y >= h;
            if beyond && *cropped {
                continue;
            }
            shown += 1;
            let empty = beyond || {
                let reach = picture.camera.fx * half / z + 0.5;
                let range = |v: f64, size: f64| {
                    ((v - reach).clamp(0.0, size) as usize, (v + reach).clamp(0.0, size).ceil() as usize)
                };
                let ((x0, x1), (y0, y1)) = (range(x, w), range(y, h));
                let at = |x: usize, y: usize| sums[y * (w as usize + 1) + x];
                at(x1, y1) + at(x0, y0) == at(x0, y1) + at(x1, y0)
            };
            if empty && !out(i) {
                return None;
            }
        }
        Some(shown)
    }
}

/// Points of a sphere that at most two views do not have in their masks, and which two.
pub struct Nearly {
    points: Vec<(DVec3, [Option<usize>; 2])>,
    step: f64,
}

impl Nearly {
    /// Looks through the sphere. `grid`: points along its diameter.
    pub fn carve(pictures: &[Picture], masks: &[Vec<bool>], center: DVec3, radius: f64, grid: usize) -> Self {
        let views = Outside::new(pictures, masks);
        let step = 2.0 * radius / grid as f64;
        let at = |i: usize| (i as f64 + 0.5) * step - radius;
        let points = (0..grid)
            .into_par_iter()
            .flat_map_iter(|z| (0..grid * grid).map(move |i| (i % grid, i / grid, z)))
            .map(|(x, y, z)| DVec3::new(at(x), at(y), at(z)))
            .filter(|p| p.length() <= radius)
            .filter_map(|p| {
                let mut without = [None; 2];
                let mut count = 0;
                let shown = views.each(center + p, 0.5 * step, |i| {
                    if count < 2 {
                        without[count] = Some(i);
                    }
                    count += 1;
                    count <= 2
                })?;
                (shown >= count + 2).then_some((center + p, without))
            })
            .collect();
        Self { points, step }
    }

    /// The hull of all masks but one: what no other view excludes.
    pub fn without(&self, left_out: usize) -> Hull {
        let own = |without: &[Option<usize>; 2]| without.iter().flatten().all(|i| *i == left_out);
        self.hull(self.points.iter().filter(|(_, without)| own(without)).map(|(p, _)| *p).collect())
    }

    /// The points that one of `count` views excludes, by its number, and those that two do, by theirs in order.
    pub fn excluded(&self, count: usize) -> (Vec<Vec<DVec3>>, OfPairs) {
        let (mut one, mut two) = (vec![Vec::new(); count], HashMap::<_, Vec<DVec3>>::new());
        for (point, without) in &self.points {
            match *without {
                [Some(i), Some(j)] => two.entry([i, j]).or_default().push(*point),
                [Some(i), None] => one[i].push(*point),
                _ => {}
            }
        }
        (one, two)
    }

    /// Some of the points as a hull.
    pub fn hull(&self, points: Vec<DVec3>) -> Hull {
        Hull { points, step: self.step }
    }
}

/// Points of each pair of views, by their numbers in order.
pub type OfPairs = HashMap<[usize; 2], Vec<DVec3>>;

/// The hull of some masks, sampled.
pub struct Hull {
    /// Middles of its voxels.
    pub points: Vec<DVec3>,
    /// A voxel's side.
    pub step: f64,
}

/// The region below `center + height normal` that cannot be the object: the table.
pub type Floor = Option<(DVec3, f64)>;

impl Hull {
    /// Carves the sphere about `center`. A point belongs to the hull if all views but `missing` have it in their mask, within half a
    /// voxel and half a pixel; a view whose mask reaches its border says nothing of what lies beyond. At least two views must tell. None
    /// where no point does. `grid`: voxels along the longest side.
    pub fn carve(
        pictures: &[Picture],
        masks: &[Vec<bool>],
        center: DVec3,
        radius: f64,
        floor: Floor,
        missing: usize,
        grid: usize,
    ) -> Option<Self> {
        let views = Outside::new(pictures, masks);
        let within = |point: DVec3, half: f64| {
            if floor.is_some_and(|(normal, height)| (point - center).dot(normal) < height - half) {
                return false;
            }
            let mut out = 0;
            let shown = views.each(point, half, |_| {
                out += 1;
                out <= missing
            });
            shown.is_some_and(|shown| shown >= 2)
        };
        let (low, high) = (center - DVec3::splat(radius), center + DVec3::splat(radius));
        let coarse = Self::sample(low, high, COARSE, |p, half| p.distance(center) <= radius && within(p, half))?;
        let (low, high) = coarse.bounds();
        Self::sample(low, high, grid, within)
    }

    fn sample(low: DVec3, high: DVec3, grid: usize, within: impl Fn(DVec3, f64) -> bool + Sync) -> Option<Self> {
        let step = (high - low).max_element() / grid as f64;
        let counts = ((high - low) / step).ceil().max(DVec3::ONE);
        let [nx, ny, nz] = [counts.x as usize, counts.y as usize, counts.z as usize];
        let points: Vec<DVec3> = (0..nz)
            .into_par_iter()
            .flat_map_iter(|z| (0..nx * ny).map(move |i| (i % nx, i / nx, z)))
            .map(|(x, y, z)| low + step * (DVec3::new(x as f64, y as f64, z as f64) + 0.5))
            .filter(|p| within(*p, 0.5 * step))
            .collect();
        (!points.is_empty() && step > 0.0).then_some(Self { points, step })
    }

    /// The box of its voxels along the world's axes.
    pub fn bounds(&self) -> (DVec3, DVec3) {
        let low = self.points.iter().fold(DVec3::INFINITY, |a, p| a.min(*p));
        let high = self.points.iter().fold(DVec3::NEG_INFINITY, |a, p| a.max(*p));
        (low - 0.5 * self.step, high + 0.5 * self.step)
    }

    /// Where it appears, each voxel as a square: `[h, w]`.
    pub fn outline(&self, picture: &Picture) -> Vec<bool> {
        let (w, h) = (picture.width(), picture.height());
        let mut corners = vec![0i32; (w + 1) * (h + 1)];
        for point in &self.points {
            let (x, y, z) = picture.project(*point);
            if z <= self.step {
                continue;
            }
            let reach = 0.55 * picture.camera.fx * self.step / z;
            let range = |v: f64, size: usize| {
                let size = size as f64;
                ((v - reach).clamp(0.0, size).round() as usize, (v + reach).clamp(0.0, size).round() as usize)
            };
            let ((x0, x1), (y0, y1)) = (range(x, w), range(y, h));
            corners[y0 * (w + 1) + x0] += 1;
            corners[y0 * (w + 1) + x1] -= 1;
            corners[y1 * (w + 1) + x0] -= 1;
            corners[y1 * (w + 1) + x1] += 1;
        }
        let mut outline = vec![false; w * h];
        let mut above = vec![0i32; w];
        for y in 0..h {
            let mut row = 0;
            for x in 0..w {
                row += corners[y * (w + 1) + x];
                above[x] += row;
                outline[y * w + x] = above[x] > 0;
            }
        }
        outline
    }
}

/// How much of two masks is common: intersection over union, 0 to 1; 1 for two empty ones.
pub fn overlap(a: &[bool], b: &[bool]) -> f64 {
    let count = |f: fn(bool, bool) -> bool| a.iter().zip(b).filter(|(a, b)| f(**a, **b)).count() as f64;
    match count(|a, b| a || b) {
        0.0 => 1.0,
        union => count(|a, b| a && b) / union,
    }
}
