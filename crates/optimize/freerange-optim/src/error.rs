//! The crate's error.

use freerange_util::Invalid;

/// Why a fit cannot start or go on.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FitError {
    /// There is nothing to fit to.
    #[error("no views: a fit needs at least one")]
    NoViews,
    /// There is nothing to optimize.
    #[error("there are no Gaussians to start from")]
    NoGaussians,
    /// A view cannot be used.
    #[error("view {name:?}: {field}: expected {expected}, found {found}")]
    View {
        /// The view's name.
        name: String,
        /// What of it.
        field: &'static str,
        /// What it must be.
        expected: String,
        /// What it is.
        found: String,
    },
    /// A configuration value is impossible.
    #[error(transparent)]
    Config(#[from] Invalid),
    /// The optimization left the finite numbers.
    #[error("step {step}: {what} is not finite; smaller learning rates may help")]
    Diverged {
        /// The step, counted from 0.
        step: usize,
        /// What is not finite.
        what: &'static str,
    },
    /// The cloud to start from.
    #[error(transparent)]
    Splat(#[from] freerange_gaussians::SplatError),
    /// The rasterizer.
    #[error(transparent)]
    Raster(#[from] freerange_raster::RasterError),
    /// The loss.
    #[error(transparent)]
    Metrics(#[from] freerange_raster::metrics::ImageError),
}
