//! The network: image encoders, the diffusion transformer, checkpoints.
//!
//! [`FreeRange`] is the whole network as one module; [`Checkpoint`] is a trained one with everything that sampling
//! needs.
//!
//! Architecture invariant: no losses, no data, no renders.

pub mod bench;
mod checkpoint;
mod compute;
mod config;
mod dit;
mod encoder;
mod error;
pub mod hub;
mod info;
mod kernels;
mod layers;
mod lift;
mod memory;
mod model;
mod one_pass;
mod ops;
#[cfg(test)]
mod tests;
mod weights;

pub use checkpoint::{Checkpoint, Header, Precision};
pub use compute::Compute;
pub use config::{
    CHANNELS, Dinov2Config, EncoderConfig, ModelConfig, ModelKind, OBSERVATION, PLACE, PLUCKER, PatchConfig,
    VolumeConfig,
};
pub use dit::{Dit, Feedback, time_embedding};
pub use encoder::{Dinov2, EncoderWeights, ImageEncoder, WeightsOrigin, position_embedding};
pub use error::ModelError;
pub use info::{Execution, ModelInfo, PartInfo, TensorInfo, Workload, dinov2_parameters, tensors};
pub use layers::{Linear, NormWeight};
pub use lift::CellViews;
pub use memory::keep_freed_memory;
pub use model::{FreeRange, Parameter};
pub use one_pass::Alignment;
