//! Posed images of an object in, 3D Gaussians out, in the frame of the cameras.
//!
//! ```no_run
//! use std::{ops::ControlFlow, path::Path};
//! use freerange::{DeviceName, Reconstructor, Scene, write_ply};
//!
//! # fn main() -> Result<(), freerange::Error> {
//! let model = Reconstructor::shipped(&DeviceName::Auto.open()?)?;
//! let scene = Scene::load(Path::new("examples/bowl"))?;
//! let mut options = model.options()?;
//! options.sample.refine = 500;
//! let result = model.run(&scene.inputs, &options, &mut |progress| {
//!     println!("{}: {} of {}", progress.stage, progress.done, progress.total);
//!     ControlFlow::Continue(())
//! })?;
//! write_ply(&result.samples[0].gaussians, Path::new("gaussians.ply"))?;
//! # Ok(())
//! # }
//! ```
//!
//! A [`Reconstructor`] holds a model on a device and takes one object after the other; it can be shared between threads.
//! While it works, it tells of every step: [`Progress::estimate`] gives what the Gaussians look like by then, and
//! `ControlFlow::Break` ends it at the next step with [`Error::Cancelled`]. The same views, options and device give the same
//! bytes.
//!
//! Views come from a [`Scene`] on disk, or are made: a [`View`] is a name, a [`Camera`] and an RGBA image whose alpha is the
//! object's mask.
#![deny(missing_docs)]

mod checkpoint;
mod device;
mod error;
pub mod machine;
mod options;
mod others;
pub mod pictures;
mod placed;
mod progress;
mod reconstructor;
mod score;

pub use burn::tensor::Device;
pub use checkpoint::{
    EncoderPlaces, checkpoint_bytes, checkpoint_header, checkpoint_sha256, load_checkpoint, network_views, sampling,
};
pub use device::{Api, DeviceName, Listed, Properties, devices, require};
pub use error::Error;
pub use freerange_camera::{Camera, FrameConfig, Scene, Similarity, Up, View};
pub use freerange_flow::sample::{SETTINGS_SCHEMA, SampleConfig, Solver, StartConfig};
pub use freerange_model::{Checkpoint, Compute};
pub use freerange_splat::{Cloud, write_ply};
pub use options::Options;
pub use others::others_show;
pub use progress::{Progress, Stage};
pub use reconstructor::{Reconstruction, Reconstructor, Sample, choose_views, to_canonical, to_user};
pub use score::{Scores, ViewScore, score};
