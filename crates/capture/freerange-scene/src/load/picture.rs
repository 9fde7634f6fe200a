//! One photo from its file to a pinhole's picture: decoded, turned, converted, freed from its lens.

use super::{
    LoadConfig, MaskSource,
    aim::Aim,
    masks::{coverage, read_mask},
};
use crate::camera::{Camera, Lens, image_ops::resize_area};
use crate::{
    SceneError,
    error::In,
    read::{Intrinsics, LARGEST_SIDE, Photo},
};
use image::{DynamicImage, GrayImage, ImageDecoder, ImageReader, Luma, Rgba, RgbaImage, metadata::Orientation};
use std::path::Path;

/// What one decoder may allocate, in bytes.
const LARGEST_DECODE: u64 = 2 << 30;
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
}

impl Picture {
    /// Its mask says what may be looked at: the rest is as what the lens does not show.
    pub fn only_usable(&mut self) {
        if let Some(mask) = self.mask.take() {
            super::set_alpha(&mut self.image, mask.as_raw());
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
    let Decoded { mut image, orientation, converted } = decode(&photo.image)?;
    let mut turned = false;
    let mut camera = photo.camera(image.dimensions());
    if orientation != Orientation::NoTransforms {
        let mut upright = DynamicImage::ImageRgba8(image.clone());
        upright.apply_orientation(orientation);
        // Cameras were made for the stored pixels, if those fit; but for those of which it is known otherwise.
        let upright_camera = matches!(photo.intrinsics, Intrinsics::Relative { upright: true, .. });
        if upright_camera || camera.is_err() {
            image = upright.into_rgba8();
            camera = photo.camera(image.dimensions());
            turned = true;
        }
    }
    let mut camera = camera?;
    let size = image.dimensions();
    let keeps_alpha = matches!(config.masks, MaskSource::Auto | MaskSource::Alpha) && mask.is_none();
    let clear = if keeps_alpha { image.pixels().filter(|p| p[3] < 255).count() } else { 0 };
    let alpha = clear as f64 > SPECKS * f64::from(size.0) * f64::from(size.1)
        || (clear > 0 && config.masks == MaskSource::Alpha);
    if !keeps_alpha {
        image.pixels_mut().for_each(|p| p[3] = 255);
    }
    let mut mask = mask.map(|path| read_mask(path, size, config.invert_masks)).transpose()?;
    let mask_covers = mask.as_ref().map_or((0.0, 0.0), coverage);
    let look = aim.filter(|_| photo.lens.is_wide()).and_then(|a| a.camera(&photo.lens, &camera, config.max_side));
    let aimed = look.is_some();
    if let Some(seen) = look {
        image = photo.lens.seen_by(&image, &camera, &seen);
        mask = mask.map(|mask| gray(&photo.lens.seen_by(&coloured(&mask), &camera, &seen)));
        camera = seen;
    } else if photo.lens != Lens::Ideal {
        if !photo.lens.is_one_to_one(&camera) {
            let expected = "a lens that shows the image one to one";
            let found = format!("{:?}, which folds it", photo.lens);
            return Err(In(&photo.image).field("", "distortion", expected, found));
        }
        image = photo.lens.undistort(&image, &camera);
        mask = mask.map(|mask| gray(&photo.lens.undistort(&coloured(&mask), &camera)));
    }
    let longer = size.0.max(size.1);
    if !aimed && longer > config.max_side {
        let side = |s: u32| ((f64::from(s) * f64::from(config.max_side) / f64::from(longer)).round() as u32).max(1);
        let (w, h) = (side(size.0), side(size.1));
        image = resize_area(&image, w, h);
        mask = mask.map(|mask| gray(&resize_area(&coloured(&mask), w, h)));
        camera = camera.resized(w, h);
    }
    Ok(Picture { image, camera, mask, mask_covers, alpha, size, turned, aimed, converted })
}

/// An image as it is stored.
pub(super) struct Decoded {
    /// In sRGB.
    pub image: RgbaImage,
    /// How its EXIF data says to turn it.
    pub orientation: Orientation,
    /// Whether its colors were others than sRGB's.
    pub converted: bool,
}

/// Decodes a file.
pub(super) fn decode(path: &Path) -> Result<Decoded, SceneError> {
    let failed = |e| SceneError::Image { file: path.into(), source: Box::new(e) };
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(LARGEST_SIDE);
    limits.max_image_height = Some(LARGEST_SIDE);
    limits.max_alloc = Some(LARGEST_DECODE);
    let mut reader =
        ImageReader::open(path).and_then(ImageReader::with_guessed_format).map_err(|e| In(path).read(e))?;
    reader.limits(limits);
    if let Some(kind) = kind_of(path) {
        return Err(In(path).unreadable(kind));
    }
    let mut decoder = reader.into_decoder().map_err(failed)?;
    let orientation = decoder.orientation().map_err(failed)?;
    // What cannot be read of a profile changes no color.
    let profile = decoder.icc_profile().ok().flatten();
    let mut image = DynamicImage::from_decoder(decoder).map_err(failed)?.into_rgba8();
    let converted = profile.is_some_and(|profile| to_srgb(&mut image, &profile));
    Ok(Decoded { image, orientation, converted })
}

/// The kind of an image that is not decoded, by the file's first bytes: cameras and messengers rename files.
fn kind_of(path: &Path) -> Option<&'static str> {
    let mut start = [0; 16];
    std::io::Read::read_exact(&mut std::fs::File::open(path).ok()?, &mut start).ok()?;
    match (&start[..4], &start[4..8], &start[8..12]) {
        (_, b"ftyp", b"avif" | b"avis") => Some("AVIF"),
        (_, b"ftyp", b"heic" | b"heix" | b"hevc" | b"heim" | b"heis" | b"mif1" | b"msf1") => Some("HEIC"),
        (b"II*\0" | b"MM\0*", ..) => Some("TIFF"),
        (b"v/1\x01", ..) => Some("OpenEXR"),
        _ => None,
    }
}

/// Colors that differ from sRGB's by no more than this are left as they are, in 8-bit steps.
const SAME_COLOR: u8 = 2;

/// Turns an image with this ICC profile into sRGB; whether anything changed. Profiles other than of red, green and blue are passed over.
fn to_srgb(image: &mut RgbaImage, profile: &[u8]) -> bool {
    let Ok(own) = moxcms::ColorProfile::new_from_slice(profile) else { return false };
    let (layout, options) = (moxcms::Layout::Rgba, moxcms::TransformOptions::default());
    if own.color_space != moxcms::DataColorSpace::Rgb {
        return false;
    }
    let Ok(transform) = own.create_transform_8bit(layout, &moxcms::ColorProfile::new_srgb(), layout, options) else {
        return false;
    };
    let probes: Vec<u8> = (0..27u32)
        .flat_map(|i| [i % 3, i / 3 % 3, i / 9].map(|v| 40 + 85 * v as u8).into_iter().chain([255]))
        .collect();
    let mut shown = vec![0; probes.len()];
    let same = transform.transform(&probes, &mut shown).is_err()
        || probes.iter().zip(&shown).all(|(a, b)| a.abs_diff(*b) <= SAME_COLOR);
    if same {
        return false;
    }
    // Row by row: no second image.
    let width = 4 * image.width() as usize;
    let mut row = vec![0; width];
    for pixels in image.chunks_exact_mut(width.max(4)) {
        if transform.transform(pixels, &mut row).is_err() {
            return false;
        }
        pixels.copy_from_slice(&row);
    }
    true
}

/// Width and height of an image file, from its beginning.
pub(crate) fn size_of(path: &Path) -> Result<(u32, u32), SceneError> {
    let failed = |e| SceneError::Image { file: path.into(), source: Box::new(e) };
    if let Some(kind) = kind_of(path) {
        return Err(In(path).unreadable(kind));
    }
    let reader = ImageReader::open(path).and_then(ImageReader::with_guessed_format).map_err(|e| In(path).read(e))?;
    reader.into_dimensions().map_err(failed)
}

pub(super) fn coloured(mask: &GrayImage) -> RgbaImage {
    RgbaImage::from_fn(mask.width(), mask.height(), |x, y| {
        let v = mask.get_pixel(x, y)[0];
        Rgba([v, v, v, 255])
    })
}

pub(super) fn gray(image: &RgbaImage) -> GrayImage {
    GrayImage::from_fn(image.width(), image.height(), |x, y| Luma([image.get_pixel(x, y)[0]]))
}
