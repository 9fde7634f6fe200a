//! Network refinement of Gaussians that are there already: what the shipped model is trained for (beyond the paper,
//! docs/research/decisions.md).

use std::ops::ControlFlow;

use burn::tensor::{Device, Tensor, TensorData};
use freerange_gaussians::{Gaussians, channel};
use freerange_model::Checkpoint;
use freerange_optim::tree_slice;
use freerange_scene::camera::View;
use freerange_util::Invalid;

use super::{
    Estimate, RefinerConfig, clouds,
    conditioned::{Conditioned, gaussians},
};
use crate::FlowError;

/// What renders are compared in front of: white, which results are compared on, too.
const BACKGROUND: [f32; 3] = [1.0; 3];

/// The network as a fixed-point refinement: at time 0 and without noise its estimate is the mean of what the photos and the
/// proposal allow, and it is fed back to the network from pass to pass.
#[derive(Clone, Copy, Debug)]
pub struct Refiner<'a> {
    /// The model.
    pub checkpoint: &'a Checkpoint,
    /// How to refine.
    pub config: &'a RefinerConfig,
    /// Where to compute.
    pub device: &'a Device,
}

impl Refiner<'_> {
    /// Refines as many `proposals` of each object, object by object; as many sets of Gaussians come back in their order.
    ///
    /// `objects` are the views of each object, as many for each, in its canonical frame (the object within radius 0.5 of
    /// the origin), in which proposals and results lie. A proposal may have any number of Gaussians; a result has
    /// `2^lod_depth`. All are one batch. `progress` hears of every pass and may end the work by `ControlFlow::Break`.
    ///
    /// # Errors
    /// [`FlowError::Cancelled`] where `progress` says so; settings, views and proposals that cannot be used.
    pub fn refine(
        &self,
        objects: &[&[View]],
        proposals: &[Gaussians],
        mut progress: impl FnMut(&Estimate<'_>) -> ControlFlow<()>,
    ) -> Result<Vec<Gaussians>, FlowError> {
        let &Self { checkpoint, config, device } = self;
        config.validate().map_err(|e| e.within("refiner"))?;
        let b = proposals.len();
        if objects.is_empty() || b == 0 || !b.is_multiple_of(objects.len()) {
            let expected = format!("as many, and some, for each of {} objects", objects.len());
            return Err(Invalid::new("proposals", expected, b).into());
        }
        if checkpoint.config.kind.one_pass() {
            let expected = format!("none: a {} model refines nothing", checkpoint.config.kind.name());
            return Err(Invalid::new("refiner", expected, "settings of one").into());
        }
        let depth = config.lod_depth.unwrap_or(checkpoint.depth);
        let n = gaussians(&checkpoint.config, "refiner.lod_depth", depth)?;
        let sets = b / objects.len();
        let network = Conditioned::new(checkpoint, objects, sets, config.gradient_size, config.compute, device)?;
        let tokenized = |clouds: &[Gaussians]| {
            let mut rows = Vec::with_capacity(b * n * channel::COUNT);
            for cloud in clouds {
                rows.extend(checkpoint.normalization.normalize(&tree_slice(cloud, depth)?));
            }
            Ok::<_, FlowError>(Tensor::<3>::from_data(TensorData::new(rows, [b, n, channel::COUNT]), device))
        };
        let mut estimate = tokenized(proposals)?;
        let noise = estimate.zeros_like();
        for index in 0..config.passes {
            if index > 0 && config.retokenize_every > 0 && index.is_multiple_of(config.retokenize_every) {
                estimate = tokenized(&clouds(network.photometric.denormalize(estimate))?)?;
            }
            let feedback = network.feedback(&estimate, Some(&estimate), &vec![BACKGROUND; b])?;
            let time = Tensor::full([b], 0.0, device);
            estimate = network.model.denoise(noise.clone(), feedback, network.tokens.clone(), time);
            let raw = network.photometric.denormalize(estimate.clone());
            if progress(&Estimate { index, t: 0.0, raw: &raw }).is_break() {
                return Err(FlowError::Cancelled);
            }
        }
        clouds(network.photometric.denormalize(estimate))
    }
}
