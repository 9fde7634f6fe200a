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
    /// Looks for the plane about which the object is its own mirror image, and the axis about which it keeps its outlines.
    Mirror,
    /// Fits Gaussians to the views quickly, for sampling to start from.
    Fit,
    /// Samples with the network; a sample from pure noise is polished and mended, too.
    Sample,
    /// Refines a sample on the views.
    Refine,
}

impl Stage {
    /// One word: `frame`, `mirror`, `fit`, `sample`, `refine`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Frame => "frame",
            Self::Mirror => "mirror",
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
    /// The photometric loss of the last step of a fit, of polishing or of a refinement.
    pub loss: Option<f64>,
    pub(crate) estimate: Option<(Known<'a>, &'a Similarity)>,
}

/// What is known of the Gaussians at a step.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Known<'a> {
    /// The state of a fit or a refinement.
    Fitted(&'a Cloud),
    /// The network's estimates, one per seed, where they lie.
    Sampled(&'a Estimate<'a>),
    /// The same, `[objects][seeds]`.
    Read(&'a [Vec<Cloud>]),
}

impl<'a> Progress<'a> {
    pub(crate) fn new(stage: Stage, done: usize, total: usize) -> Self {
        Self { stage, sample: 0, done, total, loss: None, estimate: None }
    }

    /// What the Gaussians are by now, in the frame of the views: the state of a fit, one cloud, which all samples start from; while sampling,
    /// what the network takes the clean Gaussians of each sample to be; while refining, the state of sample [`Progress::sample`], one cloud.
    /// None when a stage begins, while a sample is polished or mended, and for the other members of an ensemble. Costs a copy; on a GPU it
    /// waits for the step. Whether it is called changes no result.
    ///
    /// # Errors
    /// If a device fails.
    pub fn estimate(&self) -> Result<Option<Vec<Cloud>>, Error> {
        let Some((known, place)) = self.estimate else { return Ok(None) };
        let clouds = match known {
            Known::Fitted(cloud) => vec![cloud.clone()],
            Known::Sampled(estimate) => estimate.clouds()?.into_iter().flatten().collect(),
            Known::Read(clouds) => clouds.concat(),
        };
        Ok(Some(clouds.iter().map(|cloud| to_user(cloud, place)).collect()))
    }
}
