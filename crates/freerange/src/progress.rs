use std::fmt;

use freerange_camera::Similarity;
use freerange_flow::sample::Estimate;
use freerange_splat::Cloud;

use crate::{Error, to_user};

/// A part of a reconstruction, in the order in which they come.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Stage {
    /// Finds where the object is.
    Frame,
    /// Fits Gaussians to the views quickly, for sampling to start from.
    Fit,
    /// Samples with the network.
    Sample,
    /// Refines a sample on the views.
    Refine,
}

impl Stage {
    /// One word: `frame`, `fit`, `sample`, `refine`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Frame => "frame",
            Self::Fit => "fit",
            Self::Sample => "sample",
            Self::Refine => "refine",
        }
    }
}

impl fmt::Display for Stage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// How far a reconstruction has come.
#[derive(Clone, Copy, Debug)]
#[non_exhaustive]
pub struct Progress<'a> {
    /// What it is at.
    pub stage: Stage,
    /// Which of the samples, from 0, where they are worked on one after the other: in [`Stage::Refine`].
    pub sample: usize,
    /// Steps of the stage that are done; 0 when it begins.
    pub done: usize,
    /// All its steps.
    pub total: usize,
    /// The photometric loss of the last step of a fit or a refinement.
    pub loss: Option<f64>,
    pub(crate) estimate: Option<(&'a Estimate<'a>, &'a Similarity)>,
}

impl<'a> Progress<'a> {
    pub(crate) fn new(stage: Stage, done: usize, total: usize) -> Self {
        Self { stage, sample: 0, done, total, loss: None, estimate: None }
    }

    /// While sampling: what the network takes the clean Gaussians of each sample to be, in the frame of the views. None in
    /// other stages, when sampling begins, and for what is sampled only to help (`sample.ensemble`). Costs a copy; on a GPU it waits for the step.
    ///
    /// # Errors
    /// If a device fails.
    pub fn estimate(&self) -> Result<Option<Vec<Cloud>>, Error> {
        let Some((estimate, canonical_from_user)) = self.estimate else { return Ok(None) };
        let clouds = estimate.clouds()?.into_iter().flatten();
        Ok(Some(clouds.map(|cloud| to_user(&cloud, canonical_from_user)).collect()))
    }
}
