//! What can go wrong in training.

use std::path::PathBuf;

use freerange_diffusion::FlowError;
use freerange_util::{Invalid, IoError};

impl TrainError {
    /// Of a failed read-back.
    pub(crate) fn device(problem: impl std::fmt::Debug) -> Self {
        Self::Device { problem: format!("{problem:?}") }
    }
}

impl From<FlowError> for TrainError {
    fn from(e: FlowError) -> Self {
        match e {
            FlowError::Cancelled => Self::Cancelled,
            other => Self::Flow(other),
        }
    }
}

/// What can go wrong in training.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// An object without views was given.
    #[error("an object without views: at least one posed image is needed")]
    NoViews,
    /// An object lacks the quick fits that training starts from.
    #[error("object {object}: expected {expected}, found {found}; `freerange data build|generate --fits N` makes them")]
    Fits {
        /// The object.
        object: String,
        /// What it must have.
        expected: String,
        /// What it has.
        found: String,
    },
    /// What was computed could not be read back from the device: it, or its driver, has failed.
    #[error("the device failed: {problem}")]
    Device {
        /// What it says.
        problem: String,
    },
    /// A configuration field has an impossible value.
    #[error(transparent)]
    Config(#[from] Invalid),
    /// The loss or the gradients have stopped being numbers.
    #[error(
        "step {last}: expected a finite loss and finite gradients, found a loss of {loss} and gradients of norm {norm}, as in \
         the {steps} steps up to it: training stopped; none of them changed the weights"
    )]
    NotFinite {
        /// Steps in a row.
        steps: u32,
        /// The last of them.
        last: u64,
        /// Its loss.
        loss: f32,
        /// The norm of its gradients.
        norm: f32,
    },
    /// Nothing has changed the weights for long.
    #[error(
        "step {last}: expected gradients, found none, as in the {steps} steps up to it: training stopped; Gaussians whose opacity \
         is below 1/255 are not drawn and have no gradient"
    )]
    NoGradient {
        /// Steps in a row.
        steps: u32,
        /// The last of them.
        last: u64,
    },
    /// A training state cannot be continued.
    #[error("{}: {problem}", path.display())]
    State {
        /// The file or folder.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// Reading or writing failed.
    #[error(transparent)]
    Io(#[from] IoError),
    /// Processes that train together could not speak with each other.
    #[error("ranks: {problem}")]
    Ranks {
        /// What is wrong.
        problem: String,
    },
    /// Another process of those that train together has failed, and says why.
    #[error("rank {rank} has failed")]
    Elsewhere {
        /// Its number.
        rank: usize,
    },
    /// Processes that train together are not of one kind, or have come apart.
    #[error("rank {rank}: {what}: expected {expected} as on rank 0, found {found}")]
    Differs {
        /// The one that differs from rank 0.
        rank: usize,
        /// What differs.
        what: String,
        /// What it is on rank 0.
        expected: String,
        /// What it is there.
        found: String,
    },
    /// The caller asked to stop.
    #[error("cancelled")]
    Cancelled,
    /// The rasterizer refused its input.
    #[error(transparent)]
    Raster(#[from] freerange_raster::RasterError),
    /// The model or its checkpoint.
    #[error(transparent)]
    Model(#[from] freerange_model::ModelError),
    /// The training data.
    #[error(transparent)]
    Data(#[from] freerange_data::DataError),
    /// Quick fits that sampling starts from, or how samples are measured.
    #[error(transparent)]
    Fit(#[from] freerange_optim::FitError),
    /// The sampler, or what it shares with training.
    #[error(transparent)]
    Flow(FlowError),
}
