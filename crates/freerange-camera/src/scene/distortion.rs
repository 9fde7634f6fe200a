//! Lens distortion (Brown and Conrady, as nerfstudio writes it) and its removal.

use crate::{Camera, CameraError, error::Place};
use image::{Rgba, RgbaImage};

/// Radial (`k`) and tangential (`p`) coefficients. A point `(x, y)` of the ideal image plane at depth 1, with
/// `q = x^2 + y^2`, appears at
/// `x (1 + k1 q + k2 q^2 + k3 q^3 + k4 q^4) + 2 p1 x y + p2 (q + 2 x^2)`, and `y` likewise with `p1`, `p2` swapped.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Distortion {
    /// `k1` to `k4`.
    pub k: [f64; 4],
    /// `p1`, `p2`.
    pub p: [f64; 2],
}

impl Distortion {
    /// Whether there is none.
    pub fn is_zero(&self) -> bool {
        *self == Self::default()
    }

    /// Where a point of the ideal image plane (depth 1) appears.
    pub fn apply(&self, x: f64, y: f64) -> (f64, f64) {
        let ([k1, k2, k3, k4], [p1, p2]) = (self.k, self.p);
        let q = x * x + y * y;
        let radial = 1.0 + q * (k1 + q * (k2 + q * (k3 + q * k4)));
        (x * radial + 2.0 * p1 * x * y + p2 * (q + 2.0 * x * x), y * radial + 2.0 * p2 * x * y + p1 * (q + 2.0 * y * y))
    }

    /// Refuses coefficients that fold the image onto itself: then no undistorted image exists.
    pub(super) fn check(&self, camera: &Camera, place: &Place) -> Result<(), CameraError> {
        const STEPS: usize = 32;
        for i in 0..=STEPS {
            for j in 0..=STEPS {
                let x = (f64::from(camera.width) * j as f64 / STEPS as f64 - camera.cx) / camera.fx;
                let y = (f64::from(camera.height) * i as f64 / STEPS as f64 - camera.cy) / camera.fy;
                let h = 1e-5;
                let ((xr, yr), (xl, yl)) = (self.apply(x + h, y), self.apply(x - h, y));
                let ((xd, yd), (xu, yu)) = (self.apply(x, y + h), self.apply(x, y - h));
                let area = ((xr - xl) * (yd - yu) - (xd - xu) * (yr - yl)) / (4.0 * h * h);
                let one_to_one = area > 0.05; // false for NaN
                if !one_to_one {
                    return Err(CameraError::Field {
                        place: place.clone(),
                        field: "k1, k2, k3, k4, p1, p2".into(),
                        expected: "a distortion that maps the image one to one".into(),
                        found: format!("{:?}, {:?}, which folds it", self.k, self.p),
                    });
                }
            }
        }
        Ok(())
    }

    /// The image that a pinhole with the same intrinsics would have taken. Pixels that the lens did not see are
    /// transparent. Bilinear, in premultiplied alpha.
    pub fn undistort(&self, image: &RgbaImage, camera: &Camera) -> RgbaImage {
        RgbaImage::from_fn(image.width(), image.height(), |j, i| {
            let x = (f64::from(j) + 0.5 - camera.cx) / camera.fx;
            let y = (f64::from(i) + 0.5 - camera.cy) / camera.fy;
            let (x, y) = self.apply(x, y);
            sample(image, x * camera.fx + camera.cx, y * camera.fy + camera.cy)
        })
    }
}

/// The image at a point in pixels (centres at +0.5); transparent outside, with the border pixels' own half extent kept.
fn sample(image: &RgbaImage, x: f64, y: f64) -> Rgba<u8> {
    let (w, h) = (f64::from(image.width()), f64::from(image.height()));
    if !((0.0..=w).contains(&x) && (0.0..=h).contains(&y)) {
        return Rgba([0; 4]);
    }
    let (x, y) = ((x - 0.5).clamp(0.0, w - 1.0), (y - 0.5).clamp(0.0, h - 1.0));
    let (j, i) = (x.floor() as u32, y.floor() as u32);
    let (fx, fy) = (x - x.floor(), y - y.floor());
    let (right, below) = ((j + 1).min(image.width() - 1), (i + 1).min(image.height() - 1));
    let mut sum = [0.0; 4];
    for (column, row, weight) in [
        (j, i, (1.0 - fx) * (1.0 - fy)),
        (right, i, fx * (1.0 - fy)),
        (j, below, (1.0 - fx) * fy),
        (right, below, fx * fy),
    ] {
        let p = image.get_pixel(column, row).0;
        let alpha = weight * f64::from(p[3]);
        for c in 0..3 {
            sum[c] += alpha * f64::from(p[c]);
        }
        sum[3] += alpha;
    }
    if sum[3] < 0.5 {
        return Rgba([0; 4]);
    }
    let colour = |c: usize| (sum[c] / sum[3]).round() as u8;
    Rgba([colour(0), colour(1), colour(2), sum[3].round() as u8])
}
