//! Training objects: how one is made of a mesh or a seed, and how many are made, stored and streamed.
//!
//! An object is its posed views and its Gaussians at the depths of the level-of-detail tree that training needs.
//! Making one is a pure function of (mesh, configuration, seed); [`build()`] makes many and writes them as shards,
//! [`Shards`] reads those as a stream, [`Generated`] makes objects on the fly.

mod build;
mod config;
mod error;
mod estimate;
mod fitted;
mod gallery;
mod input_fit;
mod inspect;
mod items;
mod manifest;
mod object;
mod quality;
#[cfg(feature = "cloud")]
mod remote;
mod sample;
mod shard;
mod shards;
mod store;
mod stream;
mod surface;
#[cfg(test)]
mod tests;
mod validate;

pub use build::{BuildOptions, Done, Summary, build, collect, merge, render_views};
pub use config::{BuildConfig, ImageFormat, ShardConfig, Split};
pub use error::DataError;
pub use estimate::{Estimate, estimate};
pub use freerange_core::Share;
pub use freerange_mesh::LoadLimits;
pub use gallery::{GalleryConfig, gallery};
pub use input_fit::InputFit;
pub use inspect::{Report, contact_sheet, inspect};
pub use items::{Input, Item, Items};
pub use manifest::{FORMAT, Failure, Manifest, ObjectRecord, Plan, ShardRecord};
pub use object::{GaussianSource, HeldOutPsnr, Object, ObjectConfig, Seconds};
pub use quality::{CountQuality, Quality, measure_quality, psnr_over_white};
pub use sample::Metadata;
pub use shard::ShardReader;
pub use shards::Shards;
pub use store::Store;
pub use stream::{Generated, ObjectSource, Stream};
pub use surface::{SurfaceConfig, surface_gaussians};
