//! The evaluation: which views a method is shown and which score it, the scores, what they add up to, and reports.
//!
//! Start with [`EvalObject`] (the protocol), [`Scorer`] (the metrics) and [`Report`]. [`RunFolder`] keeps results so that
//! a run can be stopped and gone on with, and [`runner`] works through one. What is evaluated, and how it makes its Gaussians,
//! is for the caller to know.
//!
//! Architecture invariant: how Gaussians are made is not known here.

pub mod ablation;
mod agreement;
mod chamfer;
pub mod compare;
pub mod document;
mod error;
mod folder;
mod geometry;
pub mod html;
pub mod memory;
pub mod metrics;
mod object;
pub mod paper;
pub mod paper_tables;
pub mod record;
mod report;
pub mod runner;
mod scorer;
pub mod statistics;
mod strip;
pub mod table;

pub use agreement::agreement;
pub use chamfer::mesh_metrics;
pub use error::EvalError;
pub use folder::{Features, RunFolder, differences};
pub use geometry::{MeshSurface, Nearest, surface_metrics};
pub use object::{EvalObject, Inputs};
pub use report::{Environment, FORMAT, FrechetVgg, Group, Report, Spread};
pub use scorer::{Pair, Scorer, ScorerConfig, Scores, UsedFile, fid, frechet_vgg};
pub use strip::strip;
