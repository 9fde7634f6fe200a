//! The views as a fit sees them: checked, shrunk, and put over a background.

use std::{borrow::Cow, sync::Arc};

use crate::FitError;
use freerange_raster::RasterConfig;
use freerange_scene::camera::{Camera, View, Window, image_ops, pixel_of};
use glam::{DMat3, DVec3};
use image::{RgbaImage, imageops::crop_imm};
use rand::Rng;
use rayon::prelude::*;

/// What a fit is to agree with. Views alone are one, too. Images are only referred to: a fit makes its own, of its own size.
#[derive(Clone, Debug)]
pub struct Evidence<'a> {
    /// Posed views.
    pub views: Vec<PosedImage<'a>>,
    /// How many of them, the first ones, are photos: the others show what only symmetry says.
    pub photos: usize,
    /// Silhouettes from further places: of these images the alpha alone counts.
    pub silhouettes: Vec<PosedImage<'a>>,
}

/// An image, or a part of it, and the camera that took it. Many may share one image.
#[derive(Clone, Copy, Debug)]
pub struct PosedImage<'a> {
    /// Of the view that it comes from, for messages.
    pub name: &'a str,
    /// From where it is seen; of the part alone where there is one.
    pub camera: Camera,
    /// The image.
    pub image: &'a RgbaImage,
    /// The part of it that counts; none: all of it.
    pub window: Option<Window>,
    /// How often it is looked at, as a part of how often one of weight 1 is: 0 to 1. Silhouettes have that of their first.
    pub weight: f64,
}

impl PosedImage<'_> {
    fn size(&self) -> (u32, u32) {
        self.window.map_or(self.image.dimensions(), |window| (window.side(), window.side()))
    }

    fn pixels(&self) -> Cow<'_, RgbaImage> {
        self.window.map_or(Cow::Borrowed(self.image), |window| Cow::Owned(window.image(self.image)))
    }

    /// Whether it shows the same pixels as another one.
    fn shares(&self, other: &Self) -> bool {
        std::ptr::eq(self.image, other.image) && self.window == other.window
    }
}

impl<'a> From<&'a View> for PosedImage<'a> {
    fn from(view: &'a View) -> Self {
        Self { name: &view.name, camera: view.camera, image: &view.image, window: None, weight: 1.0 }
    }
}

impl<'a> From<Vec<PosedImage<'a>>> for Evidence<'a> {
    fn from(views: Vec<PosedImage<'a>>) -> Self {
        Self { photos: views.len(), views, silhouettes: Vec::new() }
    }
}

impl<'a> From<&'a [View]> for Evidence<'a> {
    fn from(views: &'a [View]) -> Self {
        views.iter().map(PosedImage::from).collect::<Vec<_>>().into()
    }
}

impl<'a> From<&'a Vec<View>> for Evidence<'a> {
    fn from(views: &'a Vec<View>) -> Self {
        views.as_slice().into()
    }
}

impl<'a, const N: usize> From<&'a [View; N]> for Evidence<'a> {
    fn from(views: &'a [View; N]) -> Self {
        views.as_slice().into()
    }
}

/// How often a point of the object is looked for.
const TRIES: usize = 64;

/// Views, each of its own size, and after them those of which the silhouette alone counts.
pub(crate) struct Targets {
    pub cameras: Vec<Camera>,
    /// One for all that share it.
    pub images: Vec<Arc<RgbaImage>>,
    /// How many of them are more than silhouettes.
    pub views: usize,
    /// How many of these are photos.
    pub photos: usize,
    /// How often each is looked at ([`PosedImage::weight`]).
    pub weights: Vec<f64>,
    /// How to render each.
    pub rasters: Vec<RasterConfig>,
}

fn refuse<T>(view: &PosedImage<'_>, field: &'static str, expected: String, found: String) -> Result<T, FitError> {
    Err(FitError::View { name: view.name.to_owned(), field, expected, found })
}

fn check(view: &PosedImage<'_>) -> Result<(), FitError> {
    let c = &view.camera;
    let (width, height) = view.size();
    if (width, height) != (c.width, c.height) {
        let expected = format!("{} x {} pixels, the camera's size", c.width, c.height);
        return refuse(view, "image", expected, format!("{width} x {height}"));
    }
    if !(0.0..=1.0).contains(&view.weight) {
        return refuse(view, "weight", "0 to 1".into(), view.weight.to_string());
    }
    // The rasterizer's own limit.
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
    pub fn new<'a>(seen: impl Into<Evidence<'a>>, size: Option<u32>) -> Result<Self, FitError> {
        let seen = seen.into();
        if seen.views.is_empty() {
            return Err(FitError::NoViews);
        }
        // The order of views could not be drawn otherwise.
        if seen.views.iter().all(|view| view.weight < 1.0) {
            return refuse(
                &seen.views[0],
                "weight",
                "1 for one view at least".into(),
                seen.views[0].weight.to_string(),
            );
        }
        let (views, photos) = (seen.views.len(), seen.photos.min(seen.views.len()));
        let all: Vec<PosedImage<'_>> = seen.views.into_iter().chain(seen.silhouettes).collect();
        all.iter().try_for_each(check)?;
        // Each picture once, however many share it.
        let mut pictures: Vec<PosedImage<'_>> = Vec::new();
        let of: Vec<usize> = all
            .iter()
            .map(|one| {
                pictures.iter().position(|known| known.shares(one)).unwrap_or_else(|| {
                    pictures.push(*one);
                    pictures.len() - 1
                })
            })
            .collect();
        let small = |one: PosedImage<'_>| {
            let full = one.size();
            let (w, h) = size.map_or(full, |size| image_ops::shrunk_size(full, size));
            let longest = |(w, h): (u32, u32)| w.max(h) as f32;
            let raster = RasterConfig::default().shrunk(longest((w, h)) / longest(full));
            let image = match (w, h) == full {
                true => one.pixels().into_owned(),
                false => image_ops::resize_area(&one.pixels(), w, h),
            };
            (Arc::new(image), raster)
        };
        let (pictures, rasters): (Vec<Arc<RgbaImage>>, Vec<RasterConfig>) = pictures.into_par_iter().map(small).unzip();
        let cameras = all.iter().zip(&of).map(|(one, &of)| {
            let (w, h) = pictures[of].dimensions();
            one.camera.resized(w, h)
        });
        Ok(Self {
            cameras: cameras.collect(),
            images: of.iter().map(|&of| pictures[of].clone()).collect(),
            views,
            photos,
            weights: all.iter().map(|one| one.weight).collect(),
            rasters: of.iter().map(|&of| rasters[of]).collect(),
        })
    }

    /// All views but one, and no silhouettes. Images are shared.
    pub fn without(&self, left_out: usize) -> Self {
        let kept: Vec<usize> = (0..self.views).filter(|i| *i != left_out).collect();
        Self {
            cameras: kept.iter().map(|&i| self.cameras[i]).collect(),
            images: kept.iter().map(|&i| self.images[i].clone()).collect(),
            views: kept.len(),
            photos: kept.iter().filter(|i| **i < self.photos).count(),
            weights: kept.iter().map(|&i| self.weights[i]).collect(),
            rasters: kept.iter().map(|&i| self.rasters[i]).collect(),
        }
    }

    /// The views `chosen`, in groups that can be rendered together (one size, one blur), and how to render these.
    pub fn groups<'a>(&'a self, chosen: &'a [usize]) -> impl Iterator<Item = (&'a [usize], &'a RasterConfig)> {
        let kind = |i: usize| (self.images[i].dimensions(), self.rasters[i].blur.to_bits());
        chosen.chunk_by(move |&a, &b| kind(a) == kind(b)).map(|group| (group, &self.rasters[group[0]]))
    }

    /// Windows of the views `chosen`, as views: each about a random point of the object, `part` of the view's width and height.
    pub fn windows(&self, chosen: &[usize], part: f64, rng: &mut impl Rng) -> Self {
        let mut windows = Self {
            cameras: Vec::new(),
            images: Vec::new(),
            views: chosen.len(),
            photos: chosen.len(),
            weights: vec![1.0; chosen.len()],
            rasters: Vec::new(),
        };
        for &i in chosen {
            let image = &*self.images[i];
            let (width, height) = image.dimensions();
            let [w, h] = [width, height].map(|side| ((f64::from(side) * part).round() as u32).clamp(1, side));
            // Where nothing of the object is found, the middle.
            let at = (0..TRIES)
                .map(|_| (rng.random_range(0..width), rng.random_range(0..height)))
                .find(|&(x, y)| image.get_pixel(x, y).0[3] > 0)
                .unwrap_or((width / 2, height / 2));
            let x = at.0.saturating_sub(w / 2).min(width - w);
            let y = at.1.saturating_sub(h / 2).min(height - h);
            let camera = self.cameras[i];
            let (cx, cy) = (camera.cx - f64::from(x), camera.cy - f64::from(y));
            windows.cameras.push(Camera { width: w, height: h, cx, cy, ..camera });
            windows.images.push(Arc::new(crop_imm(image, x, y, w, h).to_image()));
            windows.rasters.push(self.rasters[i]);
        }
        windows
    }

    /// Width and height of view `i` in pixels.
    pub fn size(&self, i: usize) -> (usize, usize) {
        let (w, h) = self.images[i].dimensions();
        (w as usize, h as usize)
    }

    /// View `i` over `background`, `[h, w, 3]`.
    pub fn composite(&self, i: usize, background: [f32; 3]) -> Vec<f32> {
        image_ops::composite(&self.images[i], background)
    }

    /// The pixel of view `i` that shows `point`, straight RGBA; none outside the image or behind the camera.
    pub fn pixel(&self, i: usize, point: DVec3) -> Option<[u8; 4]> {
        let (width, _) = self.size(i);
        let place = self.place(i, point)?;
        Some(self.images[i].get_pixel((place % width) as u32, (place / width) as u32).0)
    }

    /// Where that pixel is, row by row.
    pub fn place(&self, i: usize, point: DVec3) -> Option<usize> {
        pixel_of(&self.cameras[i], point).map(|(pixel, _)| pixel)
    }
}
