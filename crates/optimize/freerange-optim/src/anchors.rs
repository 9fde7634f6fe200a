//! What keeps an optimization where no photo looks, and shows from there what photos see: pictures of the proposals from around.

use crate::{
    AnchorConfig, FitError,
    objective::Objective,
    reproject::{Reprojected, reprojected},
    views::Targets,
};
use freerange_gaussians::Gaussians;
use freerange_raster::{RasterConfig, render, render_backward};
use freerange_scene::camera::{CANONICAL_RADIUS, Camera};
use glam::DVec3;

/// Distance of the cameras from the origin, in radii of the sphere that holds the object: training cameras' own.
const DISTANCE: f64 = 3.5;
/// Part of the image's width that the sphere fills.
const FILLED: f64 = 0.9;
/// One of them is looked at every so many steps, with as many times the weight.
const EVERY: usize = 2;
/// Highest and lowest cameras, as sines of the elevation.
const HIGHEST: f64 = 0.9;
/// Pictures are compared as small ones that stand for images of so many pixels a side.
const FULL_SIZE: f32 = 512.0;
/// Alpha of pixels that may have a photo's color.
const SOLID: f32 = 0.9;
/// Differences of colors that are rounding.
const EQUAL: f32 = 1e-6;

/// Pictures of one cloud, or the mean of several, from all around it.
pub(crate) struct Anchors {
    pictures: Vec<Picture>,
    raster: RasterConfig,
    weight: f64,
}

struct Picture {
    camera: Camera,
    /// Premultiplied, over black. `[size, size, 3]`
    rgb: Vec<f32>,
    alpha: Vec<f32>, // [size, size]
}

/// Cameras spread evenly over the sphere but for its poles (a Fibonacci spiral), looking at the origin.
fn around(views: usize, size: u32) -> impl Iterator<Item = Camera> {
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    let fov = 2.0 * ((1.0 / DISTANCE).asin().tan() / FILLED).atan();
    (0..views).map(move |i| {
        let z = HIGHEST * (1.0 - (2 * i + 1) as f64 / views as f64);
        let (r, angle) = ((1.0 - z * z).sqrt(), golden * i as f64);
        let eye = DISTANCE * CANONICAL_RADIUS * DVec3::new(r * angle.cos(), r * angle.sin(), z);
        Camera::look_at(eye, DVec3::ZERO, DVec3::Z, fov, size, size)
    })
}

impl Anchors {
    /// The mean pictures of `clouds`, in the colors of `photos` where these see the surface; none where they would have no weight.
    pub fn new(clouds: &[Gaussians], photos: &Targets, config: &AnchorConfig) -> Result<Self, FitError> {
        let raster = RasterConfig::default().shrunk(config.size as f32 / FULL_SIZE);
        let wanted = if config.weight > 0.0 { usize::MAX } else { 0 };
        let cameras: Vec<Camera> = around(config.views, config.size).take(wanted).collect();
        let shown = reprojected(&cameras, &raster, clouds, photos)?;
        let share = 1.0 / clouds.len() as f32;
        let picture = |(camera, shown): (Camera, Reprojected)| {
            let pixels = shown.trust.len();
            let (mut rgb, mut alpha) = (vec![0.0; 3 * pixels], vec![0.0; pixels]);
            for cloud in clouds {
                let out = render(cloud.rows(), &[camera], &[[0.0; 3]], &raster)?;
                rgb.iter_mut().zip(&out.rgb).for_each(|(sum, x)| *sum += share * x);
                alpha.iter_mut().zip(&out.alpha).for_each(|(sum, x)| *sum += share * x);
            }
            for (i, held) in rgb.as_chunks_mut::<3>().0.iter_mut().enumerate().filter(|(i, _)| alpha[*i] >= SOLID) {
                let (color, trust) = (shown.color[i], shown.trust[i]);
                held.iter_mut().zip(color).for_each(|(held, color)| *held += trust * (alpha[i] * color - *held));
            }
            Ok(Picture { camera, rgb, alpha })
        };
        let pictures = cameras.into_iter().zip(shown).map(picture).collect::<Result<_, FitError>>()?;
        Ok(Self { pictures, raster, weight: config.weight * EVERY as f64 })
    }

    /// Whether step number `step` looks at one of them.
    pub fn due(step: usize) -> bool {
        step % EVERY == 1
    }

    /// Number of pictures.
    pub fn views(&self) -> usize {
        self.pictures.len()
    }

    /// The mean absolute difference between picture `view` and `cloud`, both over `background`, times the weight of the steps that look at one.
    pub fn objective(&self, cloud: &Gaussians, view: usize, background: [f32; 3]) -> Result<Objective, FitError> {
        let Picture { camera, rgb, alpha } = &self.pictures[view];
        let out = render(cloud.rows(), &[*camera], &[background], &self.raster)?;
        let share = (self.weight / out.rgb.len() as f64) as f32;
        let (mut loss, mut d_rgb) = (0.0, vec![0.0; out.rgb.len()]);
        let pixels = out.rgb.as_chunks::<3>().0.iter().zip(rgb.as_chunks::<3>().0).zip(alpha);
        for (d, ((found, held), alpha)) in d_rgb.as_chunks_mut::<3>().0.iter_mut().zip(pixels) {
            for c in 0..3 {
                let difference = found[c] - (held[c] + (1.0 - alpha) * background[c]);
                loss += f64::from(share * difference.abs());
                d[c] = if difference.abs() < EQUAL { 0.0 } else { share.copysign(difference) };
            }
        }
        let gradients = render_backward(cloud.rows(), &out, &d_rgb, &[], &[])?.gaussians;
        Ok(Objective { loss, gradients })
    }
}
