//! Training objects: how one is made from a seed, and how many are streamed.
//!
//! An object is its posed views and its Gaussians at the depths of the level-of-detail tree that training needs.
//! Making one is a pure function of (seed, configuration).

mod error;
mod object;
mod stream;
mod surface;

pub use error::DataError;
pub use object::{GaussianSource, Object, ObjectConfig};
pub use stream::{Generated, ObjectSource, Stream};
pub use surface::{SurfaceConfig, surface_gaussians};
