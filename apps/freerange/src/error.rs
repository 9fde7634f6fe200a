//! One error for the command line: the chain of causes, and the exit code.

use std::{error::Error, fmt, path::Path};

use freerange_flow::FlowError;

/// Why a command ended without its result.
#[derive(Debug)]
pub struct CliError {
    source: Box<dyn Error + Send + Sync>,
    code: u8,
}

impl CliError {
    /// Something that the user gave cannot be used: exit code 2.
    pub fn input(source: impl Into<Box<dyn Error + Send + Sync>>) -> Self {
        Self { source: source.into(), code: 2 }
    }

    /// Something failed through no fault of the user's: exit code 1.
    pub fn failure(source: impl Into<Box<dyn Error + Send + Sync>>) -> Self {
        Self { source: source.into(), code: 1 }
    }

    /// A file could not be read or written: exit code 2.
    pub fn file(path: &Path, source: impl fmt::Display) -> Self {
        Self::input(format!("{}: {source}", path.display()))
    }

    /// What the process ends with.
    pub fn exit_code(&self) -> u8 {
        self.code
    }
}

impl fmt::Display for CliError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.source)?;
        let mut cause = self.source.source();
        while let Some(e) = cause {
            write!(f, "\n  because: {e}")?;
            cause = e.source();
        }
        Ok(())
    }
}

impl From<FlowError> for CliError {
    fn from(e: FlowError) -> Self {
        // A loss that stops being a number is no fault of what the user gave.
        let code = if matches!(e, FlowError::NotFinite { .. } | FlowError::NoGradient) { 1 } else { 2 };
        Self { source: e.into(), code }
    }
}

macro_rules! input_errors {
    ($($error:ty),*) => {$(
        impl From<$error> for CliError {
            fn from(e: $error) -> Self {
                Self::input(e)
            }
        }
    )*};
}
input_errors!(
    freerange_camera::CameraError,
    freerange_data::DataError,
    freerange_eval::EvalError,
    freerange_fit::FitError,
    freerange_mesh::MeshError,
    freerange_metrics::MetricsError,
    freerange_model::ModelError,
    freerange_raster::RasterError,
    freerange_splat::SplatError
);
