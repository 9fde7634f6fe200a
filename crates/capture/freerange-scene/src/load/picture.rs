//! One photo from its file to a pinhole's picture: decoded, turned, converted, freed from its lens.

use super::{
    LoadConfig, MaskSource,
    aim::Aim,
    cut::set_alpha,
    mask_image::{ReadMask, colored, coverage, gray, read_mask},
};
use crate::camera::{Camera, Lens, image_ops::resize_area};
use crate::{
    SceneError,
    decode::{Decoded, decode},
    error::In,
    read::{Intrinsics, Photo},
};
use image::{DynamicImage, GrayImage, RgbaImage, metadata::Orientation};
use std::path::Path;

/// Transparency of less than this share of an image is an accident, not a mask.
const SPECKS: f64 = 0.002;

/// A photo without its lens, not cut out yet.
pub(super) struct Picture {
    pub image: RgbaImage,
    pub camera: Camera,
    pub mask: Option<GrayImage>,
    /// How much of the photo's border, and of all of it, the mask covers.
    pub mask_covers: (f64, f64),
    /// Whether the image itself tells the object: by more transparency than a speck, none of it made by the lens.
    pub alpha: bool,
    /// Its size as stored, or turned where its camera wants that.
    pub size: (u32, u32),
    pub turned: bool,
    /// Whether its camera looks at the object, not along its lens.
    pub aimed: bool,
    /// Whether its colors were others than sRGB's.
    pub converted: bool,
    /// What its color profile is of, where that is not used.
    pub profile: Option<&'static str>,
    /// Whether it has an alpha that its mask file stands in for.
    pub unused_alpha: bool,
    /// As [`ReadMask::label`].
    pub mask_label: Option<u8>,
    /// As [`ReadMask::resized`].
    pub mask_resized: Option<(u32, u32)>,
}

impl Picture {
    /// Its mask says what may be looked at: the rest is as what the lens does not show.
    pub fn only_usable(&mut self) {
        if let Some(mask) = self.mask.take() {
            set_alpha(&mut self.image, mask.as_raw());
        }
    }
}

/// The image of a photo: turned, freed from its lens, at most `max_side` large.
pub(super) fn picture(
    photo: &Photo,
    mask: Option<&Path>,
    aim: Option<&Aim>,
    config: &LoadConfig,
) -> Result<Picture, SceneError> {
    let Decoded { mut image, orientation, converted, profile } = decode(&photo.image)?;
    let mut turned = false;
    let mut camera = photo.camera(image.dimensions());
    // Cameras were made for the stored pixels, if those fit; but for those of which it is known otherwise.
    let upright_camera = matches!(photo.intrinsics, Intrinsics::Relative { upright: true, .. });
    if orientation != Orientation::NoTransforms && (upright_camera || camera.is_err()) {
        let mut upright = DynamicImage::ImageRgba8(image);
        upright.apply_orientation(orientation);
        image = upright.into_rgba8();
        camera = photo.camera(image.dimensions());
        turned = true;
    }
    let mut camera = camera?;
    let size = image.dimensions();
    let keeps_alpha = matches!(config.masks, MaskSource::Auto | MaskSource::Alpha) && mask.is_none();
    let clear = if keeps_alpha || mask.is_some() { image.pixels().filter(|p| p[3] < 255).count() } else { 0 };
    let more_than_specks = clear as f64 > SPECKS * f64::from(size.0) * f64::from(size.1);
    let alpha = keeps_alpha && (more_than_specks || (clear > 0 && config.masks == MaskSource::Alpha));
    let unused_alpha = !keeps_alpha && more_than_specks;
    if !keeps_alpha {
        image.pixels_mut().for_each(|p| p[3] = 255);
    }
    let read = mask.map(|path| read_mask(path, size, config.invert_masks)).transpose()?;
    let (mask_label, mask_resized) = read.as_ref().map_or((None, None), |m| (m.label, m.resized));
    let mut mask = read.map(|ReadMask { share, .. }| share);
    let mask_covers = mask.as_ref().map_or((0.0, 0.0), coverage);
    let look = aim.filter(|_| photo.lens.is_wide()).and_then(|a| a.camera(&photo.lens, &camera, config.max_side));
    let aimed = look.is_some();
    if let Some(seen) = look {
        image = photo.lens.seen_by(&image, &camera, &seen);
        mask = mask.map(|mask| gray(&photo.lens.seen_by(&colored(&mask), &camera, &seen)));
        camera = seen;
    } else if photo.lens != Lens::Ideal {
        if !photo.lens.is_one_to_one(&camera) {
            let expected = "a lens that shows the image one to one";
            let found = format!("{:?}, which folds it", photo.lens);
            return Err(In(&photo.image).field("", "distortion", expected, found));
        }
        image = photo.lens.undistort(&image, &camera);
        mask = mask.map(|mask| gray(&photo.lens.undistort(&colored(&mask), &camera)));
    }
    let longer = size.0.max(size.1);
    if !aimed && longer > config.max_side {
        let side = |s: u32| ((f64::from(s) * f64::from(config.max_side) / f64::from(longer)).round() as u32).max(1);
        let (w, h) = (side(size.0), side(size.1));
        image = resize_area(&image, w, h);
        mask = mask.map(|mask| gray(&resize_area(&colored(&mask), w, h)));
        camera = camera.resized(w, h);
    }
    Ok(Picture {
        image,
        camera,
        mask,
        mask_covers,
        alpha,
        size,
        turned,
        aimed,
        converted,
        profile,
        unused_alpha,
        mask_label,
        mask_resized,
    })
}
