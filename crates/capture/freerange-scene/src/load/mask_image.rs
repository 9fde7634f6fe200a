//! Masks as images: read from their files, and what they cover.

use crate::{
    SceneError,
    camera::image_ops::resize_area,
    decode::{Decoded, decode},
};
use image::{GrayImage, Luma, Rgba, RgbaImage};
use std::path::Path;

/// A mask that was read from its file.
pub(super) struct ReadMask {
    /// The object's share of each pixel.
    pub share: GrayImage,
    /// The one value besides 0, where it is too dark to be taken for brightness.
    pub label: Option<u8>,
    /// The file's own size, where that is not the image's.
    pub resized: Option<(u32, u32)>,
}

/// A mask file for an image of `size`: the object's share of each pixel. That is brightness; the alpha of an image that has some and is not
/// white where it is opaque (the photo, cut out); and of an image with no more than one value besides 0, that value.
pub(super) fn read_mask(path: &Path, size: (u32, u32), invert: bool) -> Result<ReadMask, SceneError> {
    let Decoded { image, .. } = decode(path)?;
    let found = image.dimensions();
    let (a, b) = (u64::from(found.0) * u64::from(size.1), u64::from(found.1) * u64::from(size.0));
    if a.abs_diff(b) > u64::from(size.0.max(size.1)) {
        return Err(SceneError::Size { file: path.into(), of: "its photo's", expected: size, found });
    }
    let mut shares = shares(&image);
    // Labels: 0 and 1, for instance.
    let brightest = shares.pixels().map(|p| p[0]).max().filter(|v| (1..128).contains(v));
    let label = brightest.filter(|label| shares.pixels().all(|p| p[0] == 0 || p[0] == *label));
    if label.is_some() {
        shares.pixels_mut().for_each(|p| p[0] = if p[0] == 0 { 0 } else { 255 });
    }
    if invert {
        shares.pixels_mut().for_each(|p| p[0] = 255 - p[0]);
    }
    let resized = (found != size).then_some(found);
    let share = if resized.is_some() { gray(&resize_area(&colored(&shares), size.0, size.1)) } else { shares };
    Ok(ReadMask { share, label, resized })
}

/// A mask file for an image of `size`, as [`load`](crate::load()) reads it: the object's share of each pixel.
pub fn mask_file(path: &Path, size: (u32, u32)) -> Result<GrayImage, SceneError> {
    Ok(read_mask(path, size, false)?.share)
}

fn shares(image: &RgbaImage) -> GrayImage {
    let bright = |p: &[u8; 4]| (u32::from(p[0]) + u32::from(p[1]) + u32::from(p[2])) / 3;
    let clear = image.pixels().any(|p| p[3] < 128);
    let cut_out = clear && image.pixels().any(|p| p[3] >= 250 && bright(&p.0) < 250);
    GrayImage::from_fn(image.width(), image.height(), |x, y| {
        let p = image.get_pixel(x, y).0;
        Luma([if cut_out { p[3] } else { (bright(&p) * u32::from(p[3]) / 255) as u8 }])
    })
}

/// How much of an image's border, and of all of it, a mask covers.
pub(super) fn coverage(mask: &GrayImage) -> (f64, f64) {
    let (w, h) = mask.dimensions();
    let white = |p: &Luma<u8>| usize::from(p[0] >= 128);
    let all: usize = mask.pixels().map(white).sum();
    let border = mask.enumerate_pixels().filter(|(x, y, _)| *x == 0 || *y == 0 || *x == w - 1 || *y == h - 1);
    let (count, along) = border.fold((0, 0), |(count, along), (.., p)| (count + 1, along + white(p)));
    (along as f64 / f64::from(count.max(1)), all as f64 / (f64::from(w) * f64::from(h)))
}

pub(super) fn colored(mask: &GrayImage) -> RgbaImage {
    RgbaImage::from_fn(mask.width(), mask.height(), |x, y| {
        let v = mask.get_pixel(x, y)[0];
        Rgba([v, v, v, 255])
    })
}

pub(super) fn gray(image: &RgbaImage) -> GrayImage {
    GrayImage::from_fn(image.width(), image.height(), |x, y| Luma([image.get_pixel(x, y)[0]]))
}
