//! An endless, seeded stream of textured objects and their views, for training without any external asset.
//!
//! [`generate`] turns a seed into a [`Mesh`] in the canonical frame (+z up, inside the sphere of radius 0.5);
//! [`Scene`] adds an acceleration structure and baked light; [`render`] and [`sample_surface`] read it out.
//! Everything is a pure function of its seeds. Nothing here knows of Gaussians.

mod bake;
mod camera_rig;
mod config;
mod error;
mod household;
mod household_extra;
mod label;
mod lighting;
mod mesh;
mod noise;
mod objects;
mod palette;
mod part;
mod render;
mod sample;
mod scene;
mod shapes;
mod style;
mod texture;
mod trace;

pub use camera_rig::{CameraConfig, Coverage, orbit_cameras};
pub use config::{GeneratorConfig, Kind};
pub use error::MeshError;
pub use lighting::{Lighting, LightingConfig};
pub use mesh::Mesh;
pub use objects::{generate, kind_of};
pub use render::render;
pub use sample::{SurfacePoint, sample_surface};
pub use scene::{Hit, Scene};
pub use texture::{Material, Raster, Texture, linear_to_srgb, srgb_to_linear};
