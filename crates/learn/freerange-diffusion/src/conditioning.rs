//! Posed images as the encoder takes them.

use burn::tensor::{Device, Tensor, TensorData};
use freerange_model::{FreeRange, ModelConfig, ModelKind, PLUCKER};
use freerange_scene::camera::{
    View, Window,
    image_ops::{resize_area, shrunk_size, to_f32_rgba},
    plucker,
};
use rayon::prelude::*;

use crate::FlowError;

/// The same view at most `size` pixels wide and high, aspect kept.
pub fn shrink(view: &View, size: u32) -> View {
    let (w, h) = shrunk_size(view.image.dimensions(), size);
    resized(view, w, h)
}

/// The views of all objects as squares of one size, at most `size` pixels and at most those of the smallest, to compare
/// renders with. Pixels stay square.
pub fn squares(objects: &[&[View]], size: u32) -> Vec<Vec<View>> {
    let windows = |o: &&[View]| o.iter().map(|v| Window::compared(v).cut(v).into_owned()).collect::<Vec<_>>();
    let cut: Vec<Vec<View>> = objects.iter().map(windows).collect();
    let side = cut.iter().flatten().map(|v| v.image.width()).min().map_or(size, |smallest| smallest.min(size));
    cut.iter().map(|o| o.iter().map(|v| resized(v, side, side)).collect()).collect()
}

fn resized(view: &View, w: u32, h: u32) -> View {
    if view.image.dimensions() == (w, h) {
        return view.clone();
    }
    View { name: view.name.clone(), camera: view.camera.resized(w, h), image: resize_area(&view.image, w, h) }
}

/// The posed images as the image encoder takes them.
#[derive(Clone, Debug)]
pub struct Conditioning {
    /// `[b, views, h, w, channels]`: color composited on white, then alpha where the encoder has four channels.
    pub images: Tensor<5>,
    /// `[b, views, rows, columns, 6]`, one ray per patch center.
    pub plucker: Tensor<5>,
    /// `[b, views, h, w, 6]`, one ray per pixel, for a pixel-aligned model.
    pub rays: Option<Tensor<5>>,
}

impl Conditioning {
    /// From the input views of each object; all objects have the same number of views. Images are cut or padded to
    /// [squares](Window::around) and resized to the encoder's side, intrinsics with them.
    pub fn new(objects: &[Vec<&View>], config: &ModelConfig, device: &Device) -> Result<Self, FlowError> {
        let (b, v) = (objects.len(), objects.first().map_or(0, Vec::len));
        if v == 0 {
            return Err(FlowError::NoViews);
        }
        let size = config.image_size;
        let (channels, grid) = (config.image_channels(), config.patches_per_side());
        let views: Vec<&View> = objects.iter().flatten().copied().collect();
        let side = if config.kind == ModelKind::PixelAligned { size as usize } else { 0 };
        let ((pixels, plucker_rays), rays): ((Vec<_>, Vec<_>), Vec<_>) = views
            .into_par_iter()
            .map(|view| {
                let view = resized(&Window::around(view).cut(view), size, size);
                let on_white = |p: &[f32; 4], c: usize| if c < 3 { p[c] * p[3] + 1.0 - p[3] } else { p[3] };
                let all = to_f32_rgba(&view.image);
                let pixels = all.as_chunks::<4>().0.iter().flat_map(|p| (0..channels).map(move |c| on_white(p, c)));
                let rays = |side| plucker(&view.camera, side, side);
                ((pixels.collect::<Vec<f32>>(), rays(grid)), rays(side))
            })
            .unzip();
        let size = size as usize;
        let tensor = |values: Vec<Vec<f32>>, side: usize, channels: usize| {
            Tensor::<5>::from_data(TensorData::new(values.concat(), [b, v, side, side, channels]), device)
        };
        Ok(Self {
            images: tensor(pixels, size, channels),
            plucker: tensor(plucker_rays, grid, PLUCKER),
            rays: (side > 0).then(|| tensor(rays, side, PLUCKER)),
        })
    }

    /// The Gaussians of a model that predicts in one pass: see [`FreeRange::predict`]. `[b, n, 14]`
    pub fn predict(self, model: &FreeRange) -> Tensor<3> {
        model.predict(model.encode(self.images, self.plucker), self.rays)
    }

    /// The image tokens. `[b, views * rows * columns, features]`
    pub fn encode(self, model: &FreeRange) -> Tensor<3> {
        model.encode(self.images, self.plucker)
    }
}
