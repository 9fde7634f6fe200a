//! Stages of the curriculum, coarse to fine.

/// One stage of the curriculum: a depth of the tree, an image size, a number of steps.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage {
    /// Depth of the level-of-detail tree: 2^depth Gaussians.
    pub depth: u32,
    /// Side, in pixels, of the images that the network sees.
    pub image_size: u32,
    /// Objects per step.
    pub batch: usize,
    /// Objects computed at a time; gradients are averaged over a step's. Left out: all at once.
    #[serde(default)]
    pub micro_batch: Option<usize>,
    /// Side, in pixels, of the images that the rendering losses compare; left out: `loss.render_size`.
    #[serde(default)]
    pub render_size: Option<u32>,
    /// Side, in pixels, of the images that the network's gradient channels are taken on; left out: `loss.gradient_size`.
    #[serde(default)]
    pub gradient_size: Option<u32>,
    /// Steps.
    pub steps: u64,
}

impl Stage {
    /// Objects that are computed at a time, at most.
    pub fn at_a_time(&self) -> usize {
        self.micro_batch.unwrap_or(self.batch)
    }

    /// How many times a step computes for each of `virtual_ranks` virtual ranks, which divide the batch.
    pub fn parts_per_virtual_rank(&self, virtual_ranks: usize) -> usize {
        (self.batch / virtual_ranks).div_ceil(self.at_a_time())
    }
}
