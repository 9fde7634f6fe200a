//! Sampling: from noise to Gaussians that fit the posed images (paper, Section 3.5).

mod config;
mod drawn;
mod sampler;
mod solver;

use std::ops::ControlFlow;

use burn::tensor::{Device, Tensor};
use freerange_camera::View;
pub use freerange_core::Background;
use freerange_core::Invalid;
use freerange_model::Checkpoint;
use freerange_splat::{Cloud, channel};

pub use self::{
    config::{FromNoise, GradientAt, SETTINGS_SCHEMA, SampleConfig, StartConfig},
    sampler::{PhotometricStep, classifier_free, scale_gradient},
    solver::{Solver, Step, integrate},
};
use self::{
    drawn::{Drawn, Start},
    sampler::Sampler,
};
use crate::{FlowError, batch::Conditioning, photometric::Photometric};

/// Draws one sample of Gaussians per object and seed that fits the object's posed images. The whole of Section 3.5.
///
/// `objects` are the views of each object, as many for each, in its canonical frame (object within radius 0.5 of the
/// origin); so are the results, `[objects][seeds]`. `fits` are [quick fits](freerange_fit::quick_fit) of the views of each
/// object, or for each object of all its seeds, which `config.start` asks for and nothing else looks at. All samples run as one batch. `progress` is told of
/// every step and may end it all by `ControlFlow::Break`; on a GPU, the step is only queued by then, and nothing waits for
/// it but the end and whoever asks for the estimate's Gaussians.
///
/// # Errors
/// [`FlowError::Cancelled`] where `progress` says so; settings and views that cannot be used.
pub fn reconstruct(
    checkpoint: &Checkpoint,
    objects: &[&[View]],
    fits: Option<&[Cloud]>,
    config: &SampleConfig,
    seeds: &[u64],
    device: &Device,
    mut progress: impl FnMut(&Estimate<'_>) -> ControlFlow<()>,
) -> Result<Vec<Vec<Cloud>>, FlowError> {
    config.validate()?;
    config.validate_for(checkpoint.config.kind)?;
    if objects.is_empty() || seeds.is_empty() {
        return Ok(vec![Vec::new(); objects.len()]);
    }
    if checkpoint.config.kind.one_pass() {
        return one_pass(checkpoint, objects, config, seeds, device, progress);
    }
    let start = config.start.as_ref().map(|start| Start::new(start, fits, objects.len(), seeds.len())).transpose()?;
    let drawn = Drawn::new(checkpoint, config, start, objects.len(), seeds, device)?;
    let sampler = Sampler::new(checkpoint, objects, config, seeds.len(), &drawn, device)?;
    let guide = |step: &Step, estimate: &Tensor<3>| {
        let raw = sampler.photometric.denormalize(estimate.clone());
        let told = Estimate { index: step.index, t: step.t, raw: &raw, seeds: seeds.len() };
        match progress(&told) {
            ControlFlow::Break(()) => Err(FlowError::Cancelled),
            ControlFlow::Continue(()) => sampler.displacement(step, estimate),
        }
    };
    let begin = start.map_or(0.0, |start| start.config.time);
    let estimate = |step: &Step| sampler.estimate(step);
    let found = integrate(drawn.z.clone(), begin, config.steps, config.solver, estimate, guide)?;
    clouds(sampler.photometric.denormalize(found), seeds.len())
}

/// The Gaussians of a model that predicts in one pass. There is nothing to draw: one seed is all there is.
fn one_pass(
    checkpoint: &Checkpoint,
    objects: &[&[View]],
    config: &SampleConfig,
    seeds: &[u64],
    device: &Device,
    mut progress: impl FnMut(&Estimate<'_>) -> ControlFlow<()>,
) -> Result<Vec<Vec<Cloud>>, FlowError> {
    if seeds.len() > 1 {
        let kind = checkpoint.config.kind.name();
        return Err(Invalid::new("seeds", format!("one: a {kind} model has one answer"), seeds.len()).into());
    }
    let model = checkpoint.model.clone().with_compute(config.compute);
    let views: Vec<Vec<&View>> = objects.iter().map(|o| o.iter().collect()).collect();
    let predicted = Conditioning::new(&views, &checkpoint.config, device)?.predict(&model);
    let raw = Photometric::new(&checkpoint.normalization, device).raw(model.kind(), predicted);
    match progress(&Estimate { index: 0, t: 0.0, raw: &raw, seeds: 1 }) {
        ControlFlow::Break(()) => Err(FlowError::Cancelled),
        ControlFlow::Continue(()) => clouds(raw, 1),
    }
}

/// What the network takes the clean Gaussians to be, after a step of sampling.
#[derive(Clone, Copy, Debug)]
pub struct Estimate<'a> {
    /// Number of the step, from 0.
    pub index: usize,
    /// The time that the step began at.
    pub t: f32,
    raw: &'a Tensor<3>, // [b, n, 14]
    seeds: usize,
}

impl Estimate<'_> {
    /// The Gaussians, `[objects][seeds]`, in the objects' canonical frames. On a GPU this waits for what is queued.
    ///
    /// # Errors
    /// If the values cannot be read back.
    pub fn clouds(&self) -> Result<Vec<Vec<Cloud>>, FlowError> {
        clouds(self.raw.clone(), self.seeds)
    }
}

/// Raw channels as Gaussians. `[objects * seeds, n, 14]` to `[objects][seeds]`
fn clouds(raw: Tensor<3>, seeds: usize) -> Result<Vec<Vec<Cloud>>, FlowError> {
    let row = raw.dims()[1] * channel::COUNT;
    let values = raw.into_data().try_to_vec::<f32>().map_err(FlowError::device)?;
    let cloud = |rows: &[f32]| {
        let mut cloud = Cloud::from_rows(rows.to_vec());
        cloud.canonicalize_rotations();
        cloud
    };
    Ok(values.chunks_exact(row * seeds).map(|object| object.chunks_exact(row).map(cloud).collect()).collect())
}
