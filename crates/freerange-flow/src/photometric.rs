//! The photometric loss between renders of Gaussians and images, and its gradient.

use burn::tensor::{Device, Tensor, TensorData};
use freerange_camera::{Camera, View, image_ops::composite};
use freerange_raster::{RasterConfig, rasterize};
use freerange_splat::Normalization;

use crate::FlowError;

/// Posed images to compare renders with: the same number of views, of one size, for every object of a batch.
#[derive(Clone, Debug)]
pub struct Targets {
    /// `[objects][views]`
    pub cameras: Vec<Vec<Camera>>,
    /// What lies behind the object, for each `[objects][views]`.
    pub backgrounds: Vec<Vec<[f32; 3]>>,
    /// `[objects, views, h, w, 3]`, composited on the backgrounds.
    pub images: Tensor<5>,
}

impl Targets {
    /// Targets from the chosen views of each object; all have one size. `background` is one colour per object.
    pub fn new(objects: &[Vec<&View>], background: &[[f32; 3]], device: &Device) -> Result<Self, FlowError> {
        let first = objects.first().and_then(|o| o.first()).ok_or(FlowError::NoViews)?;
        let (w, h) = first.image.dimensions();
        let views = objects[0].len();
        let mut pixels = Vec::with_capacity(objects.len() * views * (w * h * 3) as usize);
        for (object, &background) in objects.iter().zip(background) {
            for view in object {
                if view.image.dimensions() != (w, h) || object.len() != views {
                    return Err(FlowError::UnevenViews { expected: (w, h), found: view.image.dimensions() });
                }
                pixels.extend(composite(&view.image, background));
            }
        }
        let shape = [objects.len(), views, h as usize, w as usize, 3];
        Ok(Self {
            cameras: objects.iter().map(|o| o.iter().map(|v| v.camera).collect()).collect(),
            backgrounds: background.iter().map(|&b| vec![b; views]).collect(),
            images: Tensor::from_data(TensorData::new(pixels, shape), device),
        })
    }
}

/// Renders Gaussians given in the network's normalised parameter space, differentiably.
#[derive(Clone, Debug)]
pub struct Photometric {
    mean: Tensor<3>, // [1, 1, 14]
    std: Tensor<3>,  // [1, 1, 14]
}

/// Image width, in pixels, at which the rasteriser's screen-space blur means what it does in a viewer.
const VIEWER_WIDTH: f32 = 512.0;

impl Photometric {
    /// For Gaussians normalised by `normalization`, on `device`.
    pub fn new(normalization: &Normalization, device: &Device) -> Self {
        let row = |x: &[f32; 14]| Tensor::<1>::from_floats(*x, device).reshape([1, 1, 14]);
        Self { mean: row(&normalization.mean), std: row(&normalization.std) }
    }

    /// Raw channels from normalised ones. `[b, n, 14]`
    pub fn denormalize(&self, normalized: Tensor<3>) -> Tensor<3> {
        normalized * self.std.clone() + self.mean.clone()
    }

    /// L1 between the renders of `normalized` (`[b, n, 14]`) and the targets: the mean over views, pixels and channels
    /// for each object. Returns `[b]`.
    pub fn l1(&self, normalized: Tensor<3>, targets: &Targets) -> Result<Tensor<1>, FlowError> {
        let gaussians = self.denormalize(normalized);
        let raster = RasterConfig::default().shrunk(targets.images.dims()[3] as f32 / VIEWER_WIDTH);
        let render = rasterize(gaussians, &targets.cameras, &targets.backgrounds, &raster)?; // [b, v, h, w, 4]
        let [b, v, h, w, _] = render.dims();
        let difference = render.narrow(4, 0, 3) - targets.images.clone();
        Ok(difference.abs().reshape([b, v * h * w * 3]).mean_dim(1).reshape([b]))
    }

    /// The gradient of each object's L1 with respect to its normalised Gaussians, cut off from any graph. `[b, n, 14]`
    pub fn gradient(&self, normalized: Tensor<3>, targets: &Targets) -> Result<Tensor<3>, FlowError> {
        let leaf = normalized.inner().autodiff().require_grad();
        // Each object's loss depends on its own Gaussians alone: the gradient of the sum is every gradient at once.
        let mut gradients = self.l1(leaf.clone(), targets)?.sum().backward();
        leaf.grad_remove(&mut gradients).ok_or(FlowError::NoGradient)
    }
}
