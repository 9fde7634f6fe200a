//! An endless, seeded stream of textured household objects, for training without any asset from outside.
//!
//! [`generate`] turns a seed into a mesh in the canonical frame (+z up, inside the sphere of radius 0.5). It is a pure
//! function of seed and configuration.

mod blend;
mod bottle;
mod canvas;
mod caps;
mod config;
mod decor;
mod glyph;
mod handles;
mod household;
mod jar;
mod label;
mod materials;
mod motif;
mod objects;
mod packaging;
mod palette;
mod part;
mod primitive;
mod shapes;
mod soft;
mod style;
mod toys;
mod turned;
mod vessels;
mod woven;

pub use config::{GeneratorConfig, Kind};
pub use objects::{generate, kind_of};
