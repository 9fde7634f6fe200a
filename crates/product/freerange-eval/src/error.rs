//! What can go wrong in an evaluation.

use std::path::PathBuf;

use freerange_util::IoError;

/// Why something cannot be evaluated or reported.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EvalError {
    /// Reading or writing failed.
    #[error(transparent)]
    Io(#[from] IoError),
    /// A file or folder is not what it should be.
    #[error("{}: expected {expected}, found {found}", path.display())]
    File {
        /// The file or folder.
        path: PathBuf,
        /// What it should be.
        expected: String,
        /// What it is.
        found: String,
    },
    /// A folder holds results of other settings.
    #[error(
        "{} holds results of other settings: {}; choose another folder, or --overwrite to throw them away",
        path.display(), differences.join("; ")
    )]
    Settings {
        /// The folder.
        path: PathBuf,
        /// One per setting that differs.
        differences: Vec<String>,
    },
    /// An object cannot be used.
    #[error("{object}: expected {expected}, found {found}")]
    Object {
        /// The object's name.
        object: String,
        /// What it should be like.
        expected: String,
        /// What it is like.
        found: String,
    },
    /// A report is asked for before all cases have been worked on.
    #[error("{0}: no result yet; run the other shards first, then without --shard")]
    NoRecord(String),
    /// Two reports cannot be compared.
    #[error("the reports cannot be compared: {0}")]
    Incomparable(String),
    /// A picture could not be encoded.
    #[error("picture: {0}")]
    Picture(#[from] image::ImageError),
    /// Cameras or their choice.
    #[error(transparent)]
    Camera(#[from] freerange_scene::camera::CameraError),
    /// The rasterizer.
    #[error(transparent)]
    Raster(#[from] freerange_raster::RasterError),
    /// The mesh of a result.
    #[error(transparent)]
    Surface(#[from] freerange_optim::meshing::SurfaceError),
    /// A metric.
    #[error(transparent)]
    Metrics(#[from] crate::metrics::MetricsError),
}

impl EvalError {
    pub(crate) fn file(path: &std::path::Path, expected: impl Into<String>, found: impl ToString) -> Self {
        Self::File { path: path.into(), expected: expected.into(), found: found.to_string() }
    }
}

impl From<freerange_raster::metrics::ImageError> for EvalError {
    fn from(e: freerange_raster::metrics::ImageError) -> Self {
        Self::Metrics(e.into())
    }
}
