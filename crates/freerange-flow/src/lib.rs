//! Flow matching over Gaussians: the path, the losses, guidance, the solver, and the trainer.
//!
//! Start with [`train::step`] (Section 3 of the paper) and [`sample::FlowSampler`] (Sections 3.3 and 3.6).

pub mod batch;
pub mod config;
pub mod coupling;
mod error;
pub mod events;
mod inherit;
pub mod log;
mod optimizer;
pub mod path;
pub mod photometric;
mod place;
pub mod ranks;
pub mod sample;
pub mod settings;
pub mod symmetry;
pub mod train;
pub mod trainer;
mod validation;
mod weights;

pub use error::FlowError;
pub use validation::{Figures, ValidationConfig};
pub use weights::average;
