//! The network: image encoders, the diffusion transformer, checkpoints.

mod config;
mod dit;
mod error;
mod kernels;
mod layers;
mod ops;

pub use config::{CHANNELS, Dinov2Config, EncoderConfig, FinalLayer, ModelConfig, PLUCKER, PatchConfig};
pub use dit::{Dit, time_embedding};
pub use error::ModelError;
pub use layers::{Linear, NormWeight};
