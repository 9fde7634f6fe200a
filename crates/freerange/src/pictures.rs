//! Pictures of Gaussians: single views, turntables.

use std::path::Path;

use freerange_camera::{
    Camera,
    image_ops::{composite, to_picture},
};
use freerange_core::IoError;
use freerange_raster::{RasterConfig, render};
use freerange_splat::Cloud;
use glam::DVec3;
use image::{Delay, Frame, RgbaImage, codecs::gif};

use crate::Error;

/// The colour behind the object in everything that is measured or shown.
pub const WHITE: [f32; 3] = [1.0; 3];

/// Renders one view on white. `[h, w, 3]`, colours as in the image files (sRGB-encoded), not clamped.
///
/// # Errors
/// If the rasteriser refuses the camera or the cloud.
pub fn render_view(cloud: &Cloud, camera: &Camera) -> Result<Vec<f32>, Error> {
    Ok(render(cloud.rows(), &[*camera], &[WHITE], &in_units_of(cloud, camera))?.rgb)
}

/// Settings with a near plane for the cloud's own units: as usual from a distance of one unit on, in proportion below.
fn in_units_of(cloud: &Cloud, camera: &Camera) -> RasterConfig {
    let usual = RasterConfig::default();
    let Some((low, high)) = cloud.bounds() else { return usual };
    let distance = camera.center().distance(0.5 * (low + high));
    RasterConfig { near: usual.near * (distance as f32).clamp(1e-30, 1.0), ..usual }
}

/// An image composited on white.
pub fn on_white(image: &RgbaImage) -> RgbaImage {
    to_picture(&composite(image, WHITE), image.width(), image.height())
}

/// Writes an animated GIF of the cloud, which is in the canonical frame, turning once about the z axis.
///
/// # Errors
/// If the file cannot be written, or the rasteriser refuses the cloud.
pub fn write_turntable(path: &Path, cloud: &Cloud, frames: u32, size: u32) -> Result<(), Error> {
    let file = std::fs::File::create(path).map_err(IoError::at(path))?;
    let mut encoder = gif::GifEncoder::new_with_speed(std::io::BufWriter::new(file), 10);
    let broken = |source: image::ImageError| Error::Picture { path: path.into(), source };
    encoder.set_repeat(gif::Repeat::Infinite).map_err(broken)?;
    for i in 0..frames {
        let azimuth = std::f64::consts::TAU * f64::from(i) / f64::from(frames);
        let elevation = 20f64.to_radians();
        let direction = DVec3::new(azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin());
        let camera = Camera::look_at(1.6 * direction, DVec3::ZERO, DVec3::Z, 45f64.to_radians(), size, size);
        let picture = to_picture(&render_view(cloud, &camera)?, size, size);
        let frame = Frame::from_parts(picture, 0, 0, Delay::from_numer_denom_ms(2000, frames.max(1)));
        encoder.encode_frame(frame).map_err(broken)?;
    }
    Ok(())
}
