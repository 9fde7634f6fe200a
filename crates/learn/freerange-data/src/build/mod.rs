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
mod item_object;
mod items;
mod object;
mod object_config;
mod photographed;
mod quality;
mod surface;
#[cfg(test)]
mod tests;
mod validate;
mod work;

pub use config::{BuildConfig, BuildOverrides, MakingConfig, ShardConfig};
pub use contact_sheet::contact_sheet;
pub use error::BuildError;
pub use estimate::{Estimate, estimate};
pub use folder::{BuildOptions, Summary, build, collect, merge};
pub use freerange_assets::mesh::LoadLimits;
pub use freerange_util::Share;
pub use gallery::{GalleryConfig, gallery};
pub use item_object::{render_views, true_mesh};
pub use items::{Item, Items};
pub use object::{Generated, generate_object};
pub use object_config::{GaussianSource, ObjectConfig};
pub use photographed::Seconds;
pub use quality::{CountQuality, Quality, measure_quality};
pub use surface::{SurfaceConfig, surface_gaussians};
pub use work::Done;
