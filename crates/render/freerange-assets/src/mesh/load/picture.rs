//! Textures from PNG, JPEG and WebP, within limits.

use std::io::Cursor;

use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits, RgbaImage};

use super::job::Job;
use crate::mesh::error::MeshError;

/// Decodes a picture. Its size is checked, and taken from the budget, before memory is taken for its pixels.
/// Sixteen bits per channel are cut to eight. `name` says where in the mesh file it is referred to.
pub fn decode(job: &mut Job, name: &str, bytes: &[u8]) -> Result<RgbaImage, MeshError> {
    let mut reader = ImageReader::new(Cursor::new(bytes))
        .with_guessed_format()
        .map_err(|e| job.error(name, "a readable image", e))?;
    match reader.format() {
        Some(ImageFormat::Png | ImageFormat::Jpeg | ImageFormat::WebP) => {}
        other => {
            let found = other.map_or("another format".to_owned(), |f| format!("{f:?}"));
            return Err(job.error(name, "a PNG, JPEG or WebP image", found));
        }
    }
    let mut limits = Limits::no_limits();
    limits.max_image_width = Some(job.limits.max_texture_side);
    limits.max_image_height = Some(job.limits.max_texture_side);
    // A picture of 16-bit RGBA with as much again for the decoder's own work.
    limits.max_alloc =
        Some(16 * job.limits.max_texture_pixels.min(u64::from(job.limits.max_texture_side).pow(2)) + (1 << 20));
    reader.limits(limits);
    let broken = |e: image::ImageError| {
        let side = job.limits.max_texture_side;
        job.error(name, format!("a whole image of at most {side} pixels a side (max_texture_side)"), e)
    };
    let decoder = reader.into_decoder().map_err(&broken)?;
    let (width, height) = decoder.dimensions();
    job.charge_pixels(name, [width, height])?;
    let picture = DynamicImage::from_decoder(decoder).map_err(|e| job.error(name, "a whole image", e))?;
    Ok(picture.into_rgba8())
}
