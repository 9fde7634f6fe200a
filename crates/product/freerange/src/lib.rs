//! Posed images of an object in, 3D Gaussians out, in the frame of the cameras.
//!
//! Architecture invariant: no training, and nothing of the command line.
//!
#![cfg_attr(feature = "embedded", doc = "```no_run")]
#![cfg_attr(not(feature = "embedded"), doc = "```ignore")]
//! use std::path::Path;
//! use freerange::{Device, Reconstructor, Scene};
//!
//! # fn main() -> Result<(), freerange::Error> {
//! let scene = Scene::open(Path::new("examples/bowl"))?; // whatever the program reads
//! let model = Reconstructor::shipped(&Device::open("auto")?)?;
//! let result = model.reconstruct(&scene)?;
//! result.write(Path::new("gaussians.ply"))?; // or .glb, .spz, .usdz ...
//! # Ok(())
//! # }
//! ```
//!
//! # The five steps
//! [`Reconstructor::run`] does five steps, each a [`Stage`] with settings of its own in [`PipelineConfig`]; [`pipeline`] says
//! what goes in and out of each, and [`Quality`] has presets.
//!
//! | step | settings | in short |
//! |---|---|---|
//! | [canonicalize](Stage::Canonicalize) | [`FrameConfig`], `network_views` | where the object is and which way is up; photos are cropped to it; views for the network are chosen |
//! | [symmetry](Stage::Symmetry) | [`SymmetryConfig`] | a mirror plane adds mirrored photos, an axis of revolution adds rotated silhouettes |
//! | [propose](Stage::Propose) | [`ProposeConfig`] | some sets of Gaussians: initial fits, or samples of the learned flow from noise (the paper's method) |
//! | [refine](Stage::Refine) | [`RefinerConfig`] | the network corrects each proposal |
//! | [optimize](Stage::Optimize) | [`OptimizeConfig`] | photos decide where they look, the proposals' mean renders where none does |
//!
//! With a checkpoint that only samples from noise, as those of `paper.toml` do, the pipeline is the paper's method and nothing
//! else. The shipped checkpoint refines initial fits; `propose.init = flow` begins with the paper's sampler instead.
//!
//! # Progress, threads, repeatability
//! A [`Reconstructor`] holds a model on a device and takes one object after the other; it can be shared between threads. It
//! reports every step: [`Progress::preview`] gives the Gaussians by then, and `ControlFlow::Break` ends the work at the next
//! step with [`Error::Cancelled`]. The same views, options and device give the same bytes.
//!
//! # Views that are made
//! Views come from a [`Scene`] on disk, or are made: a [`View`] is a name, a [`Camera`] and an RGBA image whose alpha is the
//! object's mask; [`cut_out`] finds masks. [`image`] and [`glam`] are re-exported, so that the versions agree.
//!
//! # Features
//! `embedded` (default) has the shipped checkpoint in the library, 40 MB. `cuda`, `metal`, `vulkan`, `webgpu`: see [`Device`].
//!
//! Architecture invariant: no training and no training objects; reads scenes and checkpoints, and prints nothing.
#![deny(missing_docs)]

mod checkpoint;
mod config;
mod device;
mod error;
mod files;
mod frame;
#[doc(hidden)]
pub mod internal;
mod leave_one_out;
pub mod machine;
pub mod pictures;
pub mod pipeline;
mod progress;
mod reconstructor;
mod scene;
mod score;
mod warnings;

pub use checkpoint::EncoderPlaces;
pub use config::{
    Choices, Detect, Init, OptimizeConfig, Options, PipelineConfig, ProposeConfig, Quality, SymmetryConfig,
};
pub use device::{Device, DeviceInfo, DeviceName, DeviceProperties, GpuApi};
pub use error::{Cause, Error};
pub use files::{read_gaussians, read_splats, write_gaussians, write_splats};
pub use frame::{choose_views, to_canonical, to_user};
pub use freerange_diffusion::{
    coupling::Coupling,
    sample::{FlowConfig, GradientAt, RefinerConfig, SETTINGS_SCHEMA},
};
pub use freerange_gaussians::{Gaussians, Harmonics, RenderMode, Splats};
pub use freerange_model::Compute;
pub use freerange_optim::InitialFitConfig;
pub use freerange_scene::camera::{Camera, CanonicalFrame, FrameConfig, Similarity, Up, View};
pub use freerange_scene::{
    KeepWhole, LoadConfig, Loaded, MaskSource, SceneConfig,
    estimate::Hints,
    read::{Cameras, Format as CameraFormat, ReadConfig, Turntable},
};
pub use freerange_util::{Background, Note, NoteKind, Stop};
pub use glam;
pub use image;
pub use pipeline::{Reconstruction, Sample};
pub use progress::{Progress, Stage};
pub use reconstructor::Reconstructor;
pub use scene::{Scene, cut_out, load_views};
pub use score::{Scores, ViewScore, score};
pub use warnings::warnings_of;
