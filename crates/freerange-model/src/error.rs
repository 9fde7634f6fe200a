//! The one error type of this crate.

use std::path::PathBuf;

/// What can go wrong with a model that came from outside: its configuration or its files.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// A configuration value that makes no sense.
    #[error("model configuration: `{field}` is {found}, expected {expected}")]
    Config {
        /// The field, with its path.
        field: &'static str,
        /// What it has to be.
        expected: String,
        /// What it is.
        found: String,
    },
    /// The operating system refused to read or write.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
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
    pub(crate) fn config(field: &'static str, expected: impl Into<String>, found: impl ToString) -> Self {
        Self::Config { field, expected: expected.into(), found: found.to_string() }
    }

    pub(crate) fn format(path: &std::path::Path, kind: &'static str, reason: impl ToString) -> Self {
        Self::Format { path: path.to_owned(), kind, reason: reason.to_string() }
    }

    pub(crate) fn io(path: &std::path::Path, source: std::io::Error) -> Self {
        Self::Io { path: path.to_owned(), source }
    }
}
