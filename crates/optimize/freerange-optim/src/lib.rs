//! 3DGS-MCMC: posed views in, 3D Gaussians out.
//!
//! * [`fit`]: from nothing but views (Kheradmand et al. 2024), which is how training objects become clouds.
//! * [`frame_of`]: where a fit says the object is.
//! * [`find_mirror`]: the plane about which an object is its own mirror image, and [`mirrored`] photos of it.
//! * [`find_axis`]: the axis about which it may be turned and keeps its silhouettes, and [`turned`] ones.
//! * [`psnr_over_white`]: how well Gaussians show what views show.
//! * [`optimize`]: the same from a cloud that is already good, held where no view looks.
//!
//! Plain Rust over the rasterizer's CPU functions.
//!
//! Architecture invariant: no neural network, no tensors, no source meshes.

mod adam;
mod anchors;
mod axis;
mod config;
mod error;
mod fit;
mod frame;
mod init;
mod initial;
mod mcmc;
pub mod meshing;
mod mirror;
mod objective;
mod optimize;
mod quality;
mod reproject;
mod search;
mod surface;
#[cfg(test)]
mod tests;
mod views;

pub use axis::{Axis, FoundAxis, axis_steps, find_axis, turned};
pub use config::{AnchorConfig, FitConfig, OptimizationConfig, Rates};
pub use error::FitError;
pub use fit::fit;
pub use frame::frame_of;
pub use initial::{InitialFitConfig, LeaveOneOut, initial_fit, tree_slice};
pub use mirror::{FoundMirror, Mirror, find_mirror, mirror_steps, mirrored};
pub use optimize::optimize;
pub use quality::{over_white, psnr_over_white, render_over_white};
pub use views::{Evidence, PosedImage};

use freerange_gaussians::Gaussians;

/// How far [`fit`] or [`optimize`] has come.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FitProgress<'a> {
    /// Steps done.
    pub step: usize,
    /// Steps in all.
    pub steps: usize,
    /// Loss before the last step, on what it looked at: photometric on views; of alpha, at every other step of a fit, on silhouettes if there are any.
    pub loss: f64,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// The Gaussians by now, in the frame of the views.
    pub cloud: &'a Gaussians,
}
