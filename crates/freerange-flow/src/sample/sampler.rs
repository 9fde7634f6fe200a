//! What guides every step: the network with and without images, and the gradient of the renders.

use std::cell::RefCell;

use burn::tensor::{Device, Tensor, TensorData};
use freerange_camera::View;
use freerange_fit::tree_slice;
use freerange_model::{Checkpoint, Feedback, FreeRange, ModelConfig};
use freerange_splat::{Normalization, channel};

use super::{GradientAt, SampleConfig, Solver, Step, clouds, drawn::Drawn};
use crate::{
    FlowError,
    batch::{Conditioning, squares},
    photometric::{Images, Photometric},
};

/// What the photometric guidance takes lambda_PG times.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PhotometricStep {
    /// The gradient itself, the paper's.
    #[default]
    Gradient,
    /// The gradient as the network sees it: every channel at unit root mean square (measured in training), outliers cut.
    /// Beyond the paper: gradients of colours are a fifth of those of positions and so hardly move at a lambda at
    /// which positions are still stable.
    Scaled,
}

impl PhotometricStep {
    /// What lambda_PG multiplies, of a gradient whose channels have the root mean squares `rms`.
    fn of(self, gradient: Tensor<3>, rms: &Tensor<3>) -> Tensor<3> {
        match self {
            Self::Gradient => gradient,
            Self::Scaled => scale_gradient(gradient, rms),
        }
    }
}
/// `uncond + s (cond - uncond)`: classifier-free guidance.
pub fn classifier_free(conditional: Tensor<3>, unconditional: Tensor<3>, scale: f32) -> Tensor<3> {
    unconditional.clone() + (conditional - unconditional).mul_scalar(scale)
}

/// What all steps of a batch of samples share.
pub(super) struct Sampler<'a> {
    config: &'a SampleConfig,
    network: &'a ModelConfig,
    model: FreeRange,
    device: &'a Device,
    /// Of the images, once for each sample. `[b, m, c]`
    tokens: Tensor<3>,
    /// The same, and none. `[2 b, m, c]`
    both: Tensor<3>,
    pub(super) photometric: Photometric,
    normalization: &'a Normalization,
    /// Root mean square of the gradient's channels in training. `[1, 1, 14]`
    rms: Tensor<3>,
    /// What the gradient for the network is taken on.
    images: Images,
    /// What guidance is taken on.
    guiding: Images,
    backgrounds: &'a [Vec<[f32; 3]>],
    /// The latest estimate of the clean sample.
    previous: RefCell<Option<Tensor<3>>>,
    /// That of the network without images: what it is fed back there, as in training.
    without_images: RefCell<Option<Tensor<3>>>,
}

impl<'a> Sampler<'a> {
    pub(super) fn new(
        checkpoint: &'a Checkpoint,
        objects: &[&[View]],
        config: &'a SampleConfig,
        seeds: usize,
        drawn: &'a Drawn,
        device: &'a Device,
    ) -> Result<Self, FlowError> {
        let model = checkpoint.model.clone().with_compute(config.compute);
        // The images are encoded once; every sample and step shares the tokens.
        let views: Vec<Vec<&View>> = objects.iter().map(|o| o.iter().collect()).collect();
        let tokens = Conditioning::new(&views, &checkpoint.config, device)?.encode(&model); // [objects, m, c]
        let [count, m, c] = tokens.dims();
        let tokens = tokens.unsqueeze_dim::<4>(1).repeat_dim(1, seeds).reshape([count * seeds, m, c]);
        let both = Tensor::cat(vec![tokens.clone(), tokens.zeros_like()], 0);
        let at_size = |size: u32| {
            let small = squares(objects, size);
            let small: Vec<Vec<&View>> = small.iter().flat_map(|o| vec![o.iter().collect(); seeds]).collect();
            Images::new(&small, device)
        };
        let images = at_size(config.gradient_size)?;
        let guiding = match config.photometric_size {
            Some(size) if size != config.gradient_size => at_size(size)?,
            _ => images.clone(),
        };
        Ok(Self {
            config,
            network: &checkpoint.config,
            model,
            device,
            tokens,
            both,
            photometric: Photometric::new(&checkpoint.normalization, device),
            normalization: &checkpoint.normalization,
            rms: Tensor::<1>::from_floats(checkpoint.gradient_rms, device).reshape([1, 1, channel::COUNT]),
            images,
            guiding,
            backgrounds: &drawn.backgrounds,
            previous: RefCell::new(drawn.guess.clone()),
            without_images: RefCell::new(None),
        })
    }

    /// The guided estimate of the clean sample. `[b, n, 14]`
    pub(super) fn estimate(&self, step: &Step) -> Result<Tensor<3>, FlowError> {
        let SampleConfig { solver, regroup, .. } = *self.config;
        if solver == Solver::Hold && regroup > 0 && step.index > 0 && step.index.is_multiple_of(regroup) {
            let known = self.previous.take().map(|known| self.regrouped(known)).transpose()?;
            self.previous.replace(known);
        }
        let feedback = self.feedback(step)?;
        let b = step.z.dims()[0];
        let estimate = if self.config.cfg_scale == 1.0 {
            let t = Tensor::full([b], step.t, self.device);
            self.model.denoise(step.z.clone(), feedback, self.tokens.clone(), t)
        } else {
            // Conditional and unconditional branch in one batch.
            let z = step.z.clone().repeat_dim(0, 2);
            let blind = |x: Tensor<3>| Tensor::cat(vec![x.clone(), x.zeros_like()], 0);
            let t = Tensor::full([2 * b], step.t, self.device);
            // Zeros would be an estimate: of Gaussians that all lie in one place.
            let estimates = feedback.estimate.zip(self.without_images.take());
            let feedback = Feedback {
                gradient: feedback.gradient.map(blind),
                estimate: estimates.map(|(own, without)| Tensor::cat(vec![own, without], 0)),
                observation: feedback.observation.map(blind),
            };
            let out = self.model.denoise(z, feedback, self.both.clone(), t);
            let without = out.clone().narrow(0, b, b);
            self.without_images.replace(Some(without.clone()));
            classifier_free(out.narrow(0, 0, b), without, self.config.cfg_scale)
        };
        self.previous.replace(Some(estimate.clone()));
        Ok(estimate)
    }

    /// The same Gaussians in the order of a tree of their own, as those of a fit are.
    fn regrouped(&self, known: Tensor<3>) -> Result<Tensor<3>, FlowError> {
        let shape = known.dims();
        let mut rows = Vec::with_capacity(shape.iter().product());
        for cloud in clouds(self.photometric.denormalize(known), 1)?.into_iter().flatten() {
            rows.extend(self.normalization.normalize(&tree_slice(&cloud, shape[1].ilog2())?));
        }
        Ok(Tensor::from_data(TensorData::new(rows, shape), self.device))
    }

    /// What the network is told besides the sample: see [`Feedback`].
    fn feedback(&self, step: &Step) -> Result<Feedback, FlowError> {
        let known = self.previous.borrow().clone();
        let targets = || self.images.on(&self.backgrounds[step.index]);
        let gradient = match self.network.gradient_channels {
            false => None,
            true => {
                let at = match (self.config.gradient_at, &known) {
                    (GradientAt::Estimate, Some(estimate)) => estimate.clone(),
                    _ => step.z.clone(),
                };
                Some(scale_gradient(self.photometric.gradient(at, &targets())?, &self.rms))
            }
        };
        let observation = match &known {
            Some(known) if self.network.observed() > 0 => {
                Some(self.photometric.observe(known.clone(), &targets(), self.network.observed())?)
            }
            _ => None,
        };
        Ok(Feedback { gradient, estimate: known.filter(|_| self.network.estimate_channels), observation })
    }

    /// How far photometric guidance moves an estimate, to be subtracted; none where there is no guidance.
    pub(super) fn displacement(&self, step: &Step, estimate: &Tensor<3>) -> Result<Option<Tensor<3>>, FlowError> {
        let config = self.config;
        // What the paper returns is the last estimate as the network gives it. A single step would be guided by nothing.
        let last = step.index + 1 == config.steps && config.steps > 1;
        if config.lambda_pg == 0.0 || last {
            return Ok(None);
        }
        let targets = self.guiding.on(&self.backgrounds[step.index]);
        let mut moved = estimate.clone();
        for _ in 0..config.photometric_repeats {
            let gradient = self.photometric.gradient(moved.clone(), &targets)?;
            moved = moved - config.photometric_step.of(gradient, &self.rms).mul_scalar(config.lambda_pg);
        }
        if config.solver == Solver::Hold {
            self.previous.replace(Some(moved.clone())); // the sample does not move: what is fed back does
        }
        Ok(Some(estimate.clone() - moved))
    }
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
    fn guidance_follows_the_gradient_or_its_channels_at_one_scale() {
        let tensor = |values: [f32; 3]| Tensor::<3>::from_data([[values]], &Device::flex());
        let (gradient, rms) = (tensor([2e-4, -6e-6, 9.0]), tensor([1e-4, 3e-6, 0.1]));
        let of = |way: PhotometricStep| way.of(gradient.clone(), &rms).into_data().try_to_vec::<f32>().unwrap();
        assert_eq!(of(PhotometricStep::Gradient), [2e-4, -6e-6, 9.0]);
        let scaled = of(PhotometricStep::Scaled);
        assert!(scaled.iter().zip([2.0, -2.0, GRADIENT_LIMIT]).all(|(a, b)| (a - b).abs() < 1e-5), "{scaled:?}");
    }
}
