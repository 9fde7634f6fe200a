//! What can go wrong while objects are made.

use freerange_util::{Invalid, IoError};

/// What can go wrong when training objects are made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BuildError {
    /// A configuration field has an impossible value.
    #[error(transparent)]
    Config(#[from] Invalid),
    /// Reading or writing failed.
    #[error(transparent)]
    Io(#[from] IoError),
    /// Shards, or the place they lie in.
    #[error(transparent)]
    Data(#[from] crate::DataError),
    /// The choice of views.
    #[error(transparent)]
    Camera(#[from] freerange_scene::camera::CameraError),
    /// The Gaussians or their tree.
    #[error(transparent)]
    Splat(#[from] freerange_gaussians::SplatError),
    /// The mesh or its renderer.
    #[error(transparent)]
    Mesh(#[from] freerange_assets::mesh::MeshError),
    /// The rasterizer.
    #[error(transparent)]
    Raster(#[from] freerange_raster::RasterError),
    /// The measures of image quality.
    #[error(transparent)]
    Metrics(#[from] freerange_raster::metrics::ImageError),
    /// The fit.
    #[error(transparent)]
    Fit(#[from] freerange_optim::FitError),
}
