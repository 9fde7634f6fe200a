//! Scores of a result on views with known images.

use freerange_gaussians::Gaussians;
use freerange_raster::metrics::{capped_psnr, ssim_3dgs};
use freerange_scene::camera::{View, image_ops::composite};
use serde::Serialize;

use crate::{
    Error,
    error::Lift,
    pictures::{WHITE, render_view},
};

/// Agreement of renders with the images of one view, on white at the image's own resolution.
#[derive(Clone, Debug, Serialize)]
pub struct ViewScore {
    /// The view.
    pub name: String,
    /// Peak signal-to-noise ratio, dB; at most 100, which stands for equal images.
    pub psnr: f64,
    /// Structural similarity as the 3DGS papers compute it (11 x 11 Gaussian window, zero padding).
    pub ssim: f64,
}

/// Scores of a set of views.
#[derive(Clone, Debug, Serialize)]
pub struct Scores {
    /// Mean over the views, dB.
    pub psnr: f64,
    /// Mean over the views.
    pub ssim: f64,
    /// Every view.
    pub views: Vec<ViewScore>,
}

/// Compares renders of `cloud` with `views`; both in one frame. None for no views.
///
/// # Errors
/// If a render or a metric is refused, or Gaussians render as what is no number.
pub fn score(cloud: &Gaussians, views: &[View]) -> Result<Option<Scores>, Error> {
    let scored = views
        .iter()
        .map(|view| {
            let (w, h) = view.image.dimensions();
            // As a viewer would see it: clamped to the range of a picture.
            let render: Vec<f32> = render_view(cloud, &view.camera)?.iter().map(|x| x.clamp(0.0, 1.0)).collect();
            let truth = composite(&view.image, WHITE);
            let psnr = capped_psnr(&render, &truth).lift()?;
            if psnr.is_nan() {
                return Err(Error::input(format!("render of view {}", view.name), "finite colors", psnr));
            }
            let ssim = ssim_3dgs(&render, &truth, w as usize, h as usize).lift()?;
            Ok(ViewScore { name: view.name.clone(), psnr, ssim })
        })
        .collect::<Result<Vec<_>, Error>>()?;
    if scored.is_empty() {
        return Ok(None);
    }
    let mean = |f: fn(&ViewScore) -> f64| scored.iter().map(f).sum::<f64>() / scored.len() as f64;
    Ok(Some(Scores { psnr: mean(|v| v.psnr), ssim: mean(|v| v.ssim), views: scored }))
}
