//! Gaussians from a trained model: the paper's sampler, and the network refinement of Gaussians that are there already.
//!
//! * [`FlowSampler`]: from noise, by the learned flow, guided (paper, Sections 3.3 and 3.6). Input: the views of each
//!   object in its canonical frame and seeds. Output: one set of `2^lod_depth` Gaussians for each seed.
//! * [`Refiner`]: the same network as a fixed-point refinement. Input: views and proposals, sets of Gaussians of any
//!   number. Output: as many sets of `2^lod_depth` Gaussians.
//! * Models that predict in one pass have no steps and nothing random: [`FlowSampler`] runs them as they are.

mod conditioned;
mod config;
mod flow;
mod refiner;

use burn::tensor::Tensor;
use freerange_gaussians::{Gaussians, channel};

pub use self::{
    conditioned::scale_gradient,
    config::{FlowConfig, GradientAt, RefinerConfig, SETTINGS_SCHEMA},
    flow::{FlowSampler, Step, classifier_free, integrate},
    refiner::Refiner,
};
use crate::FlowError;

/// What the network takes the clean Gaussians to be, after a step.
#[derive(Clone, Copy, Debug)]
pub struct Estimate<'a> {
    /// Number of the step, from 0.
    pub index: usize,
    /// Time of the flow at the beginning of the step, 0 (noise) to 1; 0 throughout a refinement.
    pub t: f32,
    raw: &'a Tensor<3>, // [b, n, 14]
}

impl Estimate<'_> {
    /// The Gaussians in the objects' canonical frames: object by object, and of each one seed or proposal after the other.
    /// On a GPU this waits for queued work.
    ///
    /// # Errors
    /// If the values cannot be read back.
    pub fn clouds(&self) -> Result<Vec<Gaussians>, FlowError> {
        clouds(self.raw.clone())
    }
}

/// Raw channels as Gaussians. `[b, n, 14]` to `[b]`
fn clouds(raw: Tensor<3>) -> Result<Vec<Gaussians>, FlowError> {
    let row = raw.dims()[1] * channel::COUNT;
    let values = raw.into_data().try_to_vec::<f32>().map_err(FlowError::device)?;
    let cloud = |rows: &[f32]| {
        let mut cloud = Gaussians::from_rows(rows.to_vec());
        cloud.canonicalize_rotations();
        cloud
    };
    Ok(values.chunks_exact(row).map(cloud).collect())
}
