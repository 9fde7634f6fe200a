//! Views of textured meshes, for training without any picture from outside.
//!
//! [`Scene`] adds an acceleration structure and baked light to a mesh; [`render`] and [`sample_surface`] read it out;
//! [`orbit_cameras`] stand about the object. Everything is a pure function of its arguments.

mod bake;
mod camera_rig;
mod lighting;
mod refine;
mod reflect;
mod sample;
mod scene;
mod shade;
mod trace;
mod views;

pub use bake::BakeConfig;
pub use camera_rig::{CameraConfig, Coverage, orbit_cameras};
pub use lighting::{Lighting, LightingConfig};
pub use sample::{SurfacePoint, sample_surface};
pub use scene::{Hit, Scene};
pub use views::{render, render_in_steps};
