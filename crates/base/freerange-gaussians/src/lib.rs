//! Clouds of 3D Gaussians: the 14 channels, their normalization, the level-of-detail tree, and files.
//!
//! Architecture invariant: no tensors, no photos, no cameras. Of the workspace it uses `freerange-util` alone.

mod align;
mod edit;
mod eigen;
mod error;
pub mod formats;
mod gaussians;
mod harmonics;
mod merge;
mod normalize;
mod ply;
mod ply_columns;
mod ply_compressed;
mod ply_error;
mod ply_file;
mod ply_header;
mod ply_values;
mod splats;
mod tree;

pub use align::Alignment;
pub use error::SplatError;
pub use gaussians::{Gaussians, channel};
pub use harmonics::{Harmonics, MAX_DEGREE, coefficients};
pub use merge::{Gaussian, OPACITY_RANGE, merge};
pub use normalize::{Normalization, STD_FLOOR, Statistics};
pub use ply::{encode_ply, encode_splats, parse_ply, read_ply, write_ply};
pub use ply_columns::SCALE_OF_NONE;
pub use ply_file::PlyFile;
pub use splats::{RenderMode, Splats};
pub use tree::{LodTree, Node};

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
