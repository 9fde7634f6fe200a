//! Training objects: what one is, how it is made, how many are stored and streamed.
//!
//! An object is its posed views and its Gaussians at the depths of the level-of-detail tree that training needs.
//! [`Shards`] reads a folder of them as a stream; [`build`] makes them of meshes or seeds. What reads them need not know how
//! they were made: a folder says so ([`Recipe`]), and training asks whoever makes them ([`Making`]).
//!
//! Architecture invariant: no neural network, no tensors.

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
