use std::path::PathBuf;

use freerange_core::{Invalid, IoError};
use freerange_flow::FlowError;

/// Why there is no reconstruction.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The caller's `progress` asked to stop.
    #[error("cancelled")]
    Cancelled,
    /// A view or an option cannot be used.
    #[error(transparent)]
    Input(#[from] Invalid),
    /// A device that this program does not have, or that cannot do what is asked of it.
    #[error("{0}")]
    NoDevice(String),
    /// A device that is there and does not work.
    #[error("{0}")]
    BrokenDevice(String),
    /// Reading or writing a file failed.
    #[error(transparent)]
    Io(#[from] IoError),
    /// A picture could not be written.
    #[error("{}: {source}", path.display())]
    Picture {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: image::ImageError,
    },
    /// The scene, its frame, or the choice of views.
    #[error(transparent)]
    Camera(#[from] freerange_camera::CameraError),
    /// A scene's cameras, photos or masks.
    #[error(transparent)]
    Scene(#[from] freerange_scene::SceneError),
    /// An initial fit or the optimization.
    #[error(transparent)]
    Fit(#[from] freerange_fit::FitError),
    /// Sampling.
    #[error(transparent)]
    Flow(FlowError),
    /// A metric.
    #[error(transparent)]
    Metrics(#[from] freerange_metrics::MetricsError),
    /// The model or its files.
    #[error(transparent)]
    Model(#[from] freerange_model::ModelError),
    /// The rasteriser.
    #[error(transparent)]
    Raster(#[from] freerange_raster::RasterError),
    /// Gaussians or their files.
    #[error(transparent)]
    Splat(#[from] freerange_splat::SplatError),
}

impl Error {
    /// Whether a device or the arithmetic failed; everything else is about what was given.
    pub fn is_failure(&self) -> bool {
        matches!(
            self,
            Self::Cancelled
                | Self::BrokenDevice(_)
                | Self::Fit(freerange_fit::FitError::Diverged { .. })
                | Self::Flow(
                    FlowError::NotFinite { .. }
                        | FlowError::NoGradient
                        | FlowError::Device { .. }
                        | FlowError::Cancelled
                )
        )
    }

    pub(crate) fn input(field: impl Into<String>, expected: impl Into<String>, found: impl ToString) -> Self {
        Self::Input(Invalid::new(field, expected, found))
    }
}

impl From<FlowError> for Error {
    fn from(e: FlowError) -> Self {
        match e {
            FlowError::Cancelled => Self::Cancelled,
            e => Self::Flow(e),
        }
    }
}
