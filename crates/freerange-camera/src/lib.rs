//! Pinhole cameras, posed-image scenes, the frames they live in, and the choice of views.
//!
//! This crate knows nothing of Gaussians.

mod camera;

pub use camera::{Camera, View};
