//! Clouds of 3D Gaussians: the 14 channels, their normalisation, the level-of-detail tree, and files.
//!
//! This crate knows nothing of tensors, images or cameras: everything downstream builds on it.

mod cloud;

pub use cloud::{Cloud, channel};
