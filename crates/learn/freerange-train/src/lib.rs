//! Training: batches, losses, the curriculum, the optimizer, the trainer and its ranks.
//!
//! Start with [`train::step`] (Section 3 of the paper) and [`trainer::Trainer`].
//!
//! Architecture invariant: no meshes; objects come from a stream, whoever makes them.

pub mod batch;
pub mod config;
mod error;
pub mod events;
mod flat;
mod inherit;
pub mod log;
mod optimizer;
pub mod ranks;
pub mod symmetry;
pub mod train;
pub mod trainer;
mod validation;
mod weights;

pub use config::ValidationConfig;
pub use error::TrainError;
pub use validation::Figures;
pub use weights::average;
