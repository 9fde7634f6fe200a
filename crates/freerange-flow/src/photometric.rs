//! The photometric loss between renders of Gaussians and images, and its gradient.

use burn::tensor::{Device, Tensor, TensorData};
use freerange_camera::{Camera, View, image_ops::to_f32_rgba};
use freerange_raster::{RasterConfig, rasterize};
use freerange_splat::Normalization;

use crate::FlowError;

/// The posed images of every object of a batch on the device, before any background: the same number of views, of one
/// size, for every object.
#[derive(Clone, Debug)]
pub struct Images {
    cameras: Vec<Vec<Camera>>, // [objects][views]
    colors: Tensor<5>,         // [objects, views, h, w, 3], times alpha
    transparency: Tensor<5>,   // [objects, views, h, w, 1]
}

impl Images {
    /// From the chosen views of each object.
    ///
    /// # Errors
    /// If there is no view, or numbers or sizes of views differ.
    pub fn new(objects: &[Vec<&View>], device: &Device) -> Result<Self, FlowError> {
        let first = objects.first().and_then(|o| o.first()).ok_or(FlowError::NoViews)?;
        let (w, h) = first.image.dimensions();
        let views = objects[0].len();
        let pixels = objects.len() * views * (w * h) as usize;
        let (mut colors, mut transparency) = (Vec::with_capacity(pixels * 3), Vec::with_capacity(pixels));
        for object in objects {
            for view in object {
                if view.image.dimensions() != (w, h) || object.len() != views {
                    return Err(FlowError::UnevenViews { expected: (w, h), found: view.image.dimensions() });
                }
                for p in to_f32_rgba(&view.image).as_chunks::<4>().0 {
                    colors.extend([p[3] * p[0], p[3] * p[1], p[3] * p[2]]);
                    transparency.push(1.0 - p[3]);
                }
            }
        }
        let shape = |channels: usize| [objects.len(), views, h as usize, w as usize, channels];
        Ok(Self {
            cameras: objects.iter().map(|o| o.iter().map(|v| v.camera).collect()).collect(),
            colors: Tensor::from_data(TensorData::new(colors, shape(3)), device),
            transparency: Tensor::from_data(TensorData::new(transparency, shape(1)), device),
        })
    }

    /// The images in front of one background colour per object: what renders are compared with.
    pub fn on(&self, backgrounds: &[[f32; 3]]) -> Targets {
        let (objects, views) = (self.cameras.len(), self.cameras.first().map_or(0, Vec::len));
        assert_eq!(backgrounds.len(), objects, "one background per object");
        let colors = TensorData::new(backgrounds.concat(), [objects, 1, 1, 1, 3]);
        let behind = Tensor::<5>::from_data(colors, &self.colors.device());
        Targets {
            cameras: self.cameras.clone(),
            backgrounds: backgrounds.iter().map(|&b| vec![b; views]).collect(),
            images: self.colors.clone() + self.transparency.clone() * behind,
        }
    }
}

/// Images to compare renders with.
#[derive(Clone, Debug)]
pub struct Targets {
    /// `[objects][views]`
    pub cameras: Vec<Vec<Camera>>,
    /// What lies behind the object, for each `[objects][views]`.
    pub backgrounds: Vec<Vec<[f32; 3]>>,
    /// `[objects, views, h, w, 3]`, composited on the backgrounds.
    pub images: Tensor<5>,
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

#[cfg(test)]
mod tests {
    use freerange_camera::image_ops::composite;
    use glam::DVec3;
    use image::{Rgba, RgbaImage};

    use super::*;

    #[test]
    fn images_are_composited_as_on_the_host() {
        let view = |seed: u32| View {
            name: String::new(),
            camera: Camera::look_at(DVec3::new(1.5, 0.0, 0.1 * f64::from(seed)), DVec3::ZERO, DVec3::Z, 0.8, 7, 5),
            image: RgbaImage::from_fn(7, 5, |x, y| Rgba([x, y, seed, x * y + seed].map(|v| (v * 37 % 256) as u8))),
        };
        let views: Vec<View> = (0..4).map(view).collect();
        let objects: Vec<Vec<&View>> = views.chunks(2).map(|o| o.iter().collect()).collect();
        let backgrounds = [[1.0, 0.0, 0.5], [0.2, 0.3, 0.4]];
        let targets = Images::new(&objects, &Device::flex()).unwrap().on(&backgrounds);
        assert_eq!(targets.images.dims(), [2, 2, 5, 7, 3]);
        assert_eq!(targets.cameras, [&views[..2], &views[2..]].map(|o| o.iter().map(|v| v.camera).collect::<Vec<_>>()));
        let found = targets.images.into_data().try_to_vec::<f32>().unwrap();
        let expected: Vec<f32> =
            views.iter().enumerate().flat_map(|(i, v)| composite(&v.image, backgrounds[i / 2])).collect();
        assert_eq!(found.len(), expected.len());
        for (a, b) in found.iter().zip(&expected) {
            assert!((a - b).abs() < 1e-6, "{a} {b}");
        }
    }

    #[test]
    fn uneven_views_are_refused() {
        let camera = Camera::look_at(DVec3::X, DVec3::ZERO, DVec3::Z, 0.8, 4, 4);
        let view = |w| View { name: String::new(), camera, image: RgbaImage::new(w, 4) };
        let (a, b) = (view(4), view(5));
        assert!(matches!(Images::new(&[vec![&a, &b]], &Device::flex()), Err(FlowError::UnevenViews { .. })));
        assert!(matches!(Images::new(&[vec![&a], vec![&a, &a]], &Device::flex()), Err(FlowError::UnevenViews { .. })));
        assert!(matches!(Images::new(&[], &Device::flex()), Err(FlowError::NoViews)));
    }
}
