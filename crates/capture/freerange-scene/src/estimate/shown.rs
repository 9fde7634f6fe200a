//! A view as all the others have it.

use super::picture;
use glam::Vec3;
use image::RgbaImage;

/// Their alpha and one less it are raised by this before their ratio counts: log odds of 3 at most.
const DOUBT: f32 = 0.05;

/// A view as the others have it.
pub(super) struct Shown {
    /// `[h, w]`
    pub(super) alpha: Vec<f32>,
    /// `[h, w]`, Lab
    pub(super) color: Vec<Vec3>,
    /// How far colors may differ from it and still be the object's (Lab).
    pub(super) scale: f32,
}

impl Shown {
    pub(super) fn of(image: &RgbaImage, scale: f32) -> Self {
        Self {
            alpha: image.pixels().map(|p| f32::from(p[3]) / 255.0).collect(),
            color: image.pixels().map(|p| picture::lab([p[0], p[1], p[2]])).collect(),
            scale,
        }
    }

    /// Log odds for the object by what is there alone.
    pub(super) fn odds(&self, k: usize) -> f32 {
        ((self.alpha[k] + DOUBT) / (1.0 - self.alpha[k] + DOUBT)).ln()
    }
}
