//! Posed images of an object in, 3D Gaussians out, in the frame of the cameras.
//!
//! ```no_run
//! use std::path::Path;
//! use freerange::{DeviceName, Reconstructor, Scene, write_ply};
//!
//! # fn main() -> Result<(), freerange::Error> {
//! let model = Reconstructor::shipped(&DeviceName::Auto.open()?)?;
//! let scene = Scene::open(Path::new("examples/bowl"))?; // whatever the program reads
//! let result = model.reconstruct(&scene)?;
//! write_ply(&result.samples[0].gaussians, Path::new("gaussians.ply"))?;
//! # Ok(())
//! # }
//! ```
//!
//! # The pipeline
//! [`Reconstructor::run`] does five steps, which [`pipeline`] describes and [`PipelineConfig`] sets:
//! [canonicalize](Stage::Canonicalize), [symmetry](Stage::Symmetry), [propose](Stage::Propose),
//! [refine](Stage::Refine), [optimize](Stage::Optimize). [`Quality`] has its presets.
//!
//! With a checkpoint that only samples from noise, as those of `paper.toml` do, the pipeline is the paper's method and nothing
//! else. The shipped checkpoint refines initial fits; `propose.init = flow` begins with the paper's sampler instead.
//!
//! A [`Reconstructor`] holds a model on a device and takes one object after the other; it can be shared between threads. It
//! reports every step: [`Progress::preview`] gives the Gaussians by then, and `ControlFlow::Break` ends the work at the next
//! step with [`Error::Cancelled`]. The same views, options and device give the same bytes.
//!
//! Views come from a [`Scene`] on disk, or are made: a [`View`] is a name, a [`Camera`] and an RGBA image whose alpha is the
//! object's mask.
#![deny(missing_docs)]

mod checkpoint;
mod config;
mod device;
mod error;
pub mod machine;
mod others;
pub mod pictures;
pub mod pipeline;
mod progress;
mod reconstructor;
mod scene;
mod score;

pub use burn::tensor::Device;
pub use checkpoint::{EncoderPlaces, checkpoint_bytes, checkpoint_header, checkpoint_sha256, load_checkpoint};
pub use config::{
    Choices, Detect, Init, OptimizeConfig, Options, PipelineConfig, ProposeConfig, Quality, SymmetryConfig,
};
pub use device::{Api, DeviceName, Listed, Properties, devices, require};
pub use error::Error;
pub use freerange_camera::{Camera, FrameConfig, Similarity, Up, View};
pub use freerange_core::{Note, NoteKind};
pub use freerange_fit::QuickFitConfig;
pub use freerange_flow::{
    sample::{FlowConfig, RefinerConfig, SETTINGS_SCHEMA},
    settings::Settings,
};
pub use freerange_model::{Checkpoint, Compute};
pub use freerange_scene::{LoadConfig, MaskSource, estimate::Hints, read::ReadConfig};
pub use freerange_splat::{Cloud, write_ply};
pub use others::others_show;
pub use pipeline::{Reconstruction, Sample, choose_views, to_canonical, to_user};
pub use progress::{Progress, Stage};
pub use reconstructor::{Reconstructor, network_gaussians};
pub use scene::{Scene, SceneConfig};
pub use score::{Scores, ViewScore, score};
