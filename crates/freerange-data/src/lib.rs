//! Training objects: how one is made from a seed, and how many are streamed.
//!
//! An object is its posed views and its Gaussians at the depths of the level-of-detail tree that training needs.
//! Making one is a pure function of (seed, configuration).

mod error;
mod file;
mod fitted;
mod generate;
mod inspect;
mod manifest;
mod object;
mod quality;
mod sample;
mod shard;
mod shards;
mod stream;
mod surface;
#[cfg(test)]
mod tests;
mod validate;

pub use error::DataError;
pub use generate::{GenerateConfig, Summary, generate_shards};
pub use inspect::{Report, contact_sheet, inspect};
pub use manifest::{FORMAT, Failure, Manifest, ShardRecord};
pub use object::{GaussianSource, Object, ObjectConfig};
pub use quality::{Quality, Seconds, measure_quality};
pub use sample::Metadata;
pub use shard::{ShardReader, ShardWriter};
pub use shards::Shards;
pub use stream::{Generated, ObjectSource, Stream};
pub use surface::{SurfaceConfig, surface_gaussians};
