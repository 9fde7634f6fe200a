//! One training step: the whole of Section 3 of the paper, on one screen.

use burn::{
    module::Module,
    tensor::{Device, Tensor},
};
use freerange_model::{Feedback, FreeRange};

use crate::{TrainError, batch::Batch, config::LossConfig};
use freerange_diffusion::{
    path::{flow_loss, interpolate},
    photometric::Photometric,
    sample::{GradientAt, scale_gradient},
};

/// The loss of a batch and its terms, each averaged over the batch.
#[derive(Clone, Debug)]
pub struct Losses {
    /// What is minimized: `L_FM + w(t) (R_Held + R_Seen)`. `[1]`
    pub total: Tensor<1>,
    /// The flow-matching loss L_FM. `[1]`
    pub flow: Tensor<1>,
    /// L1 over input views, without its weight. `[1]`
    pub seen: Tensor<1>,
    /// L1 over held-out views, without its weight. `[1]`
    pub held: Tensor<1>,
    /// Mean square of each channel of the photometric gradient over all samples, where there was one. `[14]`
    pub gradient_square: Option<Tensor<1>>,
}

/// The loss of one batch under `model` (on a differentiating device). The batch lives on the plain `device`.
///
/// `gradient_rms` (`[1, 1, 14]`) scales the gradient channels.
pub fn step(
    model: &FreeRange,
    batch: Batch,
    photometric: &Photometric,
    gradient_rms: &Tensor<3>,
    config: &LossConfig,
    device: &Device,
) -> Result<Losses, TrainError> {
    if model.kind().one_pass() {
        return one_pass(model, batch, photometric, config, device);
    }
    let b = batch.t.len();
    let t = Tensor::<1>::from_floats(batch.t.as_slice(), device);
    let noisy = interpolate(batch.noise, batch.data.clone(), t.clone());

    let tokens = batch.conditioning.encode(model) * batch.conditional.clone();
    // What is known besides the noisy sample: an earlier estimate of the clean one, and the photometric gradient there.
    // Both are zeroed together with the images, lest they leak them into the unconditional branch.
    let feedback = |earlier: Option<Tensor<3>>| -> Result<(Feedback, Option<Tensor<1>>), TrainError> {
        let gradient = match model.dit().gradient_channels() {
            true => {
                let at = earlier.clone().filter(|_| config.gradient_at == GradientAt::Estimate);
                Some(photometric.gradient(at.unwrap_or_else(|| noisy.clone()), &batch.gradient_targets)?)
            }
            false => None,
        };
        let square = gradient.clone().map(|g| {
            let [b, n, c] = g.dims();
            g.square().reshape([b * n, c]).mean_dim(0).reshape([c])
        });
        let gradient = gradient.map(|g| scale_gradient(g, gradient_rms) * batch.conditional.clone());
        let observation = match &earlier {
            Some(earlier) if model.dit().observed() > 0 => {
                Some(photometric.observe(earlier.clone(), &batch.gradient_targets, model.dit().observed())?)
            }
            _ => None,
        };
        let observation = observation.map(|o| o * batch.conditional.clone());
        let estimate = earlier.filter(|_| model.dit().estimate_channels());
        Ok((Feedback { gradient, estimate, observation }, square))
    };
    let mut earlier = batch.fits;
    for _ in 0..batch.estimates {
        let (known, _) = feedback(earlier)?;
        let plain = model.clone().valid();
        earlier = Some(plain.denoise(noisy.clone(), known, tokens.clone().inner(), t.clone()));
    }
    let (feedback, gradient_square) = feedback(earlier)?;
    let estimate = model.denoise(noisy, feedback, tokens, t.clone()); // z1_hat

    let zero = || Tensor::<1>::zeros([b], device);
    let flow = match config.flow {
        true => flow_loss(estimate.clone(), batch.data, t, config.min_remaining),
        false => zero(),
    };
    let seen = match config.seen {
        true => photometric.l1(estimate.clone(), &batch.seen)?,
        false => zero(),
    };
    let held = match (config.held, &batch.held) {
        (true, Some(targets)) => photometric.l1(estimate, targets)?,
        _ => zero(),
    };
    let weight = Tensor::<1>::from_floats(batch.render_weights.as_slice(), device);
    let total = (flow.clone() + (seen.clone() + held.clone()) * weight).mean();
    Ok(Losses {
        total,
        flow: flow.inner().mean(),
        seen: seen.inner().mean(),
        held: held.inner().mean(),
        gradient_square,
    })
}

/// The loss of a model that predicts in one pass: `R_Held + R_Seen`, without a time to weigh them by.
fn one_pass(
    model: &FreeRange,
    batch: Batch,
    photometric: &Photometric,
    config: &LossConfig,
    device: &Device,
) -> Result<Losses, TrainError> {
    let gaussians = photometric.raw(model.kind(), batch.conditioning.predict(model)); // [b, n, 14]
    let zero = || Tensor::<1>::zeros([batch.t.len()], device);
    let seen = match config.seen {
        true => photometric.l1_raw(gaussians.clone(), &batch.seen)?,
        false => zero(),
    };
    let held = match (config.held, &batch.held) {
        (true, Some(targets)) => photometric.l1_raw(gaussians, targets)?,
        _ => zero(),
    };
    Ok(Losses {
        total: (seen.clone() + held.clone()).mean(),
        flow: zero().mean(),
        seen: seen.inner().mean(),
        held: held.inner().mean(),
        gradient_square: None,
    })
}
