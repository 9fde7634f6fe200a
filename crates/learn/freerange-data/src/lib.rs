//! Training objects: what one is, how many are stored and streamed.
//!
//! An object is its posed views and its Gaussians at the depths of the level-of-detail tree that training needs.
//! [`Shards`] reads a folder of them as a stream. How objects are made is `freerange-data`'s; here, a folder only says
//! so ([`Recipe`]).
//!
//! Architecture invariant: no network.

pub mod build;
mod error;
mod inspect;
pub mod layout;
mod manifest;
mod object;
#[cfg(feature = "cloud")]
mod remote;
mod sample;
mod shard;
mod shards;
mod store;
mod stream;

pub use error::DataError;
pub use inspect::{Inspection, inspect};
pub use manifest::{FORMAT, Failure, Input, Manifest, ObjectRecord, Plan, Recipe, ShardRecord};
pub use object::{HeldOutPsnr, ImageFormat, InputFit, Object, Split};
pub use sample::Metadata;
pub use shard::ShardReader;
pub use shards::Shards;
pub use store::{NewFile, Store};
pub use stream::{Making, ObjectSource, Stream};
