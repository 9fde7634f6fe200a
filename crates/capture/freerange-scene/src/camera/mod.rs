//! Pinhole cameras, posed-image scenes, the frames they live in, and the choice of views.
//!
//! This crate knows nothing of Gaussians.

mod error;
mod frame;
mod lens;
mod pinhole;
mod plucker;
pub mod scene;
mod selection;
mod square;

pub use error::{CameraError, Place};
pub use frame::{
    CANONICAL_RADIUS, CanonicalFrame, FrameConfig, Similarity, Up, cameras_up, canonical_from_user, nearest_point,
    outline_radius,
};
pub use freerange_util::image_ops;
pub use lens::Lens;
pub use pinhole::{Camera, View, pixel_of};
pub use plucker::plucker;
pub use scene::{Scene, load_cameras, transforms_json};
pub use selection::{SelectionConfig, ViewSets, inputs_around, inputs_beside, k_means, select_views};
pub use square::Window;
