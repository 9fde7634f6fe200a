//! Images on a device, and what renders are compared with.

use burn::tensor::{Device, Tensor, TensorData};
use freerange_scene::camera::{Camera, View, image_ops::to_f32_rgba};
use rayon::prelude::*;

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
        for view in objects.iter().flatten() {
            if view.image.dimensions() != (w, h) {
                return Err(FlowError::UnevenViews { expected: (w, h), found: view.image.dimensions() });
            }
        }
        if let Some(other) = objects.iter().find(|object| object.len() != views) {
            return Err(FlowError::UnevenNumbers { expected: views, found: other.len() });
        }
        let split = |object: &Vec<&View>| {
            let pixels = object.iter().flat_map(|view| to_f32_rgba(&view.image).as_chunks::<4>().0.to_vec());
            pixels.map(|[r, g, b, a]| ([a * r, a * g, a * b], 1.0 - a)).unzip::<_, _, Vec<[f32; 3]>, Vec<f32>>()
        };
        let (colors, transparency): (Vec<_>, Vec<_>) = objects.par_iter().map(split).unzip();
        let (colors, transparency) = (colors.concat().into_flattened(), transparency.concat());
        let shape = |channels: usize| [objects.len(), views, h as usize, w as usize, channels];
        Ok(Self {
            cameras: objects.iter().map(|o| o.iter().map(|v| v.camera).collect()).collect(),
            colors: Tensor::from_data(TensorData::new(colors, shape(3)), device),
            transparency: Tensor::from_data(TensorData::new(transparency, shape(1)), device),
        })
    }

    /// The images in front of one background color per object: what renders are compared with.
    pub fn on(&self, backgrounds: &[[f32; 3]]) -> Targets {
        let (objects, views) = (self.cameras.len(), self.cameras.first().map_or(0, Vec::len));
        assert_eq!(backgrounds.len(), objects, "one background per object");
        let colors = TensorData::new(backgrounds.concat(), [objects, 1, 1, 1, 3]);
        let behind = Tensor::<5>::from_data(colors, &self.colors.device());
        Targets {
            cameras: self.cameras.clone(),
            backgrounds: backgrounds.iter().map(|&b| vec![b; views]).collect(),
            images: self.colors.clone() + self.transparency.clone() * behind,
            object: Tensor::cat(vec![self.colors.clone(), self.transparency.clone().neg().add_scalar(1.0)], 4),
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
    /// The object in them: color times alpha, and alpha. `[objects, views, h, w, 4]`
    pub object: Tensor<5>,
}

#[cfg(test)]
mod tests {
    use freerange_scene::camera::image_ops::composite;
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
        let uneven = Images::new(&[vec![&a], vec![&a, &a]], &Device::flex()).err().unwrap().to_string();
        assert!(uneven.contains("equally many views: expected 1, found 2"), "{uneven}");
        assert!(matches!(Images::new(&[], &Device::flex()), Err(FlowError::NoViews)));
    }
}
