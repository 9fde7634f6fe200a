//! A differentiable rasterizer of 3D Gaussians.
//!
//! A Gaussian has 14 channels, in this order: mean (3, world units), natural logarithm of the standard deviation along
//! each local axis (3), rotation from the local axes to the world's as a quaternion `w x y z` of any length (4), logit of
//! the opacity, color (3). Gradients are analytic and reach all 14.
//!
//! The image model is that of 3D Gaussian splatting (Kerbl et al. 2023) as gsplat computes it: the projected covariance
//! is that of the linearized projection plus [`RasterConfig::blur`]; Gaussians are blended from near to far by camera z
//! (ties in index order); a splat's opacity at a pixel is at most 0.99, and ignored below 1/255; blending stops before the
//! splat that would take the transmittance to 1e-4 or below.
//!
//! * `rasterize` (feature `op`): the differentiable operation on tensors, many objects and views in one call; with the
//!   feature `gpu` and one that says how to reach the device (`cuda`, `metal`, `vulkan`, `webgpu`), also on GPUs.
//! * [`render`], [`render_backward`]: the same on plain slices, without a tensor library.
//! * [`metrics`]: how alike two images are, with gradients.
//! * [`surface_depth`], [`surface_normals`]: where the surface is that Gaussians show, and which way it faces.
//! * [`mod@reference`]: slow, in f64, for tests.
//!
//! Architecture invariant: no models and no training; without the feature `op` no tensor framework.

#[cfg(test)]
extern crate self as freerange_raster; // the tests' scenes are also those of unit tests

mod config;
mod cpu;
mod error;
#[cfg(feature = "gpu")]
mod gpu;
#[cfg(feature = "op")]
mod job;
pub mod metrics;
mod mip;
#[cfg(feature = "op")]
mod op;
pub mod reference;

pub use config::RasterConfig;
pub use cpu::{Gradients, RenderOutput, render, render_backward, surface_depth, surface_normals};
pub use error::RasterError;
pub use mip::{MIP_BLUR, mip_compensated};
#[cfg(feature = "op")]
pub use op::rasterize;

/// Channels per Gaussian.
pub const CHANNELS: usize = 14;
