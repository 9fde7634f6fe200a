//! What can go wrong in sampling.

use freerange_util::Invalid;

impl FlowError {
    /// Of a failed read-back.
    pub fn device(problem: impl std::fmt::Debug) -> Self {
        Self::Device { problem: format!("{problem:?}") }
    }
}

/// What can go wrong in sampling.
#[derive(Debug, thiserror::Error)]
pub enum FlowError {
    /// An object without views was given.
    #[error("an object without views: at least one posed image is needed")]
    NoViews,
    /// Objects of one batch differ in their number of views.
    #[error("objects of one batch must have equally many views: expected {expected}, found {found}")]
    UnevenNumbers {
        /// Views of the first object.
        expected: usize,
        /// Views of the object that differs.
        found: usize,
    },
    /// Views of one batch differ in size.
    #[error("views of one batch must agree in size: expected {}x{} pixels, found {}x{}", expected.0, expected.1, found.0, found.1)]
    UnevenViews {
        /// Size of the first view.
        expected: (u32, u32),
        /// Size of the view that differs.
        found: (u32, u32),
    },
    /// What was computed could not be read back from the device: it, or its driver, has failed.
    #[error("the device failed: {problem}")]
    Device {
        /// What it says.
        problem: String,
    },
    /// A gradient was asked for where nothing was differentiated.
    #[error("no gradient reached the Gaussians")]
    NoGradient,
    /// A configuration field has an impossible value.
    #[error(transparent)]
    Config(#[from] Invalid),
    /// The caller asked to stop.
    #[error("cancelled")]
    Cancelled,
    /// The rasterizer refused its input.
    #[error(transparent)]
    Raster(#[from] freerange_raster::RasterError),
    /// The model or its checkpoint.
    #[error(transparent)]
    Model(#[from] freerange_model::ModelError),
    /// Quick fits that sampling starts from, or how samples are measured.
    #[error(transparent)]
    Fit(#[from] freerange_optim::FitError),
}
