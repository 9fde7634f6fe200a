//! Flow matching over Gaussians: the path, guidance, and the samplers.
//!
//! Start with [`sample::FlowSampler`] (Sections 3.3 and 3.6 of the paper); [`sample::Refiner`] is the network refinement
//! of the shipped model.
//!
//! Architecture invariant: no training objects, no meshes, no files. What a checkpoint says of its use comes as values
//! ([`settings`]).

pub mod conditioning;
pub mod coupling;
mod error;
pub mod path;
pub mod photometric;
mod place;
pub mod sample;
pub mod settings;
pub mod targets;

pub use error::FlowError;
