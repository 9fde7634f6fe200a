//! A page on loopback that takes photos with cameras and shows how 3D Gaussians come of them.
//!
//! A [`Server`] has a queue of jobs, a folder for each, and an [`Engine`] that computes one after the other; it knows nothing of
//! networks. `docs/reference/http.md` lists what it answers.
//!
//! What clients send is bounded in bytes, pixels, files, jobs and time ([`Limits`]) before anything is decoded. Names of clients never
//! become paths of ours: they name files below a job's own folder, after they were taken apart. `Host` and `Origin` are checked, so that
//! pages of other sites cannot use a browser to get here. Where there is a token ([`draw_token`]), nobody is served without it.
//!
//! Architecture invariant: no tensors and no neural network: the engine behind the page is a trait ([`Engine`]).

#![deny(missing_docs)]

mod board;
mod config;
mod disk;
mod engine;
mod error;
mod guard;
mod http;
mod metrics;
mod multipart;
mod page;
mod plain;
mod record;
mod routes;
mod scene;
mod server;
mod splats;
mod upload;

pub use config::{Example, Limits, ServeConfig};
pub use engine::{
    Engine, EngineError, FoundCameras, Init, JobOptions, Outcome, Quality, Scene, Search, SearchStep, Step, Symmetry,
};
pub use error::{Refusal, ServeError};
pub use guard::draw_token;
pub use server::{Server, Stopper};
