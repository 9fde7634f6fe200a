//! A view as all the others have it.

use super::picture;
use glam::Vec3;
use image::{
    RgbaImage,
    imageops::{crop_imm, replace},
};

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

/// What others have of a view, kept in little memory: the part of the image that shows anything, in bytes.
pub(super) struct Kept {
    size: (u32, u32),
    at: (u32, u32),
    part: RgbaImage,
    /// As [`Shown::scale`].
    pub(super) scale: f32,
}

impl Kept {
    pub(super) fn of(image: &RgbaImage) -> Self {
        let (mut low, mut high) = (image.dimensions(), (0, 0));
        for (x, y, _) in image.enumerate_pixels().filter(|(.., p)| p[3] > 0) {
            low = (low.0.min(x), low.1.min(y));
            high = (high.0.max(x + 1), high.1.max(y + 1));
        }
        let (w, h) = (high.0.saturating_sub(low.0), high.1.saturating_sub(low.1));
        Self { size: image.dimensions(), at: low, part: crop_imm(image, low.0, low.1, w, h).to_image(), scale: 0.0 }
    }

    /// The whole image. Where it shows nothing it has no color, which nobody asks for there.
    pub(super) fn image(&self) -> RgbaImage {
        let mut image = RgbaImage::new(self.size.0, self.size.1);
        replace(&mut image, &self.part, self.at.0.into(), self.at.1.into());
        image
    }

    pub(super) fn shown(&self) -> Shown {
        Shown::of(&self.image(), self.scale)
    }
}
