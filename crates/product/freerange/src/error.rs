//! Why there is no result, in kinds that a user of the library can act on.

use std::{
    error::Error as StdError,
    fmt,
    path::{Path, PathBuf},
};

use freerange_diffusion::FlowError;
use freerange_gaussians::SplatError;
use freerange_gaussians::formats::FormatError;
use freerange_model::ModelError;
use freerange_optim::FitError;
use freerange_raster::RasterError;
use freerange_raster::metrics::ImageError;
use freerange_scene::SceneError;
use freerange_scene::camera::CameraError;
use freerange_util::{Invalid, IoError, system_failed};

/// Why there is no result. Its text says which file, which field, what was expected and what was found;
/// [`source`](StdError::source) leads to the causes that the text does not name.
#[derive(Debug)]
#[non_exhaustive]
pub enum Error {
    /// `progress` asked to stop.
    Cancelled,
    /// An option, or a field of a view, cannot be used.
    Input {
        /// The field, with those it lies in: `propose.flow.steps`.
        field: String,
        /// What it may be.
        expected: String,
        /// What it is.
        found: String,
    },
    /// Cameras, photos or masks cannot be used.
    Scene(Cause),
    /// A checkpoint, or the weights of its encoder, cannot be used.
    Checkpoint(Cause),
    /// A set or a file of Gaussians cannot be used.
    Gaussians(Cause),
    /// A file or folder cannot be read or written.
    Io {
        /// Which one.
        path: PathBuf,
        /// What the system says.
        cause: Cause,
    },
    /// A device that is not there, that this program was built without, or that cannot do what is asked of it.
    NoDevice(String),
    /// A device that is there and fails.
    DeviceFailed(String),
    /// The computation failed: a loss or a gradient is not finite.
    Computation(Cause),
}

/// What lies behind an [`Error`], as text; [`Error`]'s source leads on from it.
pub struct Cause(Box<dyn StdError + Send + Sync>);

impl Error {
    /// Whether the program, a device or the system failed; everything else is about what was given. The command line ends
    /// with 1 for these, with 2 for all others.
    pub fn is_failure(&self) -> bool {
        match self {
            Self::Cancelled | Self::DeviceFailed(_) | Self::Computation(_) => true,
            Self::Input { .. } | Self::NoDevice(_) => false,
            Self::Scene(_) | Self::Checkpoint(_) | Self::Gaussians(_) | Self::Io { .. } => system_failed(self),
        }
    }

    pub(crate) fn input(field: impl Into<String>, expected: impl Into<String>, found: impl ToString) -> Self {
        Self::Input { field: field.into(), expected: expected.into(), found: found.to_string() }
    }

    fn io(path: &Path, cause: impl StdError + Send + Sync + 'static) -> Self {
        Self::Io { path: path.into(), cause: Cause::of(cause) }
    }

    /// A picture that could not be written to a file.
    pub(crate) fn picture(path: &Path, source: image::ImageError) -> Self {
        let source = match source {
            image::ImageError::IoError(e) => e,
            other => std::io::Error::other(other),
        };
        IoError::at(path)(source).lift()
    }

    fn cause(&self) -> Option<&Cause> {
        match self {
            Self::Scene(cause)
            | Self::Checkpoint(cause)
            | Self::Gaussians(cause)
            | Self::Io { cause, .. }
            | Self::Computation(cause) => Some(cause),
            Self::Cancelled | Self::Input { .. } | Self::NoDevice(_) | Self::DeviceFailed(_) => None,
        }
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cancelled => f.write_str("cancelled"),
            Self::Input { field, expected, found } => write!(f, "{field}: expected {expected}, found {found}"),
            Self::NoDevice(text) | Self::DeviceFailed(text) => f.write_str(text),
            Self::Scene(cause)
            | Self::Checkpoint(cause)
            | Self::Gaussians(cause)
            | Self::Io { cause, .. }
            | Self::Computation(cause) => cause.fmt(f),
        }
    }
}

impl StdError for Error {
    fn source(&self) -> Option<&(dyn StdError + 'static)> {
        self.cause().and_then(|cause| cause.0.source())
    }
}

impl Cause {
    fn of(error: impl StdError + Send + Sync + 'static) -> Self {
        Self(Box::new(error))
    }
}

impl fmt::Display for Cause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl fmt::Debug for Cause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// An error of a crate beneath this one. `?` alone would need `From`, which would be part of the public API.
pub(crate) trait Beneath {
    /// As the front door says it.
    fn lift(self) -> Error;
}

/// `result.lift()?`
pub(crate) trait Lift<T> {
    /// The same result with the front door's error.
    fn lift(self) -> Result<T, Error>;
}

impl<T, E: Beneath> Lift<T> for Result<T, E> {
    fn lift(self) -> Result<T, Error> {
        self.map_err(Beneath::lift)
    }
}

/// What each of them is here.
macro_rules! lifts {
    ($($from:ident($error:ident) => $to:expr,)*) => {$(
        impl Beneath for $from {
            fn lift(self) -> Error {
                let $error = self;
                $to
            }
        }
    )*};
}

lifts! {
    Invalid(e) => Error::Input { field: e.field, expected: e.expected, found: e.found },
    IoError(e) => Error::io(&e.path.clone(), e),
    SceneError(e) => match e {
        SceneError::Camera(e) => e.lift(),
        SceneError::Option(e) => e.lift(),
        SceneError::Read(ref io) | SceneError::Write(ref io) => Error::io(&io.path.clone(), e),
        e => Error::Scene(Cause::of(e)),
    },
    CameraError(e) => match e {
        CameraError::Read(ref io) => Error::io(&io.path.clone(), e),
        e => Error::Scene(Cause::of(e)),
    },
    FitError(e) => match e {
        FitError::Config(e) => e.lift(),
        FitError::Splat(e) => e.lift(),
        FitError::Raster(e) => e.lift(),
        FitError::Metrics(e) => e.lift(),
        FitError::NoGaussians => Error::Gaussians(Cause::of(e)),
        FitError::Diverged { .. } => Error::Computation(Cause::of(e)),
        e => Error::Scene(Cause::of(e)),
    },
    FlowError(e) => match e {
        FlowError::Cancelled => Error::Cancelled,
        FlowError::Device { .. } => Error::DeviceFailed(e.to_string()),
        FlowError::Config(e) => e.lift(),
        FlowError::Fit(e) => e.lift(),
        FlowError::Model(e) => e.lift(),
        FlowError::Raster(e) => e.lift(),
        FlowError::NoViews | FlowError::UnevenNumbers { .. } | FlowError::UnevenViews { .. } => {
            Error::Scene(Cause::of(e))
        }
        e => Error::Computation(Cause::of(e)),
    },
    ModelError(e) => match e {
        ModelError::Io(e) => e.lift(),
        e => Error::Checkpoint(Cause::of(e)),
    },
    SplatError(e) => match e {
        SplatError::Io(e) => e.lift(),
        e => Error::Gaussians(Cause::of(e)),
    },
    FormatError(e) => match e {
        FormatError::Io(e) => e.lift(),
        FormatError::Gaussians(e) => e.lift(),
        e => Error::Gaussians(Cause::of(e)),
    },
    // Cameras that cannot be rendered.
    RasterError(e) => Error::Scene(Cause::of(e)),
    // Images that cannot be compared.
    ImageError(e) => Error::Scene(Cause::of(e)),
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;

    #[test]
    fn kinds_paths_and_exit_classes() {
        let at = |kind: io::ErrorKind| IoError::at(Path::new("a/b"))(kind.into());
        let missing = SceneError::Read(at(io::ErrorKind::NotFound)).lift();
        assert!(matches!(&missing, Error::Io { path, .. } if path == Path::new("a/b")));
        assert!(missing.to_string().starts_with("cannot read a/b: "), "{missing}");
        assert!(!missing.is_failure() && at(io::ErrorKind::StorageFull).lift().is_failure());
        let field = SceneError::Option(Invalid::new("a", "b", "c")).lift();
        assert!(matches!(&field, Error::Input { field, .. } if field == "a"));
        assert_eq!(field.to_string(), "a: expected b, found c");
        let diverged = FlowError::Fit(FitError::Diverged { step: 3, what: "the loss" }).lift();
        assert!(matches!(diverged, Error::Computation(_)) && diverged.is_failure());
        let lost = FlowError::Device { problem: "lost".into() }.lift();
        assert!(matches!(&lost, Error::DeviceFailed(text) if text.contains("lost")) && lost.is_failure());
        assert!(matches!(FlowError::Cancelled.lift(), Error::Cancelled));
        assert!(matches!(FitError::NoViews.lift(), Error::Scene(_)));
    }

    #[test]
    fn causes_lead_on() {
        let cause = serde_json::from_str::<serde_json::Value>("{").unwrap_err();
        let error = CameraError::Json { file: "a.json".into(), source: cause }.lift();
        assert!(matches!(error, Error::Scene(_)) && !error.is_failure());
        assert!(!error.to_string().contains("EOF") && error.source().unwrap().to_string().contains("EOF"));
    }
}
