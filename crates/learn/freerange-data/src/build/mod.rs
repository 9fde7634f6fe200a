//! Training objects in the making: of a mesh or a seed its views, its Gaussians, and their slices, and of many the shards
//! that `freerange-data` reads.
//!
//! Making one is a pure function of (mesh, configuration, seed); [`build()`] makes many, in shares that survive kills;
//! [`Generated`] makes objects on the fly.

mod config;
mod contact_sheet;
mod error;
mod estimate;
mod fitted;
mod folder;
mod gallery;
mod input_fit;
mod items;
mod object;
mod quality;
mod surface;
#[cfg(test)]
mod tests;
mod validate;

pub use config::{BuildConfig, BuildOverrides, MakingConfig, ShardConfig};
pub use contact_sheet::contact_sheet;
pub use error::BuildError;
pub use estimate::{Estimate, estimate};
pub use folder::{BuildOptions, Done, Summary, build, collect, merge, render_views, true_mesh};
pub use freerange_assets::mesh::LoadLimits;
pub use freerange_util::Share;
pub use gallery::{GalleryConfig, gallery};
pub use items::{Item, Items};
pub use object::{GaussianSource, Generated, ObjectConfig, Seconds, generate_object};
pub use quality::{CountQuality, Quality, measure_quality};
pub use surface::{SurfaceConfig, surface_gaussians};
