//! Textured triangle meshes: files in ([`load_mesh`]), materials and the textures that color them.
//!
//! What is drawn of a mesh is `render`'s, where meshes come from without files `generate`'s.

mod error;
mod load;
mod material;
pub mod noise;
mod pattern;
mod picture;
mod raster;
mod srgb;
mod texture;
mod triangles;

pub use error::MeshError;
pub use load::{LoadLimits, Loaded, MeshFormat, Up, load_mesh, load_mesh_bytes};
pub use material::{AlphaMode, Material};
pub use pattern::{Form, Frame, Pattern};
pub use picture::{Map, Picture, Wrap};
pub use raster::Raster;
pub use srgb::{linear_to_srgb, srgb_to_linear};
pub use texture::{Texture, Wear};
pub use triangles::Mesh;
