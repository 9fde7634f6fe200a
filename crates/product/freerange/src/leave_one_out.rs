//! What the other views make of each view: for masks that are estimated.

use std::ops::ControlFlow;

use freerange_gaussians::Gaussians;
use freerange_optim::{FitProgress, InitialFitConfig, LeaveOneOut, PosedImage};
use freerange_raster::RasterConfig;
use freerange_scene::camera::{Camera, FrameConfig, View, Window, canonical_from_user};
use freerange_util::Stop;
use image::{Rgba, RgbaImage};
use rayon::prelude::*;

use crate::{Error, error::Lift};

/// Shows each view as a quick fit of all the others has it: straight color and alpha, at its image's size, in the order of `views`, whose
/// alpha is the object's mask. What one mask lacks by mistake others have, and the other way round. (`freerange_scene::estimate::LeaveOneOut`.)
///
/// # Errors
/// A sentence, where the views do not show one object from different places, or a fit diverges.
pub fn leave_one_out(views: Vec<View>, stop: &Stop) -> Result<Vec<RgbaImage>, String> {
    shown(views, stop).map_err(|e| e.to_string())
}

fn shown(views: Vec<View>, stop: &Stop) -> Result<Vec<RgbaImage>, Error> {
    // Finer or longer fits mend no more (docs/research/experiments/masks.md).
    let config = InitialFitConfig { iterations: 150, gaussians: 2048, render_size: 128 };
    let place = canonical_from_user(&views, &FrameConfig::default()).lift()?.canonical_from_user;
    let cameras: Vec<Camera> = views.iter().map(|v| v.camera.transformed(&place)).collect();
    let framed = |(view, camera): (&View, &Camera)| {
        let window = Window::framed_in(camera, &view.image);
        let camera = window.map_or(*camera, |window| window.camera(camera));
        (window, camera)
    };
    let frames: Vec<(Option<Window>, Camera)> = views.iter().zip(&cameras).map(framed).collect();
    let posed = views.iter().zip(frames).map(|(view, (window, camera))| PosedImage { window, camera, ..view.into() });
    let fits = LeaveOneOut::new(posed.collect::<Vec<_>>(), &config).lift()?;
    // The fits have what they need of the views.
    drop(views);
    (0..cameras.len())
        .into_par_iter()
        .map(|i| {
            let go_on = |_: &FitProgress<'_>| match stop.check() {
                Ok(()) => ControlFlow::Continue(()),
                Err(_) => ControlFlow::Break(()),
            };
            picture(&fits.fit(i, i as u64, go_on).lift()?, &cameras[i])
        })
        .collect()
}

/// The cloud in straight color and alpha.
fn picture(cloud: &Gaussians, camera: &Camera) -> Result<RgbaImage, Error> {
    let shown = freerange_raster::render(cloud.rows(), &[*camera], &[[0.0; 3]], &RasterConfig::default()).lift()?;
    let byte = |v: f32| (255.0 * v.clamp(0.0, 1.0)).round() as u8;
    let pixels = shown.rgb.as_chunks::<3>().0.iter().zip(&shown.alpha).map(|(rgb, &alpha)| {
        // Over black, colors are multiplied by alpha.
        let [r, g, b] = rgb.map(|c| byte(c / alpha.max(1e-3)));
        Rgba([r, g, b, byte(alpha)])
    });
    let mut image = RgbaImage::new(camera.width, camera.height);
    image.pixels_mut().zip(pixels).for_each(|(to, from)| *to = from);
    Ok(image)
}
