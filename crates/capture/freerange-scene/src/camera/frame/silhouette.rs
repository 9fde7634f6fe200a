//! Object masks seen by posed cameras: how wide they are, and which region of space projects into all of them.

use crate::camera::{Camera, View, image_ops::resize_area};
use glam::{DVec3, DVec4};

/// Masks are looked at in no more detail than this many pixels a side.
const DETAIL: u32 = 512;
/// Grid points along an axis, in each of two passes.
const GRID: usize = 64;
/// Alpha from which a pixel belongs to the object.
const SOLID: u8 = 128;

/// A view's mask.
pub(super) struct Silhouette {
    camera: Camera,
    /// Unit directions of the rays through the mask's outline, from the camera's center.
    outline: Vec<DVec3>,
    /// Direction through the mask's centroid.
    pub towards: DVec3,
    pub origin: DVec3,
    /// Number of mask pixels left of and above each pixel corner, `[h + 1, w + 1]`.
    sums: Vec<u32>,
    /// Whether the mask reaches the image's border: then nothing is known of what lies outside.
    pub cropped: bool,
}

impl Silhouette {
    /// The view's mask; none where the image has no transparency or shows nothing.
    pub fn of(view: &View) -> Option<Self> {
        let (w, h) = view.image.dimensions();
        let largest = w.max(h);
        let (camera, resized);
        let image = if largest > DETAIL {
            let side = |s: u32| ((u64::from(s) * u64::from(DETAIL)).div_ceil(u64::from(largest)) as u32).max(1);
            resized = resize_area(&view.image, side(w), side(h));
            camera = view.camera.resized(side(w), side(h));
            &resized
        } else {
            camera = view.camera;
            &view.image
        };
        let (w, h) = (image.width() as usize, image.height() as usize);
        let solid: Vec<bool> = image.pixels().map(|p| p[3] >= SOLID).collect();
        let inside = |x: usize, y: usize| x < w && y < h && solid[y * w + x];

        let mut sums = vec![0u32; (w + 1) * (h + 1)];
        let (mut outline, mut cropped) = (Vec::new(), false);
        let (mut sum_x, mut sum_y) = (0.0, 0.0);
        for y in 0..h {
            let mut row = 0;
            for x in 0..w {
                if inside(x, y) {
                    row += 1;
                    sum_x += x as f64 + 0.5;
                    sum_y += y as f64 + 0.5;
                    cropped |= x == 0 || y == 0 || x + 1 == w || y + 1 == h;
                    let around = [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)];
                    if around.iter().any(|&(x, y)| !inside(x, y)) {
                        outline.push(camera.ray_direction(x as f64 + 0.5, y as f64 + 0.5));
                    }
                }
                sums[(y + 1) * (w + 1) + x + 1] = sums[y * (w + 1) + x + 1] + row;
            }
        }
        let count = sums[sums.len() - 1];
        if count == 0 || count as usize == w * h {
            return None;
        }
        let towards = camera.ray_direction(sum_x / f64::from(count), sum_y / f64::from(count));
        Some(Self { camera, outline, towards, origin: camera.center(), sums, cropped })
    }

    /// How far from `center` the outline's rays pass, at most: no smaller sphere about it holds the object.
    pub fn radius(&self, center: DVec3) -> f64 {
        let offset = center - self.origin;
        self.outline.iter().map(|d| offset.cross(*d).length_squared()).fold(0.0, f64::max).sqrt()
    }

    /// Whether a cube about `point` (half side `half`) projects onto some of the mask.
    fn may_contain(&self, point: DVec3, half: f64) -> bool {
        let c = &self.camera;
        let p: DVec4 = c.world_to_camera * point.extend(1.0);
        if p.z <= half {
            return false;
        }
        let (x, y) = (c.fx * p.x / p.z + c.cx, c.fy * p.y / p.z + c.cy);
        let (rx, ry) = (c.fx * half / p.z, c.fy * half / p.z);
        let (w, h) = (f64::from(c.width), f64::from(c.height));
        if self.cropped && (x - rx < 0.0 || y - ry < 0.0 || x + rx > w || y + ry > h) {
            return true;
        }
        let range =
            |low: f64, high: f64, size: f64| (low.clamp(0.0, size) as usize, high.clamp(0.0, size).ceil() as usize);
        let ((x0, x1), (y0, y1)) = (range(x - rx, x + rx, w), range(y - ry, y + ry, h));
        let at = |x: usize, y: usize| self.sums[y * (c.width as usize + 1) + x];
        at(x1, y1) + at(x0, y0) > at(x0, y1) + at(x1, y0)
    }
}

/// A sampled visual hull: the points that project into every mask.
pub(super) struct Hull {
    points: Vec<DVec3>,
    /// Middle of its box along the world's axes.
    pub box_center: DVec3,
    box_half: DVec3,
    step: f64,
}

impl Hull {
    /// Samples the cube about `center` with the given half side, then the hull's own box again more finely. None
    /// where no point projects into all masks.
    pub fn carve(silhouettes: &[Silhouette], center: DVec3, half: f64) -> Option<Self> {
        let coarse = Self::sample(silhouettes, center, DVec3::splat(half))?;
        let finer = coarse.box_half + DVec3::splat(0.5 * coarse.step);
        Self::sample(silhouettes, coarse.box_center, finer)
    }

    fn sample(silhouettes: &[Silhouette], center: DVec3, half: DVec3) -> Option<Self> {
        let step = 2.0 * half.max_element() / GRID as f64;
        let counts = (2.0 * half / step).ceil().max(DVec3::ONE);
        let low = center - 0.5 * step * (counts - DVec3::ONE);
        let (nx, ny, nz) = (counts.x as usize, counts.y as usize, counts.z as usize);
        let mut points = Vec::new();
        let (mut least, mut most) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for i in 0..nx * ny * nz {
            let p = low + step * DVec3::new((i % nx) as f64, (i / nx % ny) as f64, (i / (nx * ny)) as f64);
            if silhouettes.iter().all(|s| s.may_contain(p, 0.5 * step)) {
                points.push(p);
                (least, most) = (least.min(p), most.max(p));
            }
        }
        if points.is_empty() {
            return None;
        }
        Some(Self { points, box_center: 0.5 * (least + most), box_half: 0.5 * (most - least), step })
    }

    /// Radius of the smallest sphere about `center` that holds the hull's points.
    pub fn radius(&self, center: DVec3) -> f64 {
        self.points.iter().map(|p| p.distance_squared(center)).fold(0.0, f64::max).sqrt()
    }
}
