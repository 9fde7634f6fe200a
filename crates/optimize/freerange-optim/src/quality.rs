//! How well Gaussians show an object.

use freerange_gaussians::Gaussians;
use freerange_raster::RasterConfig;
use freerange_raster::metrics::capped_psnr;
use freerange_scene::camera::{Camera, View};
use image::RgbaImage;

use crate::FitError;

/// PSNR in dB of renders of `cloud` against `views`, in front of white: mean over the views.
///
/// # Errors
/// [`FitError::NoViews`]; what the rasterizer refuses.
pub fn psnr_over_white(cloud: &Gaussians, views: &[View]) -> Result<f64, FitError> {
    if views.is_empty() {
        return Err(FitError::NoViews);
    }
    let mut sum = 0.0;
    for view in views {
        sum += capped_psnr(&render_over_white(cloud, &view.camera)?, &over_white(&view.image))?;
    }
    Ok(sum / views.len() as f64)
}

/// `cloud` in front of white, clamped to 0..1, sRGB-encoded. `[h, w, 3]`
///
/// # Errors
/// What the rasterizer refuses.
pub fn render_over_white(cloud: &Gaussians, camera: &Camera) -> Result<Vec<f32>, FitError> {
    let image = freerange_raster::render(cloud.rows(), &[*camera], &[[1.0; 3]], &RasterConfig::default())?;
    Ok(image.rgb.into_iter().map(|v| v.clamp(0.0, 1.0)).collect())
}

/// `image` in front of white, 0..1, sRGB-encoded. `[h, w, 3]`
pub fn over_white(image: &RgbaImage) -> Vec<f32> {
    let pixel = |p: &image::Rgba<u8>| {
        let [r, g, b, a] = p.0.map(|v| f32::from(v) / 255.0);
        [r, g, b].map(|c| c * a + (1.0 - a))
    };
    image.pixels().flat_map(pixel).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_views_have_no_mean() {
        assert!(matches!(psnr_over_white(&Gaussians::default(), &[]), Err(FitError::NoViews)));
    }

    #[test]
    fn white_shows_through_transparency() {
        let image = RgbaImage::from_pixel(1, 1, image::Rgba([255, 0, 51, 51]));
        let found = over_white(&image);
        for (found, expected) in found.iter().zip([1.0, 0.8, 0.84]) {
            assert!((found - expected).abs() < 1e-6);
        }
    }
}
