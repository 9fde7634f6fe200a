//! Lenses: where a point of the ideal image plane appears, and pictures without distortion.

use crate::Camera;
use image::{Rgba, RgbaImage};
use rayon::prelude::*;

/// What a lens does to the ideal image plane (depth 1), before focal lengths and principal point.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Lens {
    /// Nothing.
    #[default]
    Ideal,
    /// Brown and Conrady's model, in OpenCV's form. With `q = x^2 + y^2` a point appears at `x s + 2 p1 x y + p2 (q + 2 x^2)`,
    /// `y s + 2 p2 x y + p1 (q + 2 y^2)`, where `s = (1 + k1 q + k2 q^2 + k3 q^3 + k4 q^4) / (1 + d1 q + d2 q^2 + d3 q^3)`.
    Brown {
        /// `k1` to `k4`.
        k: [f64; 4],
        /// `d1` to `d3`; OpenCV calls them `k4` to `k6`.
        d: [f64; 3],
        /// `p1`, `p2`.
        p: [f64; 2],
    },
    /// OpenCV's fisheye (Kannala and Brandt): a ray at angle `t` from the axis appears at the distance
    /// `t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)` from the middle.
    Fisheye {
        /// `k1` to `k4`.
        k: [f64; 4],
    },
}

impl Lens {
    /// Brown's model without denominator; the ideal lens where all are zero.
    pub fn brown(k: [f64; 4], p: [f64; 2]) -> Self {
        match k.iter().chain(&p).all(|v| *v == 0.0) {
            true => Self::Ideal,
            false => Self::Brown { k, d: [0.0; 3], p },
        }
    }

    /// Where the point `(x, y)` of the ideal image plane appears.
    pub fn apply(&self, x: f64, y: f64) -> (f64, f64) {
        let q = x * x + y * y;
        match *self {
            Self::Ideal => (x, y),
            Self::Brown { k, d, p } => {
                let s = (1.0 + q * (k[0] + q * (k[1] + q * (k[2] + q * k[3]))))
                    / (1.0 + q * (d[0] + q * (d[1] + q * d[2])));
                (
                    x * s + 2.0 * p[0] * x * y + p[1] * (q + 2.0 * x * x),
                    y * s + 2.0 * p[1] * x * y + p[0] * (q + 2.0 * y * y),
                )
            }
            Self::Fisheye { k } => {
                let r = q.sqrt();
                if r < 1e-9 {
                    return (x, y);
                }
                let t = r.atan();
                let u = t * t;
                let s = t * (1.0 + u * (k[0] + u * (k[1] + u * (k[2] + u * k[3])))) / r;
                (x * s, y * s)
            }
        }
    }

    /// Derivatives of [`Lens::apply`] by central differences: `[[dx'/dx, dx'/dy], [dy'/dx, dy'/dy]]`.
    fn jacobian(&self, x: f64, y: f64) -> [[f64; 2]; 2] {
        const H: f64 = 1e-6;
        let ((xr, yr), (xl, yl)) = (self.apply(x + H, y), self.apply(x - H, y));
        let ((xd, yd), (xu, yu)) = (self.apply(x, y + H), self.apply(x, y - H));
        [[(xr - xl) / (2.0 * H), (xd - xu) / (2.0 * H)], [(yr - yl) / (2.0 * H), (yd - yu) / (2.0 * H)]]
    }

    /// The point of the ideal image plane that appears at `(u, v)`: Newton's method from there. None where the lens shows no
    /// such point (beyond its fold, or behind a fisheye's horizon).
    pub fn invert(&self, u: f64, v: f64) -> Option<(f64, f64)> {
        let (mut x, mut y) = match self {
            Self::Ideal => return Some((u, v)),
            // The angle first; the tangent is too steep to start from for wide fisheyes.
            Self::Fisheye { k } => return invert_fisheye(k, u, v),
            Self::Brown { .. } => (u, v),
        };
        for _ in 0..50 {
            let (xd, yd) = self.apply(x, y);
            let (ex, ey) = (xd - u, yd - v);
            if ex.hypot(ey) < 1e-12 * (1.0 + u.hypot(v)) {
                break;
            }
            let [[a, b], [c, d]] = self.jacobian(x, y);
            let area = a * d - b * c;
            // Beyond the fold the map turns over; a step from there would land anywhere.
            if area.is_nan() || area < 1e-3 {
                return None;
            }
            x -= (d * ex - b * ey) / area;
            y -= (a * ey - c * ex) / area;
        }
        let (xd, yd) = self.apply(x, y);
        ((xd - u).hypot(yd - v) < 1e-8).then_some((x, y))
    }

    /// Whether the picture that a pinhole with these intrinsics would have taken is shown one to one: no fold within it.
    pub fn is_one_to_one(&self, camera: &Camera) -> bool {
        const STEPS: usize = 32;
        (0..=STEPS).all(|i| {
            (0..=STEPS).all(|j| {
                let x = (f64::from(camera.width) * j as f64 / STEPS as f64 - camera.cx) / camera.fx;
                let y = (f64::from(camera.height) * i as f64 / STEPS as f64 - camera.cy) / camera.fy;
                let [[a, b], [c, d]] = self.jacobian(x, y);
                a * d - b * c > 1e-3 // false for NaN
            })
        })
    }

    /// The picture that a pinhole with the same intrinsics would have taken. Pixels that the lens did not show are transparent.
    /// Bilinear, in premultiplied alpha.
    pub fn undistort(&self, image: &RgbaImage, camera: &Camera) -> RgbaImage {
        self.redraw(image, |u, v| {
            let (x, y) = self.apply((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy);
            Some((x * camera.fx + camera.cx, y * camera.fy + camera.cy))
        })
    }

    /// The way back: what this lens would have shown of a pinhole's picture.
    pub fn distort(&self, image: &RgbaImage, camera: &Camera) -> RgbaImage {
        self.redraw(image, |u, v| {
            let (x, y) = self.invert((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)?;
            Some((x * camera.fx + camera.cx, y * camera.fy + camera.cy))
        })
    }

    fn redraw(&self, image: &RgbaImage, from: impl Fn(f64, f64) -> Option<(f64, f64)> + Sync) -> RgbaImage {
        if *self == Self::Ideal {
            return image.clone();
        }
        let mut out = RgbaImage::new(image.width(), image.height());
        let row = 4 * image.width() as usize;
        out.par_chunks_exact_mut(row.max(4)).enumerate().for_each(|(i, row)| {
            for (j, target) in row.as_chunks_mut::<4>().0.iter_mut().enumerate() {
                if let Some((x, y)) = from(j as f64 + 0.5, i as f64 + 0.5) {
                    *target = sample(image, x, y).0;
                }
            }
        });
        out
    }
}

fn invert_fisheye(k: &[f64; 4], u: f64, v: f64) -> Option<(f64, f64)> {
    let r = u.hypot(v);
    if r < 1e-12 {
        return Some((u, v));
    }
    let mut t = r.min(1.5);
    for _ in 0..50 {
        let q = t * t;
        let value = t * (1.0 + q * (k[0] + q * (k[1] + q * (k[2] + q * k[3]))));
        let slope = 1.0 + q * (3.0 * k[0] + q * (5.0 * k[1] + q * (7.0 * k[2] + q * 9.0 * k[3])));
        if slope.is_nan() || slope < 1e-3 {
            return None;
        }
        let step = (value - r) / slope;
        t -= step;
        if step.abs() < 1e-14 {
            break;
        }
    }
    // From a right angle on there is nothing on the image plane.
    (t > 0.0 && t < std::f64::consts::FRAC_PI_2 - 1e-6).then(|| (u * t.tan() / r, v * t.tan() / r))
}

/// The image at a point in pixels (centres at +0.5); transparent outside, with the border pixels' own half extent kept.
fn sample(image: &RgbaImage, x: f64, y: f64) -> Rgba<u8> {
    let (w, h) = (f64::from(image.width()), f64::from(image.height()));
    if !((0.0..=w).contains(&x) && (0.0..=h).contains(&y)) {
        return Rgba([0; 4]);
    }
    let (x, y) = ((x - 0.5).clamp(0.0, w - 1.0), (y - 0.5).clamp(0.0, h - 1.0));
    let (j, i) = (x as u32, y as u32);
    let (fx, fy) = (x.fract(), y.fract());
    let (right, below) = ((j + 1).min(image.width() - 1), (i + 1).min(image.height() - 1));
    let corners = [
        (j, i, (1.0 - fx) * (1.0 - fy)),
        (right, i, fx * (1.0 - fy)),
        (j, below, (1.0 - fx) * fy),
        (right, below, fx * fy),
    ];
    let mut sum = [0.0; 4];
    for (column, row, weight) in corners {
        let p = image.get_pixel(column, row).0;
        let alpha = weight * f64::from(p[3]);
        (0..3).for_each(|c| sum[c] += alpha * f64::from(p[c]));
        sum[3] += alpha;
    }
    if sum[3] < 0.5 {
        return Rgba([0; 4]);
    }
    let colour = |c: usize| (sum[c] / sum[3]).round() as u8;
    Rgba([colour(0), colour(1), colour(2), sum[3].round() as u8])
}
