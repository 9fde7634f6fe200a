//! The one error type of this crate.

use std::path::PathBuf;

use freerange_util::{Invalid, IoError};

/// What can go wrong with a model that came from outside: its configuration or its files.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// A configuration value that makes no sense.
    #[error("model configuration: {0}")]
    Config(#[from] Invalid),
    /// The operating system refused to read or write.
    #[error(transparent)]
    Io(#[from] IoError),
    /// The file is no valid file of its kind.
    #[error("{path}: not a valid {kind}: {reason}")]
    Format {
        /// The file.
        path: PathBuf,
        /// The kind of file that was expected.
        kind: &'static str,
        /// What is wrong with it.
        reason: String,
    },
    /// The file lacks a tensor.
    #[error("{path}: tensor `{name}` is missing (expected shape {expected:?})")]
    MissingTensor {
        /// The file.
        path: PathBuf,
        /// The tensor.
        name: String,
        /// The shape it should have.
        expected: Vec<usize>,
    },
    /// A tensor has another shape than the configuration says.
    #[error("{path}: tensor `{name}` has shape {found:?}, expected {expected:?}")]
    Shape {
        /// The file.
        path: PathBuf,
        /// The tensor.
        name: String,
        /// The shape it should have.
        expected: Vec<usize>,
        /// The shape it has.
        found: Vec<usize>,
    },
    /// A tensor has an element type that is not read here.
    #[error("{path}: tensor `{name}` has type {found}, expected F32, F16 or BF16")]
    Dtype {
        /// The file.
        path: PathBuf,
        /// The tensor.
        name: String,
        /// Its type.
        found: String,
    },
    /// A tensor holds NaN or infinity.
    #[error("{path}: tensor `{name}` holds a value that is not finite")]
    NotFinite {
        /// The file.
        path: PathBuf,
        /// The tensor.
        name: String,
    },
    /// Values to be set do not fit the model.
    #[error("parameters: {0}")]
    Parameters(String),
}

impl ModelError {
    pub(crate) fn config(field: &str, expected: impl Into<String>, found: impl ToString) -> Self {
        Self::Config(Invalid::new(field, expected, found))
    }

    pub(crate) fn format(path: &std::path::Path, kind: &'static str, reason: impl ToString) -> Self {
        Self::Format { path: path.to_owned(), kind, reason: reason.to_string() }
    }
}
