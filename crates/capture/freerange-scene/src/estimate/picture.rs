//! A photo as the cut sees it: small, in Lab, with the contrast between neighbors.

use crate::camera::{Camera, View, image_ops::resize_area};
use glam::{DVec3, DVec4, Vec3};

/// Lengths of the four steps to a pixel's right, lower, lower right and lower left neighbors.
pub const STEPS: [(i32, i32, f32); 4] =
    [(1, 0, 1.0), (0, 1, 1.0), (1, 1, std::f32::consts::SQRT_2), (-1, 1, std::f32::consts::SQRT_2)];

/// A photo at working size.
#[derive(Clone)]
pub struct Picture {
    /// Its camera at this size.
    pub camera: Camera,
    /// CIE Lab colors, `[h, w]`.
    pub lab: Vec<Vec3>,
    /// The same, a little blurred: to compare with other photos.
    pub smooth: Vec<Vec3>,
    /// Whether the photo shows anything there (an undistorted one has empty corners).
    pub valid: Vec<bool>,
    /// How much it costs to part two neighbors: 1 where they are alike, near 0 across an edge. `[h, w, 4]`, in the order of [`STEPS`].
    pub alike: Vec<[f32; 4]>,
}

impl Picture {
    /// The view with its longer side at most `side` pixels.
    pub fn of(view: &View, side: u32) -> Self {
        let View { camera, image, .. } = shrunk(view, side);
        let (nw, nh) = image.dimensions();
        let lab: Vec<Vec3> = image.pixels().map(|p| lab([p[0], p[1], p[2]])).collect();
        let valid = image.pixels().map(|p| p[3] >= 128).collect();
        let (w, h) = (nw as usize, nh as usize);
        let smooth = blur(&lab, w, h);
        let mut alike = vec![[0.0; 4]; w * h];
        let (mut sum, mut count) = (0.0f64, 0.0f64);
        for y in 0..h {
            for x in 0..w {
                for (k, (dx, dy, _)) in STEPS.into_iter().enumerate() {
                    if let Some(other) = neighbor(x, y, dx, dy, w, h) {
                        let d = lab[y * w + x].distance_squared(lab[other]);
                        alike[y * w + x][k] = d;
                        sum += f64::from(d);
                        count += 1.0;
                    }
                }
            }
        }
        // Rother et al. 2004: contrast relative to the picture's own.
        let beta = (0.5 * count.max(1.0) / (sum + 1e-6)) as f32;
        for costs in &mut alike {
            for (cost, (_, _, length)) in costs.iter_mut().zip(STEPS) {
                *cost = (-beta * *cost).exp() / length;
            }
        }
        Self { camera, lab, smooth, valid, alike }
    }

    /// What a hull needs of the view at that size: where it shows anything.
    pub fn outlined(view: &View, side: u32) -> Self {
        let View { camera, image, .. } = shrunk(view, side);
        Self { valid: image.pixels().map(|p| p[3] >= 128).collect(), ..Self::blank(camera) }
    }

    /// The camera of the view at that size, and nothing that it shows.
    pub fn unseen(view: &View, side: u32) -> Self {
        let (w, h) = shrunk_to(view, side);
        Self::blank(view.camera.resized(w, h))
    }

    fn blank(camera: Camera) -> Self {
        Self { camera, lab: Vec::new(), smooth: Vec::new(), valid: Vec::new(), alike: Vec::new() }
    }

    /// What other pictures are compared with: without its own colors and edges.
    pub fn into_comparable(mut self) -> Self {
        (self.lab, self.alike) = (Vec::new(), Vec::new());
        self
    }

    pub fn width(&self) -> usize {
        self.camera.width as usize
    }

    pub fn height(&self) -> usize {
        self.camera.height as usize
    }

    /// Where a point of the world appears, in pixels, and its depth.
    pub fn project(&self, point: DVec3) -> (f64, f64, f64) {
        let c = &self.camera;
        let p: DVec4 = c.world_to_camera * point.extend(1.0);
        (c.fx * p.x / p.z + c.cx, c.fy * p.y / p.z + c.cy, p.z)
    }
}

/// The view with its longer side at most `side` pixels.
pub fn shrunk(view: &View, side: u32) -> View {
    let (w, h) = shrunk_to(view, side);
    View { name: view.name.clone(), camera: view.camera.resized(w, h), image: resize_area(&view.image, w, h) }
}

/// Width and height of the view with its longer side at most `side` pixels.
fn shrunk_to(view: &View, side: u32) -> (u32, u32) {
    let (w, h) = view.image.dimensions();
    let longer = w.max(h);
    let small = |s: u32| ((u64::from(s) * u64::from(side) + u64::from(longer) / 2) / u64::from(longer)).max(1) as u32;
    if longer > side { (small(w), small(h)) } else { (w, h) }
}

fn neighbor(x: usize, y: usize, dx: i32, dy: i32, w: usize, h: usize) -> Option<usize> {
    let (x, y) = (x.checked_add_signed(dx as isize)?, y.checked_add_signed(dy as isize)?);
    (x < w && y < h).then(|| y * w + x)
}

/// Three taps along each axis, 1 2 1.
fn blur(values: &[Vec3], w: usize, h: usize) -> Vec<Vec3> {
    let pass = |values: &[Vec3], dx: usize, dy: usize| -> Vec<Vec3> {
        (0..w * h)
            .map(|i| {
                let (x, y) = (i % w, i / w);
                let before = y.saturating_sub(dy) * w + x.saturating_sub(dx);
                let after = (y + dy).min(h - 1) * w + (x + dx).min(w - 1);
                0.25 * values[before] + 0.5 * values[i] + 0.25 * values[after]
            })
            .collect()
    };
    pass(&pass(values, 1, 0), 0, 1)
}

/// `values` (`[h, w]`) at a point in pixels, bilinear, the border's values beyond it.
pub fn bilinear<T>(values: &[T], w: usize, h: usize, x: f64, y: f64) -> T
where
    T: Copy + std::ops::Add<Output = T> + std::ops::Mul<f32, Output = T>,
{
    let (x, y) = ((x - 0.5).clamp(0.0, (w - 1) as f64), (y - 0.5).clamp(0.0, (h - 1) as f64));
    let (j, i) = (x as usize, y as usize);
    let (fx, fy) = (x.fract() as f32, y.fract() as f32);
    let (right, below) = ((j + 1).min(w - 1), (i + 1).min(h - 1));
    let at = |i: usize, j: usize| values[i * w + j];
    (at(i, j) * (1.0 - fx) + at(i, right) * fx) * (1.0 - fy) + (at(below, j) * (1.0 - fx) + at(below, right) * fx) * fy
}

/// CIE Lab (D65) of an sRGB color.
pub fn lab(rgb: [u8; 3]) -> Vec3 {
    let linear = rgb.map(|v| {
        let v = f32::from(v) / 255.0;
        if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
    });
    let [r, g, b] = linear;
    let xyz = [
        (0.412_456_4 * r + 0.357_576_1 * g + 0.180_437_5 * b) / 0.950_47,
        0.212_672_9 * r + 0.715_152_2 * g + 0.072_175 * b,
        (0.019_333_9 * r + 0.119_192 * g + 0.950_304_1 * b) / 1.088_83,
    ];
    let [x, y, z] = xyz.map(|t| if t > 0.008_856 { t.cbrt() } else { 7.787 * t + 16.0 / 116.0 });
    Vec3::new(116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lab_of_known_colors() {
        // Bruce Lindbloom's calculator, D65.
        for (rgb, expected) in [
            ([255, 255, 255], Vec3::new(100.0, 0.0, 0.0)),
            ([0, 0, 0], Vec3::ZERO),
            ([255, 0, 0], Vec3::new(53.24, 80.09, 67.20)),
            ([0, 0, 255], Vec3::new(32.30, 79.19, -107.86)),
        ] {
            assert!(lab(rgb).distance(expected) < 0.05, "{rgb:?}: {}", lab(rgb));
        }
    }
}
