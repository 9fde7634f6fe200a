//! Pictures of Gaussians: single views, turntables.

use std::path::Path;

use freerange_gaussians::{Gaussians, RenderMode, Splats};
use freerange_raster::{MIP_BLUR, RasterConfig, mip_compensated, render, surface_depth, surface_normals};
use freerange_scene::camera::{
    Camera,
    image_ops::{composite, to_picture},
};
use freerange_util::IoError;
use glam::DVec3;
use image::RgbaImage;
use rayon::prelude::*;

use crate::{Error, error::Lift};

/// The color behind the object in everything that is measured or shown.
pub const WHITE: [f32; 3] = [1.0; 3];

/// Renders one view on white. `[h, w, 3]`, colors as in the image files (sRGB-encoded), not clamped.
///
/// # Errors
/// If the rasterizer refuses the camera or the cloud.
pub fn render_view(cloud: &Gaussians, camera: &Camera) -> Result<Vec<f32>, Error> {
    Ok(render(cloud.rows(), &[*camera], &[WHITE], &in_units_of(cloud, camera)).lift()?.rgb)
}

/// Settings with a near plane for the cloud's own units: as usual from a distance of one unit on, in proportion below.
fn in_units_of(cloud: &Gaussians, camera: &Camera) -> RasterConfig {
    let usual = RasterConfig::default();
    let Some((low, high)) = cloud.bounds() else { return usual };
    let distance = camera.center().distance(0.5 * (low + high));
    RasterConfig { near: usual.near * (distance as f32).clamp(1e-30, 1.0), ..usual }
}

/// Renders one view of Gaussians from a file on white, with colors as seen from this camera and drawn in `mode`.
/// `[h, w, 3]`, as [`render_view`].
///
/// # Errors
/// If the rasterizer refuses the camera or the cloud.
pub fn render_splats(splats: &Splats, camera: &Camera, mode: RenderMode) -> Result<Vec<f32>, Error> {
    let cloud = splats.seen_from(camera.center());
    // Positions are relative to the origin, which may be far away.
    let camera = camera.relative_to(splats.origin);
    if mode != RenderMode::Mip {
        return render_view(&cloud, &camera);
    }
    let rows = mip_compensated(cloud.rows(), &camera, MIP_BLUR);
    let config = RasterConfig { blur: MIP_BLUR, ..in_units_of(&cloud, &camera) };
    Ok(render(&rows, &[camera], &[WHITE], &config).lift()?.rgb)
}

/// Where the surface is that Gaussians from a file show, and which way it faces: camera z per pixel, in the file's
/// units, infinite where half of the light or more passes; and unit normals in camera coordinates (x right, y down, z
/// forward), zero there. `[h, w]` each.
///
/// # Errors
/// If the rasterizer refuses the camera or the Gaussians.
pub fn render_surface(splats: &Splats, camera: &Camera) -> Result<(Vec<f32>, Vec<[f32; 3]>), Error> {
    let camera = camera.relative_to(splats.origin);
    let cloud = &splats.cloud;
    let depth = surface_depth(cloud.rows(), &camera, &in_units_of(cloud, &camera)).lift()?;
    let normals = surface_normals(&depth, &camera);
    Ok((depth, normals))
}

/// An image composited on white.
pub fn on_white(image: &RgbaImage) -> RgbaImage {
    to_picture(&composite(image, WHITE), image.width(), image.height())
}

/// Writes an animated GIF of the cloud, which is in the canonical frame, turning once about the z axis.
///
/// # Errors
/// If the file cannot be written, or the rasterizer refuses the cloud.
pub fn write_turntable(path: &Path, cloud: &Gaussians, frames: u16, side: u16) -> Result<(), Error> {
    let (frames, size, delay) = (u32::from(frames), u32::from(side), 200 / frames.max(1));
    let frame = |i: u32| {
        let azimuth = std::f64::consts::TAU * f64::from(i) / f64::from(frames);
        let elevation = 20f64.to_radians();
        let direction = DVec3::new(azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin());
        let camera = Camera::look_at(1.6 * direction, DVec3::ZERO, DVec3::Z, 45f64.to_radians(), size, size);
        let mut picture = to_picture(&render_view(cloud, &camera)?, size, size);
        // Most of the time goes to choosing 256 colors.
        let frame = gif::Frame::from_rgba_speed(side, side, &mut picture, 10);
        Ok(gif::Frame { delay, dispose: gif::DisposalMethod::Background, ..frame })
    };
    let pictures = (0..frames).into_par_iter().map(frame).collect::<Result<Vec<_>, Error>>()?;
    let broken = |source: gif::EncodingError| {
        let source = image::error::EncodingError::new(image::ImageFormat::Gif.into(), source);
        Error::picture(path, image::ImageError::Encoding(source))
    };
    let file = std::fs::File::create(path).map_err(IoError::at(path)).lift()?;
    let mut encoder = gif::Encoder::new(std::io::BufWriter::new(file), side, side, &[]).map_err(broken)?;
    encoder.set_repeat(gif::Repeat::Infinite).map_err(broken)?;
    pictures.iter().try_for_each(|frame| encoder.write_frame(frame)).map_err(broken)
}

#[cfg(test)]
mod tests {
    use super::*;
    use freerange_gaussians::{Harmonics, channel, coefficients};
    use glam::DMat4;

    /// A few Gaussians, as small as pixels.
    fn example(degree: usize) -> Splats {
        let wave = |n: usize| (0..n).map(|v| (v as f32 * 0.7).sin()).collect::<Vec<_>>();
        let mut cloud = Gaussians::from_rows(wave(30 * channel::COUNT));
        for row in cloud.iter_mut() {
            row[channel::MEAN].iter_mut().for_each(|v| *v *= 0.4);
            row[channel::LOG_SCALE].iter_mut().for_each(|v| *v -= 4.0);
        }
        let harmonics = Harmonics::from_rows(degree, wave(30 * 3 * coefficients(degree)));
        Splats { harmonics, ..cloud.into() }
    }

    fn camera(eye: DVec3) -> Camera {
        Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 0.6, 48, 48)
    }

    fn apart(a: &[f32], b: &[f32]) -> f32 {
        a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    }

    #[test]
    fn gaussians_from_files_are_drawn_with_harmonics_mode_and_origin() {
        let (splats, camera) = (example(2), camera(DVec3::new(2.0, -1.0, 0.7)));
        let shown = render_splats(&splats, &camera, RenderMode::Default).unwrap();
        // What is the same from all sides is drawn as results are.
        let constant = Splats { harmonics: Harmonics::default(), ..splats.clone() };
        let plain = render_splats(&constant, &camera, RenderMode::Default).unwrap();
        assert_eq!(plain, render_view(&splats.cloud, &camera).unwrap());
        assert!(apart(&shown, &plain) > 0.1);
        // The color from here, as the constant one.
        let baked = Splats::from(splats.seen_from(camera.center()));
        assert_eq!(shown, render_splats(&baked, &camera, RenderMode::Default).unwrap());
        assert!(apart(&shown, &render_splats(&splats, &camera, RenderMode::Mip).unwrap()) > 0.02);

        let far = DVec3::new(4e6, -3e6, 1e6);
        let moved = Splats { origin: far, ..splats.clone() };
        let there = Camera { world_to_camera: camera.world_to_camera * DMat4::from_translation(-far), ..camera };
        assert!(apart(&shown, &render_splats(&moved, &there, RenderMode::Default).unwrap()) < 1e-3);
    }

    #[test]
    fn small_and_large_units_are_drawn_alike() {
        let eye = DVec3::new(2.0, -1.0, 0.7);
        let splats = Splats { harmonics: Harmonics::default(), ..example(2) };
        for mode in [RenderMode::Default, RenderMode::Mip] {
            let usual = render_splats(&splats, &camera(eye), mode).unwrap();
            assert!(apart(&usual, &vec![1.0; usual.len()]) > 0.1, "{mode:?} shows something");
            for scale in [1e-3, 1e-2, 1e3] {
                let mut scaled = splats.clone();
                for row in scaled.cloud.iter_mut() {
                    row[channel::MEAN].iter_mut().for_each(|v| *v *= scale as f32);
                    row[channel::LOG_SCALE].iter_mut().for_each(|v| *v += (scale as f32).ln());
                }
                let shown = render_splats(&scaled, &camera(scale * eye), mode).unwrap();
                assert!(apart(&usual, &shown) < 0.02, "{mode:?}, {scale}: {}", apart(&usual, &shown));
            }
        }
    }
}
