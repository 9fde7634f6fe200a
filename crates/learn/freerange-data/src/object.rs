//! One training object.

use std::collections::BTreeMap;

use freerange_gaussians::Gaussians;
use freerange_scene::camera::View;

use crate::DataError;

/// A training object in the canonical frame.
#[derive(Clone, Debug)]
pub struct Object {
    /// What it is called in logs and shards.
    pub id: String,
    /// Posed images, all of one size.
    pub views: Vec<View>,
    /// Slices of the level-of-detail tree by depth; depth `l` has `2^l` Gaussians in tree order.
    pub slices: BTreeMap<u32, Gaussians>,
    /// What a few of the views tell without a network.
    pub input_fits: Vec<InputFit>,
}

impl Object {
    /// The Gaussians at `depth`.
    pub fn slice(&self, depth: u32) -> Result<&Gaussians, DataError> {
        self.slices.get(&depth).ok_or_else(|| DataError::Depth {
            object: self.id.clone(),
            expected: depth,
            found: self.slices.keys().copied().collect(),
        })
    }
}

/// A quick fit of some of an object's views.
#[derive(Clone, Debug, PartialEq)]
pub struct InputFit {
    /// The views it saw, by number.
    pub views: Vec<usize>,
    /// Its Gaussians, a power of two of them in the order of their tree.
    pub gaussians: Gaussians,
    /// The same Gaussians, one by one, after gradient steps towards all views of the object: what the fit should have been.
    /// Unlike Gaussians that were made otherwise, they differ from it only where the few views were not enough.
    pub target: Gaussians,
}

impl InputFit {
    /// The depth of the tree that its Gaussians are a slice at.
    pub fn depth(&self) -> u32 {
        self.gaussians.len().ilog2()
    }
}

/// PSNR in dB against views that the Gaussians were not fitted to, over white; mean over the views.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeldOutPsnr {
    /// Of the Gaussians before the tree.
    pub leaves: f64,
    /// Of the slices by depth.
    pub slices: BTreeMap<u32, f64>,
}

/// A part of the data.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Split {
    /// What models are trained on.
    #[default]
    Train,
    /// For choices between models.
    Validation,
    /// For the final figures.
    Test,
}

/// How views are stored, without loss in both.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ImageFormat {
    /// PNG: decodes faster.
    Png,
    /// WebP: smaller.
    #[default]
    Webp,
}

impl ImageFormat {
    /// Ending of file names.
    pub fn ending(self) -> &'static str {
        match self {
            Self::Png => "png",
            Self::Webp => "webp",
        }
    }
}
