//! Similarity of DINO features.
//!
//! Papers mean several things by it. This is the cosine of the class tokens (after the final norm) of a DINOv2, which
//! is what Free-Range Gaussians names ("DINOv2-feature"), without saying which size; we take the base size that its
//! encoder has. DreamBooth's "DINO" is the first DINO's ViT-S/16 and gives other numbers. Images are prepared as Hugging Face's
//! processor of `facebook/dinov2-base` does: shorter side to 256 by Pillow's bicubic, middle 224 x 224, ImageNet's mean
//! and deviation. An eighth of the picture at each pair of borders is thus not seen.

use std::path::Path;

use burn::tensor::{Device, Tensor, TensorData};
use freerange_model::Dinov2;

use super::resize::Image8;
use crate::metrics::MetricsError;

const SHORTER_SIDE: usize = 256;
const CROP: usize = 224;

pub(crate) struct Dino {
    network: Dinov2,
    device: Device,
}

impl Dino {
    /// Reads a folder of Hugging Face's `transformers`.
    pub fn load(folder: &Path, device: &Device) -> Result<Self, MetricsError> {
        let network = Dinov2::load(folder, device).map_err(|e| MetricsError::format(folder, "DINOv2", e))?;
        let patch = network.config().patch_size as usize;
        if patch > CROP {
            return Err(MetricsError::format(
                folder,
                "DINOv2",
                format!("patches of {patch} pixels, expected at most {CROP}"),
            ));
        }
        Ok(Self { network, device: device.clone() })
    }

    /// The class tokens.
    pub fn embed(&self, images: &[Image8]) -> Vec<Vec<f32>> {
        let mut values = Vec::with_capacity(images.len() * 3 * CROP * CROP);
        images.iter().for_each(|image| prepare(image, &mut values));
        let pixels = TensorData::new(values, [images.len(), 3, CROP, CROP]);
        let tokens = self.network.forward(Tensor::from_data(pixels, &self.device)); // [b, tokens, d]
        let [b, _, d] = tokens.dims();
        super::rows(tokens.narrow(1, 0, 1).reshape([b, d]))
    }
}

/// Appends one image as the network takes it. `[3, 224, 224]`
pub(crate) fn prepare(image: &Image8, out: &mut Vec<f32>) {
    let shorter = image.width.min(image.height);
    let longer = |side: usize| (SHORTER_SIDE * side / shorter).max(SHORTER_SIDE);
    let resized = image.bicubic(longer(image.width), longer(image.height));
    let (mean, deviation) = ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]);
    resized.center_crop(CROP, CROP).append_normalized(mean, deviation, out);
}
