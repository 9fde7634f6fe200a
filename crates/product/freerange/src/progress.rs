//! What a caller hears of a running reconstruction.

use std::fmt;

use freerange_diffusion::sample::Estimate;
use freerange_gaussians::Gaussians;
use freerange_scene::camera::Similarity;

use crate::{Error, error::Lift, to_user};

/// A step of the [pipeline](crate::pipeline), in the order in which they come.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Stage {
    /// Finds where the object is.
    Canonicalize,
    /// Looks for symmetries.
    Symmetry,
    /// Makes sets of Gaussians to begin with.
    Propose,
    /// Corrects them with the network.
    Refine,
    /// Optimizes them on the photos.
    Optimize,
}

impl Stage {
    /// One word: `canonicalize`, `symmetry`, `propose`, `refine`, `optimize`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Canonicalize => "canonicalize",
            Self::Symmetry => "symmetry",
            Self::Propose => "propose",
            Self::Refine => "refine",
            Self::Optimize => "optimize",
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
    /// The step of the pipeline.
    pub stage: Stage,
    /// Which of the samples is worked on, from 0.
    pub sample: usize,
    /// Steps of the stage that are done; 0 when it begins.
    pub done: usize,
    /// All its steps.
    pub total: usize,
    /// The photometric loss of the last step of a fit or of the optimization.
    pub loss: Option<f64>,
    pub(crate) preview: Option<(Preview<'a>, &'a Similarity)>,
}

/// The Gaussians at a step.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Preview<'a> {
    /// The state of a fit or of the optimization.
    Fit(&'a Gaussians),
    /// The network's estimate, on its device.
    Network(&'a Estimate<'a>),
    /// The same, read back.
    Read(&'a [Gaussians]),
}

impl Progress<'_> {
    /// The Gaussians by now, in the frame of the views: the state of the first fit, of the first proposal in the network, or
    /// of the optimization. None when a stage begins and while other proposals are worked on. Costs a copy; on a GPU it waits
    /// for queued work. Whether it is called changes no result.
    ///
    /// # Errors
    /// If a device fails.
    pub fn preview(&self) -> Result<Option<Gaussians>, Error> {
        let Some((preview, place)) = self.preview else { return Ok(None) };
        let cloud = match preview {
            Preview::Fit(cloud) => Some(cloud.clone()),
            Preview::Network(estimate) => estimate.clouds().lift()?.into_iter().next(),
            Preview::Read(clouds) => clouds.first().cloned(),
        };
        Ok(cloud.map(|cloud| to_user(&cloud, place)))
    }
}
