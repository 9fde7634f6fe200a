//! The network with everything that stays the same over the steps: image tokens, the photos that gradients are taken on.

use burn::tensor::{Device, Tensor};
use freerange_gaussians::channel;
use freerange_model::{Checkpoint, Compute, Feedback, FreeRange, ModelConfig};
use freerange_scene::camera::View;
use freerange_util::Invalid;

use crate::{FlowError, conditioning::Conditioning, conditioning::squares, photometric::Photometric, targets::Images};

/// The network, conditioned on the views of some objects. `b` is the number of objects times that of sets of each.
pub(super) struct Conditioned<'a> {
    pub network: &'a ModelConfig,
    pub model: FreeRange,
    pub device: &'a Device,
    /// Image tokens, repeated for the sets of each object. `[b, m, c]`
    pub tokens: Tensor<3>,
    pub photometric: Photometric,
    /// Root mean square of the gradient's channels in training. `[1, 1, 14]`
    rms: Tensor<3>,
    images: Images,
}

impl<'a> Conditioned<'a> {
    /// `sets` of Gaussians are made for each object; gradients are taken on squares of `gradient_size` pixels.
    pub fn new(
        checkpoint: &'a Checkpoint,
        objects: &[&[View]],
        sets: usize,
        gradient_size: u32,
        compute: Compute,
        device: &'a Device,
    ) -> Result<Self, FlowError> {
        let model = checkpoint.model.clone().with_compute(compute);
        // The images are encoded once; every set and step shares the tokens.
        let views: Vec<Vec<&View>> = objects.iter().map(|o| o.iter().collect()).collect();
        let tokens = Conditioning::new(&views, &checkpoint.config, device)?.encode(&model); // [objects, m, c]
        let [count, m, c] = tokens.dims();
        let tokens = tokens.unsqueeze_dim::<4>(1).repeat_dim(1, sets).reshape([count * sets, m, c]);
        let small = squares(objects, gradient_size);
        let small: Vec<Vec<&View>> = small.iter().flat_map(|o| vec![o.iter().collect(); sets]).collect();
        Ok(Self {
            network: &checkpoint.config,
            model,
            device,
            tokens,
            photometric: Photometric::new(&checkpoint.normalization, device),
            rms: Tensor::<1>::from_floats(checkpoint.gradient_rms, device).reshape([1, 1, channel::COUNT]),
            images: Images::new(&small, device)?,
        })
    }

    /// What the network sees beside the sample: the photometric gradient at `at`, and the last estimate with what views show
    /// of it where there is one. Renders are compared in front of `backgrounds`, one color for each set.
    pub fn feedback(
        &self,
        at: &Tensor<3>,
        estimate: Option<&Tensor<3>>,
        backgrounds: &[[f32; 3]],
    ) -> Result<Feedback, FlowError> {
        let targets = || self.images.on(backgrounds);
        let gradient = match self.network.gradient_channels {
            false => None,
            true => Some(scale_gradient(self.photometric.gradient(at.clone(), &targets())?, &self.rms)),
        };
        let observation = match estimate {
            Some(estimate) if self.network.observed() > 0 => {
                Some(self.photometric.observe(estimate.clone(), &targets(), self.network.observed())?)
            }
            _ => None,
        };
        let estimate = estimate.filter(|_| self.network.estimate_channels).cloned();
        Ok(Feedback { gradient, estimate, observation })
    }

    /// The photometric gradient at `estimate`, in normalized channels. `[b, n, 14]`
    pub fn gradient(&self, estimate: &Tensor<3>, backgrounds: &[[f32; 3]]) -> Result<Tensor<3>, FlowError> {
        self.photometric.gradient(estimate.clone(), &self.images.on(backgrounds))
    }
}

/// `2^depth`, the number of Gaussians.
///
/// # Errors
/// If a token of the model holds more than that.
pub(super) fn gaussians(config: &ModelConfig, field: &str, depth: u32) -> Result<usize, FlowError> {
    let fewest = config.gaussians_per_token;
    if 1usize << depth < fewest {
        let expected = format!("at least {}: a token of the model is {fewest} Gaussians", fewest.ilog2());
        return Err(Invalid::new(field, expected, depth).into());
    }
    Ok(1 << depth)
}

/// Largest magnitude of a gradient channel, in units of its root mean square: a few Gaussians have gradients
/// hundreds of times larger than the rest, which say no more than "much".
const GRADIENT_LIMIT: f32 = 5.0;

/// The gradient as the network sees it: every channel at unit root mean square, outliers cut.
pub fn scale_gradient(gradient: Tensor<3>, rms: &Tensor<3>) -> Tensor<3> {
    (gradient / rms.clone()).clamp(-GRADIENT_LIMIT, GRADIENT_LIMIT)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_have_one_scale_and_no_outliers() {
        let tensor = |values: [f32; 3]| Tensor::<3>::from_data([[values]], &Device::flex());
        let scaled = scale_gradient(tensor([2e-4, -6e-6, 9.0]), &tensor([1e-4, 3e-6, 0.1]));
        let scaled = scaled.into_data().try_to_vec::<f32>().unwrap();
        assert!(scaled.iter().zip([2.0, -2.0, GRADIENT_LIMIT]).all(|(a, b)| (a - b).abs() < 1e-5), "{scaled:?}");
    }
}
