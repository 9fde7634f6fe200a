//! Image files decoded: to sRGB, and how their EXIF data says to turn them.

use crate::{SceneError, error::In};
use image::{DynamicImage, ImageDecoder, ImageReader, RgbaImage, metadata::Orientation};
use std::path::Path;

/// Largest image side accepted, in pixels.
pub(crate) const LARGEST_SIDE: u32 = 16384;
/// What one decoder may allocate, in bytes.
const LARGEST_DECODE: u64 = 2 << 30;

/// An image as it is stored.
pub(crate) struct Decoded {
    /// In sRGB.
    pub image: RgbaImage,
    /// How its EXIF data says to turn it.
    pub orientation: Orientation,
    /// Whether its colors were others than sRGB's.
    pub converted: bool,
    /// What its color profile is of, where that is not used.
    pub profile: Option<&'static str>,
}

/// Decodes a file.
pub(crate) fn decode(path: &Path) -> Result<Decoded, SceneError> {
    let failed = |e| SceneError::Image { file: path.into(), source: Box::new(e) };
    let mut decoder = decoder(path)?;
    let orientation = decoder.orientation().map_err(failed)?;
    // What cannot be read of a profile changes no color.
    let profile = decoder.icc_profile().ok().flatten();
    let mut image = DynamicImage::from_decoder(decoder).map_err(failed)?.into_rgba8();
    let (converted, profile) = match profile.map(|profile| to_srgb(&mut image, &profile)) {
        None => (false, None),
        Some(Ok(converted)) => (converted, None),
        Some(Err(kind)) => (false, Some(kind)),
    };
    Ok(Decoded { image, orientation, converted, profile })
}

/// Whether a file may have transparent pixels, from its beginning.
pub(crate) fn has_alpha(path: &Path) -> Result<bool, SceneError> {
    Ok(decoder(path)?.color_type().has_alpha())
}

fn decoder(path: &Path) -> Result<impl ImageDecoder + use<>, SceneError> {
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
    reader.into_decoder().map_err(|e| SceneError::Image { file: path.into(), source: Box::new(e) })
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

/// Turns an image with this ICC profile into sRGB; whether anything changed. Profiles that are not of red, green and
/// blue are passed over: what they are of is the error.
fn to_srgb(image: &mut RgbaImage, profile: &[u8]) -> Result<bool, &'static str> {
    let unreadable = |_| "unreadable";
    let own = moxcms::ColorProfile::new_from_slice(profile).map_err(unreadable)?;
    let (layout, options) = (moxcms::Layout::Rgba, moxcms::TransformOptions::default());
    match own.color_space {
        moxcms::DataColorSpace::Rgb => {}
        moxcms::DataColorSpace::Gray => return Err("gray"),
        moxcms::DataColorSpace::Cmyk => return Err("CMYK"),
        _ => return Err("other colors"),
    }
    let srgb = moxcms::ColorProfile::new_srgb();
    let transform = own.create_transform_8bit(layout, &srgb, layout, options).map_err(unreadable)?;
    let probes: Vec<u8> = (0..27u32)
        .flat_map(|i| [i % 3, i / 3 % 3, i / 9].map(|v| 40 + 85 * v as u8).into_iter().chain([255]))
        .collect();
    let mut shown = vec![0; probes.len()];
    transform.transform(&probes, &mut shown).map_err(unreadable)?;
    if probes.iter().zip(&shown).all(|(a, b)| a.abs_diff(*b) <= SAME_COLOR) {
        return Ok(false);
    }
    // Row by row: no second image.
    let width = 4 * image.width() as usize;
    let mut row = vec![0; width];
    for pixels in image.chunks_exact_mut(width.max(4)) {
        transform.transform(pixels, &mut row).map_err(unreadable)?;
        pixels.copy_from_slice(&row);
    }
    Ok(true)
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
