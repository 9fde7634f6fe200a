//! Photos in: the cameras of other programs, lenses, masks of the object, and what was understood of it all.
//!
//! [`read::cameras_with`] finds out what a folder is and reads the cameras; [`Scene::load`] makes views of the photos,
//! undistorted and cut out, and says which way is up.
//!
//! Architecture invariant: no Gaussians and no tensors.

#![deny(missing_docs)]

pub mod camera;
mod decode;
mod error;
pub mod estimate;
pub mod inspect;
mod load;
mod mask_model;
#[cfg(feature = "mask-model")]
mod network;
mod open;
pub mod read;
mod write;

pub use error::SceneError;
pub use freerange_util::{Note, NoteKind};
pub use load::{
    KeepWhole, LoadConfig, Loaded, MaskKind, MaskSource, Whole, cut, files, load, mask_file, up_of, write_masks,
};
pub use mask_model::{MaskModel, PixelRange};
pub use open::{Scene, SceneConfig, views_to_compare};
pub use write::write_colmap;

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
