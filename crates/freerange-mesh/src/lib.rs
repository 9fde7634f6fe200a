//! An endless, seeded stream of textured objects and their views, for training without any external asset.
//!
//! [`generate`] turns a seed into a [`Mesh`] in the canonical frame (+z up, inside the sphere of radius 0.5);
//! [`Scene`] adds an acceleration structure and baked light; [`render`] and [`sample_surface`] read it out.
//! Everything is a pure function of its seeds. Nothing here knows of Gaussians.

mod bake;
mod blend;
mod camera_rig;
mod canvas;
mod config;
mod decor;
mod error;
mod gallery;
mod glyph;
mod handles;
mod household;
mod label;
mod lighting;
mod load;
mod materials;
mod mesh;
mod motif;
mod noise;
mod objects;
mod packaging;
mod palette;
mod part;
mod pattern;
mod picture;
mod refine;
mod reflect;
mod render;
mod sample;
mod scene;
mod shade;
mod shapes;
mod soft;
mod style;
mod texture;
mod trace;
mod turned;
mod vessels;
mod woven;

pub use bake::BakeConfig;
pub use camera_rig::{CameraConfig, Coverage, orbit_cameras};
pub use config::{GeneratorConfig, Kind};
pub use error::MeshError;
pub use gallery::{GalleryConfig, gallery};
pub use lighting::{Lighting, LightingConfig};
pub use load::{LoadLimits, Loaded, MeshFormat, Up, load_mesh, load_mesh_bytes};
pub use mesh::Mesh;
pub use objects::{generate, kind_of};
pub use pattern::{Pattern, Wear};
pub use picture::{Map, Picture, Wrap};
pub use render::{render, render_in_steps};
pub use sample::{SurfacePoint, sample_surface};
pub use scene::{Hit, Scene};
pub use texture::{AlphaMode, Material, Raster, Texture, linear_to_srgb, srgb_to_linear};
