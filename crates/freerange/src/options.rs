use freerange_camera::FrameConfig;
use freerange_flow::sample::SampleConfig;
use freerange_splat::Cloud;

/// What a reconstruction should do. [`Reconstructor::options`](crate::Reconstructor::options) gives the model's own.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Options {
    /// How to sample.
    pub sample: SampleConfig,
    /// One sample per seed.
    pub seeds: Vec<u64>,
    /// Number of views that the model is shown, from all around the object; all views where there are no more. Left out: as
    /// many as the model has seen at once in training. Refinement looks at all.
    pub views: Option<usize>,
    /// Leave the network out: what sampling would start from is the sample. The control of every comparison.
    pub without_network: bool,
    /// Gaussians to start from instead of initial fits, in the frame of the views.
    pub init: Option<Cloud>,
    /// Which way is up in the views' frame, and where the object is, if that is known.
    pub frame: FrameConfig,
}
