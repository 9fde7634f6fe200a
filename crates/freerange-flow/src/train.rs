//! One training step: the whole of Section 3 of the paper, on one screen.

use burn::tensor::{Device, Tensor};
use freerange_model::FreeRange;

use crate::{
    FlowError,
    batch::Batch,
    config::LossConfig,
    path::{flow_loss, interpolate, render_weight},
    photometric::Photometric,
    sample::scale_gradient,
};

/// The loss of a batch and its terms, each averaged over the batch.
#[derive(Clone, Debug)]
pub struct Losses {
    /// What is minimised: `L_FM + w(t) (R_Held + R_Seen)`. `[1]`
    pub total: Tensor<1>,
    /// The flow-matching loss L_FM. `[1]`
    pub flow: Tensor<1>,
    /// L1 over input views, without its weight. `[1]`
    pub seen: Tensor<1>,
    /// L1 over held-out views, without its weight. `[1]`
    pub held: Tensor<1>,
    /// Mean square of each channel of the photometric gradient over conditional samples, where there was one. `[14]`
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
) -> Result<Losses, FlowError> {
    let b = batch.t.len();
    let t = Tensor::<1>::from_floats(batch.t.as_slice(), device);
    let noisy = interpolate(batch.noise, batch.data.clone(), t.clone());

    // Photometric gradient at the noisy sample, as extra input channels; zeroed together with the images, lest it
    // leak them into the unconditional branch.
    let (hint, gradient_square) = match model.dit().gradient_channels() {
        true => {
            let gradient = photometric.gradient(noisy.clone(), &batch.hint)?;
            let [_, n, c] = gradient.dims();
            let square = gradient.clone().square().reshape([b * n, c]).mean_dim(0).reshape([c]);
            (Some(scale_gradient(gradient, gradient_rms) * batch.conditional.clone()), Some(square))
        }
        false => (None, None),
    };
    let tokens = batch.conditioning.encode(model) * batch.conditional;
    let estimate = model.denoise(noisy, hint, tokens, t.clone()); // z1_hat

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
    let weights: Vec<f32> = batch.t.iter().map(|&t| render_weight(t)).collect();
    let weight = Tensor::<1>::from_floats(weights.as_slice(), device);
    let total = (flow.clone() + (seen.clone() + held.clone()) * weight).mean();
    Ok(Losses {
        total,
        flow: flow.inner().mean(),
        seen: seen.inner().mean(),
        held: held.inner().mean(),
        gradient_square,
    })
}
