//! Lenses: where a ray appears, and pictures without distortion.

use crate::camera::Camera;
use glam::{DVec2, DVec3};
use image::{Rgba, RgbaImage};
use rayon::prelude::*;
use std::f64::consts::{FRAC_PI_2, PI};

/// Where a lens shows rays, in units of the focal lengths from the principal point.
///
/// Models of the first kind move points of the ideal image plane (depth 1). Those of the second kind take the angle `t` between ray and
/// axis: `a = t (x, y) / |(x, y)|`, which goes on beyond a right angle. `q` is the squared length of the point or of `a`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Lens {
    /// Nothing is moved.
    #[default]
    Ideal,
    /// Brown and Conrady's model, in OpenCV's form. A point appears at `x s + 2 p1 x y + p2 (q + 2 x^2)`,
    /// `y s + 2 p2 x y + p1 (q + 2 y^2)`, where `s = (1 + k1 q + k2 q^2 + k3 q^3 + k4 q^4) / (1 + d1 q + d2 q^2 + d3 q^3)`.
    Brown {
        /// `k1` to `k4`.
        k: [f64; 4],
        /// `d1` to `d3`; OpenCV calls them `k4` to `k6`.
        d: [f64; 3],
        /// `p1`, `p2`.
        p: [f64; 2],
    },
    /// Fitzgibbon's division model: a point appears at the radius `r` for which `r / (1 + k r^2)` is the point's own.
    Division {
        /// `k`.
        k: f64,
    },
    /// Devernay and Faugeras' field-of-view model: a point at radius `r` appears at the radius `atan(2 r tan(w / 2)) / w`.
    Fov {
        /// `w`, in radians; not zero.
        omega: f64,
    },
    /// OpenCV's fisheye (Kannala and Brandt), of the second kind: `a (1 + k1 q + k2 q^2 + k3 q^3 + k4 q^4)`.
    Fisheye {
        /// `k1` to `k4`.
        k: [f64; 4],
    },
    /// COLMAP's THIN_PRISM_FISHEYE, of the second kind: Brown's model without denominator on `a`, plus `s q`.
    ThinPrism {
        /// `k1` to `k4`.
        k: [f64; 4],
        /// `p1`, `p2`.
        p: [f64; 2],
        /// `sx1`, `sy1`.
        s: [f64; 2],
    },
    /// Project Aria's model (COLMAP's RAD_TAN_THIN_PRISM_FISHEYE), of the second kind. With `b = a (1 + k0 q + .. + k5 q^6)` and `n = |b|^2`
    /// a ray appears at `b + 2 b (b . p) + n p + (s0 n + s1 n^2, s2 n + s3 n^2)`.
    Aria {
        /// `k0` to `k5`.
        k: [f64; 6],
        /// `p0`, `p1`.
        p: [f64; 2],
        /// `s0` to `s3`.
        s: [f64; 4],
    },
    /// The enhanced unified camera model: `(x, y) / (alpha sqrt(beta (x^2 + y^2) + z^2) + (1 - alpha) z)`.
    Eucm {
        /// `alpha`, 0 to 1.
        alpha: f64,
        /// `beta`, above 0.
        beta: f64,
    },
    /// All around: longitude and latitude in radians, x to the right and y down.
    Equirectangular,
}

impl Lens {
    /// Brown's model without denominator; the ideal lens where all are zero.
    pub fn brown(k: [f64; 4], p: [f64; 2]) -> Self {
        match k.iter().chain(&p).all(|v| *v == 0.0) {
            true => Self::Ideal,
            false => Self::Brown { k, d: [0.0; 3], p },
        }
    }

    /// Whether it shows rays far from its axis, of which no one pinhole could show all.
    pub fn is_wide(&self) -> bool {
        !matches!(self, Self::Ideal | Self::Brown { .. } | Self::Division { .. })
    }

    /// Where the point `(x, y)` of the ideal image plane appears; NaN where it does not.
    pub fn apply(&self, x: f64, y: f64) -> (f64, f64) {
        self.project(DVec3::new(x, y, 1.0)).map_or((f64::NAN, f64::NAN), |p| (p.x, p.y))
    }

    /// Where a ray appears (right, down, forward; of any length); none where the model does not say.
    pub fn project(&self, ray: DVec3) -> Option<DVec2> {
        let shown = match *self {
            Self::Eucm { alpha, beta } => {
                let distance = (beta * ray.truncate().length_squared() + ray.z * ray.z).sqrt();
                let depth = alpha * distance + (1.0 - alpha) * ray.z;
                // Rays farther behind appear where others do (Usenko et al. 2018, for the unified model).
                let least = -if alpha > 0.5 { (1.0 - alpha) / alpha } else { alpha / (1.0 - alpha) };
                (depth > 1e-12 * distance && ray.z > least * distance).then(|| ray.truncate() / depth)?
            }
            Self::Equirectangular => {
                let level = ray.x.hypot(ray.z);
                DVec2::new(ray.x.atan2(ray.z), ray.y.atan2(level))
            }
            Self::Ideal | Self::Brown { .. } | Self::Division { .. } | Self::Fov { .. } => {
                (ray.z > 0.0).then(|| self.moved(ray.truncate() / ray.z))??
            }
            Self::Fisheye { .. } | Self::ThinPrism { .. } | Self::Aria { .. } => {
                let (sideways, across) = (ray.truncate(), ray.truncate().length());
                // Near the axis angle and tangent are the same.
                let factor = if across < 1e-9 * ray.z { 1.0 / ray.z } else { across.atan2(ray.z) / across };
                factor.is_finite().then(|| self.moved(factor * sideways))??
            }
        };
        shown.is_finite().then_some(shown)
    }

    /// What the models do to a point of the image plane, or to `a`.
    fn moved(&self, a: DVec2) -> Option<DVec2> {
        let q = a.length_squared();
        Some(match *self {
            Self::Brown { k, d, p } => brown(a, radial(&k, q) / radial(&d, q), p),
            Self::Division { k } => {
                let root = 1.0 - 4.0 * k * q;
                (root >= 0.0).then(|| a * (2.0 / (1.0 + root.sqrt())))?
            }
            Self::Fov { omega } => {
                let (r, steep) = (q.sqrt(), 2.0 * (0.5 * omega).tan());
                if r < 1e-9 { a * (steep / omega) } else { a * ((r * steep).atan() / (r * omega)) }
            }
            Self::Fisheye { k } => a * radial(&k, q),
            Self::ThinPrism { k, p, s } => brown(a, radial(&k, q), p) + q * DVec2::from(s),
            Self::Aria { k, p, s } => {
                let (b, p) = (a * radial(&k, q), DVec2::from(p));
                let n = b.length_squared();
                b + 2.0 * b.dot(p) * b + n * p + DVec2::new(s[0] + s[1] * n, s[2] + s[3] * n) * n
            }
            Self::Ideal | Self::Eucm { .. } | Self::Equirectangular => a,
        })
    }

    /// Derivatives of [`Self::moved`] by central differences, as columns.
    fn slopes(&self, a: DVec2) -> Option<(DVec2, DVec2)> {
        const H: f64 = 1e-6;
        let along = |d: DVec2| Some((self.moved(a + d)? - self.moved(a - d)?) / (2.0 * H));
        Some((along(DVec2::X * H)?, along(DVec2::Y * H)?))
    }

    /// The ray that appears at `(u, v)`, of length 1; none where the lens shows no such ray (beyond its fold).
    pub fn ray(&self, u: f64, v: f64) -> Option<DVec3> {
        let shown = DVec2::new(u, v);
        match *self {
            Self::Ideal => Some(shown.extend(1.0).normalize()),
            Self::Division { k } => {
                let depth = 1.0 + k * shown.length_squared();
                (depth > 1e-9).then(|| (shown / depth).extend(1.0).normalize())
            }
            Self::Fov { omega } => {
                let r = shown.length();
                let angle = r * omega;
                let factor = if r < 1e-9 {
                    omega / (2.0 * (0.5 * omega).tan())
                } else {
                    angle.tan() / (2.0 * (0.5 * omega).tan() * r)
                };
                (angle < FRAC_PI_2 - 1e-6).then(|| (shown * factor).extend(1.0).normalize())
            }
            Self::Brown { .. } => Some(self.inverted(shown)?.extend(1.0).normalize()),
            Self::Fisheye { .. } | Self::ThinPrism { .. } | Self::Aria { .. } => {
                let a = self.inverted(shown)?;
                let angle = a.length();
                let sideways = if angle < 1e-12 { a } else { a * (angle.sin() / angle) };
                (angle < PI).then(|| sideways.extend(angle.cos()))
            }
            Self::Eucm { alpha, beta } => {
                let q = shown.length_squared();
                let root = 1.0 - (2.0 * alpha - 1.0) * beta * q;
                let depth = (1.0 - beta * alpha * alpha * q) / (alpha * root.max(0.0).sqrt() + (1.0 - alpha));
                (root >= 0.0).then(|| shown.extend(depth).normalize())
            }
            Self::Equirectangular => {
                let inside = u.abs() <= PI + 1e-9 && v.abs() <= FRAC_PI_2 + 1e-9;
                inside.then(|| DVec3::new(v.cos() * u.sin(), v.sin(), v.cos() * u.cos()))
            }
        }
    }

    /// The inverse of [`Self::moved`] by Newton's method.
    fn inverted(&self, shown: DVec2) -> Option<DVec2> {
        let mut a = match self {
            Self::Fisheye { .. } | Self::ThinPrism { .. } | Self::Aria { .. } => shown.clamp_length_max(0.5 * PI),
            _ => shown,
        };
        for _ in 0..50 {
            let off = self.moved(a)? - shown;
            if off.length() < 1e-12 * (1.0 + shown.length()) {
                break;
            }
            let (right, down) = self.slopes(a)?;
            let area = right.perp_dot(down);
            // Beyond the fold the map turns over; a step from there would land anywhere.
            if area.is_nan() || area < 1e-3 {
                return None;
            }
            a -= DVec2::new(down.y * off.x - down.x * off.y, right.x * off.y - right.y * off.x) / area;
        }
        // The fold is not crossed between the axis and the point.
        let sound = |t: f64| self.slopes(t * a).is_some_and(|(right, down)| right.perp_dot(down) > 1e-3);
        ((self.moved(a)? - shown).length() < 1e-8 && (1..=8).all(|i| sound(f64::from(i) / 8.0))).then_some(a)
    }

    /// The point of the ideal image plane that appears at `(u, v)`; none where the lens shows no such point (beyond its
    /// fold, or behind a fisheye's horizon).
    pub fn invert(&self, u: f64, v: f64) -> Option<(f64, f64)> {
        let ray = self.ray(u, v)?;
        (ray.z > 1e-6).then(|| (ray.x / ray.z, ray.y / ray.z))
    }

    /// Whether the picture that a pinhole with these intrinsics would have taken is shown one to one: no fold within it.
    pub fn is_one_to_one(&self, camera: &Camera) -> bool {
        const STEPS: usize = 32;
        const H: f64 = 1e-6;
        let at = |x: f64, y: f64| self.project(DVec3::new(x, y, 1.0));
        (0..=STEPS).all(|i| {
            (0..=STEPS).all(|j| {
                let x = (f64::from(camera.width) * j as f64 / STEPS as f64 - camera.cx) / camera.fx;
                let y = (f64::from(camera.height) * i as f64 / STEPS as f64 - camera.cy) / camera.fy;
                let area = || {
                    let right = (at(x + H, y)? - at(x - H, y)?) / (2.0 * H);
                    let down = (at(x, y + H)? - at(x, y - H)?) / (2.0 * H);
                    Some(right.perp_dot(down))
                };
                // A wide lens is compressed towards its rim, and never folds there.
                area().is_some_and(|a| a > if self.is_wide() { 0.0 } else { 1e-3 })
            })
        })
    }

    /// The picture that a pinhole with the same intrinsics would have taken. Pixels that the lens did not show are transparent.
    /// Bilinear, in premultiplied alpha.
    pub fn undistort(&self, image: &RgbaImage, camera: &Camera) -> RgbaImage {
        if *self == Self::Ideal {
            return image.clone();
        }
        self.seen_by(image, camera, camera)
    }

    /// What the pinhole `seen` shows of a picture that was taken through this lens, with the intrinsics and pose of `taken`, from the same
    /// place. Pixels that the picture does not show are transparent.
    pub fn seen_by(&self, image: &RgbaImage, taken: &Camera, seen: &Camera) -> RgbaImage {
        let turn =
            glam::DMat3::from_mat4(taken.world_to_camera) * glam::DMat3::from_mat4(seen.world_to_camera).transpose();
        let (all_around, mask) = (*self == Self::Equirectangular, self.is_wide());
        redraw(image, (seen.width, seen.height), |x, y| {
            let ray = turn * DVec3::new((x - seen.cx) / seen.fx, (y - seen.cy) / seen.fy, 1.0);
            let p = self.project(ray)?;
            // Several rays appear at one place beyond a wide lens's fold; the first is shown.
            if mask && !all_around && self.ray(p.x, p.y).is_none_or(|r| r.dot(ray) < 0.999_999 * ray.length()) {
                return None;
            }
            let (u, v) = (p.x * taken.fx + taken.cx, p.y * taken.fy + taken.cy);
            // The two sides of a picture of all around are the same place.
            Some((if all_around { u.rem_euclid(f64::from(image.width())) } else { u }, v))
        })
    }

    /// The way back: what this lens would have shown of a pinhole's picture.
    pub fn distort(&self, image: &RgbaImage, camera: &Camera) -> RgbaImage {
        if *self == Self::Ideal {
            return image.clone();
        }
        self.taken_of(image, camera, camera)
    }

    /// The way back of [`Self::seen_by`], in the size of `taken`.
    pub fn taken_of(&self, image: &RgbaImage, seen: &Camera, taken: &Camera) -> RgbaImage {
        let turn =
            glam::DMat3::from_mat4(seen.world_to_camera) * glam::DMat3::from_mat4(taken.world_to_camera).transpose();
        redraw(image, (taken.width, taken.height), |u, v| {
            let ray = turn * self.ray((u - taken.cx) / taken.fx, (v - taken.cy) / taken.fy)?;
            let ahead = ray.z > 1e-6;
            ahead.then(|| (ray.x / ray.z * seen.fx + seen.cx, ray.y / ray.z * seen.fy + seen.cy))
        })
    }
}

/// `1 + k1 q + k2 q^2 + ..`
fn radial(k: &[f64], q: f64) -> f64 {
    1.0 + q * k.iter().rev().fold(0.0, |sum, k| sum * q + k)
}

fn brown(a: DVec2, s: f64, [p1, p2]: [f64; 2]) -> DVec2 {
    let q = a.length_squared();
    DVec2::new(
        a.x * s + 2.0 * p1 * a.x * a.y + p2 * (q + 2.0 * a.x * a.x),
        a.y * s + 2.0 * p2 * a.x * a.y + p1 * (q + 2.0 * a.y * a.y),
    )
}

fn redraw(image: &RgbaImage, size: (u32, u32), from: impl Fn(f64, f64) -> Option<(f64, f64)> + Sync) -> RgbaImage {
    let mut out = RgbaImage::new(size.0, size.1);
    let row = 4 * size.0 as usize;
    out.par_chunks_exact_mut(row.max(4)).enumerate().for_each(|(i, row)| {
        for (j, target) in row.as_chunks_mut::<4>().0.iter_mut().enumerate() {
            if let Some((x, y)) = from(j as f64 + 0.5, i as f64 + 0.5) {
                *target = sample(image, x, y).0;
            }
        }
    });
    out
}

/// The image at a point in pixels (centers at +0.5); transparent outside, with the border pixels' own half extent kept.
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
    let color = |c: usize| (sum[c] / sum[3]).round() as u8;
    Rgba([color(0), color(1), color(2), sum[3].round() as u8])
}
