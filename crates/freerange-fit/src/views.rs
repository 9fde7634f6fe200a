//! The views as a fit sees them: checked, shrunk, and put over a background.

use crate::{Background, FitError};
use freerange_camera::{Camera, View, image_ops};
use freerange_raster::RasterConfig;
use glam::{DMat3, DVec3};
use image::RgbaImage;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

/// Views of one size.
pub(crate) struct Targets {
    pub cameras: Vec<Camera>,
    pub images: Vec<RgbaImage>,
    pub width: usize,
    pub height: usize,
    /// For renders that are compared with the (shrunk) images.
    pub raster: RasterConfig,
}

fn refuse<T>(view: &View, field: &'static str, expected: String, found: String) -> Result<T, FitError> {
    Err(FitError::View { name: view.name.clone(), field, expected, found })
}

fn check(view: &View) -> Result<(), FitError> {
    let c = &view.camera;
    let (width, height) = view.image.dimensions();
    if (width, height) != (c.width, c.height) {
        let expected = format!("{} x {} pixels, the camera's size", c.width, c.height);
        return refuse(view, "image", expected, format!("{width} x {height}"));
    }
    // The rasteriser's own limit.
    if !(1..=16384).contains(&width) || !(1..=16384).contains(&height) {
        return refuse(view, "image", "1 to 16384 pixels a side".into(), format!("{width} x {height}"));
    }
    let focal = |v: f64| (v as f32).is_normal() && v > 0.0;
    if !(focal(c.fx) && focal(c.fy) && (c.cx as f32).is_finite() && (c.cy as f32).is_finite()) {
        let found = format!("fx {}, fy {}, cx {}, cy {}", c.fx, c.fy, c.cx, c.cy);
        return refuse(view, "camera", "finite numbers and focal lengths above 0".into(), found);
    }
    let rotation = DMat3::from_mat4(c.world_to_camera);
    let rigid = (rotation * rotation.transpose()).abs_diff_eq(DMat3::IDENTITY, 1e-3);
    let finite = c.world_to_camera.w_axis.is_finite() && c.world_to_camera.w_axis.abs().max_element() < 1e15;
    if !(rigid && finite) {
        return refuse(view, "world_to_camera", "a rigid transform".into(), format!("{:?}", c.world_to_camera));
    }
    Ok(())
}

impl Targets {
    /// Checks the views and shrinks those whose longest side exceeds `size`.
    pub fn new(views: &[View], size: Option<u32>) -> Result<Self, FitError> {
        let first = views.first().ok_or(FitError::NoViews)?;
        for view in views {
            check(view)?;
            let (found, expected) = (view.image.dimensions(), first.image.dimensions());
            if found != expected {
                let expected = format!("{} x {} pixels as in {:?}", expected.0, expected.1, first.name);
                return refuse(view, "image", expected, format!("{} x {}", found.0, found.1));
            }
        }
        let (width, height) = first.image.dimensions();
        let longest = width.max(height);
        let (width, height) = match size {
            Some(size) if size < longest => {
                let shrink = |side: u32| {
                    let exact = f64::from(side) * f64::from(size) / f64::from(longest);
                    (exact.round() as u32).max(1)
                };
                (shrink(width), shrink(height))
            }
            _ => (width, height),
        };
        Ok(Self {
            cameras: views.iter().map(|v| v.camera.resized(width, height)).collect(),
            images: views.par_iter().map(|v| image_ops::resize_area(&v.image, width, height)).collect(),
            width: width as usize,
            height: height as usize,
            raster: RasterConfig::default().shrunk(width as f32 / first.image.width() as f32),
        })
    }

    /// View `i` over `background`, `[h, w, 3]`.
    pub fn composite(&self, i: usize, background: [f32; 3]) -> Vec<f32> {
        image_ops::composite(&self.images[i], background)
    }

    /// The pixel of view `i` that shows `point`, straight RGBA; none outside the image or behind the camera.
    pub fn pixel(&self, i: usize, point: DVec3) -> Option<[u8; 4]> {
        let c = &self.cameras[i];
        let p = c.world_to_camera.transform_point3(point);
        let (x, y) = (c.fx * p.x / p.z + c.cx, c.fy * p.y / p.z + c.cy);
        // Phrased so that NaN fails it.
        let inside = p.z > 0.0 && x >= 0.0 && y >= 0.0 && x < self.width as f64 && y < self.height as f64;
        inside.then(|| self.images[i].get_pixel(x as u32, y as u32).0)
    }
}

impl Background {
    pub(crate) fn draw(self, rng: &mut ChaCha8Rng) -> [f32; 3] {
        match self {
            Self::Random => rng.random(),
            Self::White => [1.0; 3],
            Self::Black => [0.0; 3],
        }
    }
}
