//! Flow matching from noise (paper, Section 3.6), with classifier-free and photometric guidance (Section 3.3).

use std::ops::ControlFlow;

use burn::tensor::{Device, Tensor, TensorData};
use freerange_gaussians::{Gaussians, channel};
use freerange_model::{Checkpoint, Feedback};
use freerange_scene::camera::View;
use freerange_util::Invalid;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::{
    Estimate, FlowConfig, GradientAt, clouds,
    conditioned::{Conditioned, gaussians},
};
use crate::{FlowError, conditioning::Conditioning, photometric::Photometric};

/// The paper's sampler: a model, how to sample from it, and where to compute.
#[derive(Clone, Copy, Debug)]
pub struct FlowSampler<'a> {
    /// The model.
    pub checkpoint: &'a Checkpoint,
    /// How to sample.
    pub config: &'a FlowConfig,
    /// Where to compute.
    pub device: &'a Device,
}

impl FlowSampler<'_> {
    /// Draws one set of Gaussians for each object and seed: object by object, and of each one seed after the other.
    ///
    /// `objects` are the views of each object, as many for each, in its canonical frame (the object within radius 0.5 of
    /// the origin); the results lie in it, too. All samples are one batch. `progress` hears of every step and may end the
    /// work by `ControlFlow::Break`; on a GPU the step is only queued by then.
    ///
    /// # Errors
    /// [`FlowError::Cancelled`] where `progress` says so; settings and views that cannot be used.
    pub fn sample(
        &self,
        objects: &[&[View]],
        seeds: &[u64],
        mut progress: impl FnMut(&Estimate<'_>) -> ControlFlow<()>,
    ) -> Result<Vec<Gaussians>, FlowError> {
        let &Self { checkpoint, config, device } = self;
        config
            .validate()
            .and_then(|()| config.validate_for(checkpoint.config.kind, config))
            .map_err(|e| e.within("sample"))?;
        if objects.is_empty() || seeds.is_empty() {
            return Ok(Vec::new());
        }
        if checkpoint.config.kind.one_pass() {
            return self.one_pass(objects, seeds, progress);
        }
        let depth = config.lod_depth.unwrap_or(checkpoint.depth);
        let n = gaussians(&checkpoint.config, "sample.lod_depth", depth)?;
        let network = Conditioned::new(checkpoint, objects, seeds.len(), config.gradient_size, config.compute, device)?;
        let (noise, backgrounds) = self.draw(objects.len(), seeds, n);
        // The last estimates of the network with and without images.
        let (mut last, mut without_images) = (None, None);
        let estimate = |step: &Step| {
            let backgrounds = &backgrounds[step.index];
            let at = match (config.gradient_at, &last) {
                (GradientAt::Estimate, Some(estimate)) => estimate,
                _ => &step.z,
            };
            let feedback = network.feedback(at, last.as_ref(), backgrounds)?;
            let found = guided(&network, step, feedback, config.cfg_scale, &mut without_images);
            last = Some(found.clone());
            let raw = network.photometric.denormalize(found.clone());
            match progress(&Estimate { index: step.index, t: step.t, raw: &raw }) {
                ControlFlow::Break(()) => Err(FlowError::Cancelled),
                ControlFlow::Continue(()) => Ok(found),
            }
        };
        let guide = |step: &Step, estimate: &Tensor<3>| match config.lambda_pg {
            0.0 => Ok(None),
            lambda => Ok(Some(network.gradient(estimate, &backgrounds[step.index])?.mul_scalar(lambda))),
        };
        let found = integrate(noise, config.steps, estimate, guide)?;
        clouds(network.photometric.denormalize(found))
    }

    /// The Gaussians of a model that predicts in one pass: nothing is random, so that one seed is all there is.
    fn one_pass(
        &self,
        objects: &[&[View]],
        seeds: &[u64],
        mut progress: impl FnMut(&Estimate<'_>) -> ControlFlow<()>,
    ) -> Result<Vec<Gaussians>, FlowError> {
        let &Self { checkpoint, config, device } = self;
        if seeds.len() > 1 {
            let kind = checkpoint.config.kind.name();
            return Err(Invalid::new("seeds", format!("one: a {kind} model has one answer"), seeds.len()).into());
        }
        let model = checkpoint.model.clone().with_compute(config.compute);
        let views: Vec<Vec<&View>> = objects.iter().map(|o| o.iter().collect()).collect();
        let predicted = Conditioning::new(&views, &checkpoint.config, device)?.predict(&model);
        let raw = Photometric::new(&checkpoint.normalization, device).raw(model.kind(), predicted);
        match progress(&Estimate { index: 0, t: 0.0, raw: &raw }) {
            ControlFlow::Break(()) => Err(FlowError::Cancelled),
            ControlFlow::Continue(()) => clouds(raw),
        }
    }

    /// Noise `[b, n, 14]` and the backgrounds of each step `[steps][b]`: each sample's from its own seed, whatever else is
    /// in the batch.
    fn draw(&self, objects: usize, seeds: &[u64], n: usize) -> (Tensor<3>, Vec<Vec<[f32; 3]>>) {
        let b = objects * seeds.len();
        let mut noise = Vec::with_capacity(b * n * channel::COUNT);
        let mut backgrounds = vec![Vec::with_capacity(b); self.config.steps];
        for &seed in (0..objects).flat_map(|_| seeds) {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut own: Vec<f32> = (0..n * channel::COUNT).map(|_| StandardNormal.sample(&mut rng)).collect();
            self.config.coupling.group(&mut own);
            noise.extend(own);
            backgrounds.iter_mut().for_each(|step| step.push(self.config.background.draw(&mut rng)));
        }
        (Tensor::from_data(TensorData::new(noise, [b, n, channel::COUNT]), self.device), backgrounds)
    }
}

/// The estimate of the clean sample with classifier-free guidance. `[b, n, 14]`
fn guided(
    network: &Conditioned<'_>,
    step: &Step,
    feedback: Feedback,
    scale: f32,
    without_images: &mut Option<Tensor<3>>,
) -> Tensor<3> {
    let b = step.z.dims()[0];
    let time = |count: usize| Tensor::full([count], step.t, network.device);
    if scale == 1.0 {
        return network.model.denoise(step.z.clone(), feedback, network.tokens.clone(), time(b));
    }
    // Conditional and unconditional branch in one batch. What would leak the images is zeros without them; zeros as an
    // estimate would be Gaussians that all lie in one place, so that the branch sees its own last one.
    let blind = |x: Tensor<3>| Tensor::cat(vec![x.clone(), x.zeros_like()], 0);
    let estimates = feedback.estimate.zip(without_images.take());
    let feedback = Feedback {
        gradient: feedback.gradient.map(blind),
        estimate: estimates.map(|(own, without)| Tensor::cat(vec![own, without], 0)),
        observation: feedback.observation.map(blind),
    };
    let z = step.z.clone().repeat_dim(0, 2);
    let out = network.model.denoise(z, feedback, blind(network.tokens.clone()), time(2 * b));
    let without = out.clone().narrow(0, b, b);
    *without_images = Some(without.clone());
    classifier_free(out.narrow(0, 0, b), without, scale)
}

/// `uncond + s (cond - uncond)`: classifier-free guidance.
pub fn classifier_free(conditional: Tensor<3>, unconditional: Tensor<3>, scale: f32) -> Tensor<3> {
    unconditional.clone() + (conditional - unconditional).mul_scalar(scale)
}

/// A step of the flow.
#[derive(Clone, Debug)]
pub struct Step {
    /// Number of the step, from 0.
    pub index: usize,
    /// Time of `z`, 0 to 1.
    pub t: f32,
    /// The sample at that time. `[b, n, 14]`
    pub z: Tensor<3>,
}

/// Integrates `dz/dt = (z1_hat - z) / (1 - t)` from time 0 to 1 in `steps` Euler steps. After each step but the last
/// `z <- z - displacement`, the photometric step `lambda grad`; the result is the last estimate, as the paper's. A single
/// step would not be guided at all, so that there its estimate is displaced.
///
/// # Errors
/// Those of `estimate` and `guide`.
pub fn integrate(
    mut z: Tensor<3>,
    steps: usize,
    mut estimate: impl FnMut(&Step) -> Result<Tensor<3>, FlowError>,
    mut guide: impl FnMut(&Step, &Tensor<3>) -> Result<Option<Tensor<3>>, FlowError>,
) -> Result<Tensor<3>, FlowError> {
    let mut index = 0;
    loop {
        let step = Step { index, t: index as f32 / steps as f32, z: z.clone() };
        let found = estimate(&step)?;
        let last = index + 1 == steps;
        if last && steps > 1 {
            return Ok(found);
        }
        let displacement = guide(&step, &found)?;
        let share = 1.0 / (steps - index) as f32; // of the way from z to the estimate
        z = if last { found } else { z.clone() + (found - z).mul_scalar(share) };
        if let Some(displacement) = displacement {
            z = z - displacement;
        }
        if last {
            return Ok(z);
        }
        index += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Data drawn from a normal distribution of mean `M` and deviation `S`: the best estimate, and the whole flow, are
    /// known.
    const M: f32 = 0.7;
    const S: f32 = 0.4;

    fn error(steps: usize) -> f32 {
        let noise = Tensor::<3>::from_data([[[-1.5f32, -0.3, 0.4, 2.0]]], &Device::flex());
        let estimate = |s: &Step| {
            let (t, rest) = (s.t, 1.0 - s.t);
            Ok((s.z.clone() - t * M).mul_scalar(t * S * S / (t * t * S * S + rest * rest)) + M)
        };
        let found = integrate(noise.clone(), steps, estimate, |_, _| Ok(None)).unwrap();
        let expected = noise.mul_scalar(S) + M;
        (found - expected).abs().max().into_scalar()
    }

    #[test]
    fn twice_the_steps_halve_the_error() {
        let [coarse, fine] = [80, 160].map(error);
        assert!(coarse / fine > 1.9 && coarse > 1e-5, "{coarse} {fine}");
    }

    #[test]
    fn guidance_moves_what_the_next_step_begins_with_and_a_single_step() {
        let run = |steps: usize| {
            let z = Tensor::<3>::from_data([[[0.0f32]]], &Device::flex());
            let mut seen = Vec::new();
            let estimate = |s: &Step| {
                seen.push(s.z.clone().into_scalar::<f32>());
                Ok(s.z.clone() + 1.0)
            };
            let found = integrate(z, steps, estimate, |_, e| Ok(Some(e.ones_like() * 0.25))).unwrap();
            (seen, found.into_scalar::<f32>())
        };
        // Half of the way to 1, less a quarter; then the estimate itself.
        assert_eq!(run(2), (vec![0.0, 0.25], 1.25));
        assert_eq!(run(1), (vec![0.0], 0.75));
    }
}
