//! One error for the command line: the chain of causes, and the exit code.

use std::{error::Error, fmt, path::Path};

use freerange_data::DataError;
use freerange_data::build::BuildError;
use freerange_diffusion::FlowError;
use freerange_optim::FitError;
use freerange_train::TrainError;
use freerange_util::{system_failed, with_causes};

/// What shells expect of a program that a signal has ended, if it is Ctrl-C.
pub const EXIT_CODE: u8 = 130;

/// Why a command ended without its result.
#[derive(Debug)]
pub struct CliError {
    source: Box<dyn Error + Send + Sync>,
    code: u8,
    agreed: bool, // all ranks end with it
}

impl CliError {
    /// Something that the user gave cannot be used: exit code 2.
    pub fn input(source: impl Into<Box<dyn Error + Send + Sync>>) -> Self {
        Self { source: source.into(), code: 2, agreed: false }
    }

    /// Something failed through no fault of the user's: exit code 1.
    pub fn failure(source: impl Into<Box<dyn Error + Send + Sync>>) -> Self {
        Self { source: source.into(), code: 1, agreed: false }
    }

    /// A file could not be read or written: exit code 2, or 1 where the system failed.
    pub fn file(path: &Path, source: impl Into<Box<dyn Error + Send + Sync>>) -> Self {
        let source = source.into();
        let text = format!("{}: {source}", path.display());
        Self { code: code_of(&*source), source: text.into(), agreed: false }
    }

    /// An error that all ranks end with; one of them says it, the others' text is empty.
    pub fn agreed(text: String, code: u8) -> Self {
        Self { source: text.into(), code, agreed: true }
    }

    /// What was asked to end did so in order; the text says what there is now.
    pub fn asked_to_end(text: &str) -> Self {
        Self { source: format!("asked to end: {text}").into(), code: EXIT_CODE, agreed: false }
    }

    /// Whether all ranks end with it.
    pub fn is_agreed(&self) -> bool {
        self.agreed
    }

    /// The error itself.
    pub fn cause(&self) -> &(dyn Error + Send + Sync + 'static) {
        &*self.source
    }

    /// What the process ends with.
    pub fn exit_code(&self) -> u8 {
        self.code
    }
}

impl fmt::Display for CliError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&with_causes(self.cause(), "\n  because: "))
    }
}

/// The exit code of an error that is not known more closely: 1 where the system failed, 2 where what was given cannot be
/// used.
fn code_of(error: &(dyn Error + 'static)) -> u8 {
    if system_failed(error) { 1 } else { 2 }
}

impl From<TrainError> for CliError {
    fn from(e: TrainError) -> Self {
        match e {
            TrainError::Data(e) => e.into(),
            TrainError::Fit(e) => e.into(),
            TrainError::Flow(e) => e.into(),
            TrainError::NotFinite { .. }
            | TrainError::Device { .. }
            | TrainError::Cancelled
            | TrainError::Ranks { .. }
            | TrainError::Elsewhere { .. } => Self::failure(e),
            _ => Self { code: code_of(&e), source: e.into(), agreed: false },
        }
    }
}

impl From<FlowError> for CliError {
    fn from(e: FlowError) -> Self {
        match e {
            FlowError::Fit(e) => e.into(),
            FlowError::NoGradient | FlowError::Device { .. } | FlowError::Cancelled => Self::failure(e),
            _ => Self { code: code_of(&e), source: e.into(), agreed: false },
        }
    }
}

impl From<freerange::Error> for CliError {
    fn from(e: freerange::Error) -> Self {
        if e.is_failure() { Self::failure(e) } else { Self::input(e) }
    }
}

impl From<DataError> for CliError {
    fn from(e: DataError) -> Self {
        match e {
            DataError::Worker { .. } => Self::failure(e),
            DataError::Source(e) => match e.downcast::<BuildError>() {
                Ok(e) => (*e).into(),
                Err(e) => Self { code: code_of(&*e), source: e, agreed: false },
            },
            _ => Self { code: code_of(&e), source: e.into(), agreed: false },
        }
    }
}

impl From<BuildError> for CliError {
    fn from(e: BuildError) -> Self {
        match e {
            BuildError::Data(e) => e.into(),
            BuildError::Fit(e) => e.into(),
            _ => Self { code: code_of(&e), source: e.into(), agreed: false },
        }
    }
}

impl From<FitError> for CliError {
    fn from(e: FitError) -> Self {
        match e {
            // A loss that stops being a number is no fault of what the user gave.
            FitError::Diverged { .. } => Self::failure(e),
            _ => Self { code: code_of(&e), source: e.into(), agreed: false },
        }
    }
}

macro_rules! other_errors {
    ($($error:ty),*) => {$(
        impl From<$error> for CliError {
            fn from(e: $error) -> Self {
                Self { code: code_of(&e), source: e.into(), agreed: false }
            }
        }
    )*};
}
other_errors!(
    freerange_scene::camera::CameraError,
    freerange_eval::EvalError,
    freerange_gaussians::formats::FormatError,
    freerange_model::hub::HubError,
    freerange_assets::mesh::MeshError,
    freerange_eval::metrics::MetricsError,
    freerange_model::ModelError,
    freerange_raster::RasterError,
    freerange_scene::SceneError,
    freerange_gaussians::SplatError,
    freerange_optim::meshing::SurfaceError
);

#[cfg(test)]
mod tests {
    use std::io;

    use freerange_util::IoError;

    use super::*;

    fn data(kind: io::ErrorKind) -> DataError {
        DataError::Io(IoError { path: "shards/a.tar".into(), source: kind.into() })
    }

    #[test]
    fn bad_input_and_failures_have_different_codes() {
        let diverged = || FitError::Diverged { step: 3, what: "the loss" };
        let input: [CliError; 4] = [
            data(io::ErrorKind::NotFound).into(),
            TrainError::Data(data(io::ErrorKind::PermissionDenied)).into(),
            FitError::NoViews.into(),
            CliError::file(Path::new("a"), "expected a folder"),
        ];
        assert_eq!(input.map(|e| e.exit_code()), [2; 4]);
        let failures: [CliError; 9] = [
            TrainError::Device { problem: "lost".into() }.into(),
            data(io::ErrorKind::StorageFull).into(),
            TrainError::Data(data(io::ErrorKind::ConnectionReset)).into(),
            CliError::file(Path::new("a"), io::Error::from(io::ErrorKind::StorageFull)),
            CliError::file(Path::new("a"), image::ImageError::IoError(io::ErrorKind::StorageFull.into())),
            diverged().into(),
            TrainError::Data(DataError::from_source(BuildError::Fit(diverged()))).into(),
            DataError::Worker { index: 1 }.into(),
            FlowError::NoGradient.into(),
        ];
        assert_eq!(failures.map(|e| e.exit_code()), [1; 9]);
    }

    #[test]
    fn a_cause_is_told_once() {
        let found = CliError::from(data(io::ErrorKind::NotFound)).to_string();
        assert_eq!(found, format!("shards/a.tar: {}", io::Error::from(io::ErrorKind::NotFound)));
        // An error that does not say why.
        let source = serde_json::from_str::<()>("{").unwrap_err();
        let error = freerange_scene::camera::CameraError::Json { file: "a.json".into(), source };
        assert_eq!(CliError::from(error).to_string().matches("because: ").count(), 1);
    }
}
