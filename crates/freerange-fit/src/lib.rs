//! 3DGS-MCMC: posed views in, 3D Gaussians out.

mod error;

pub use error::FitError;
