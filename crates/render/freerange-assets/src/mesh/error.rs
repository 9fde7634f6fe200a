//! Why a mesh cannot be read.

use freerange_util::{Invalid, IoError};

/// What can be wrong with a configuration or a mesh.
#[derive(Debug, thiserror::Error)]
pub enum MeshError {
    /// A configuration value out of its range.
    #[error(transparent)]
    Config(#[from] Invalid),
    /// A mesh whose arrays do not fit together.
    #[error("mesh {field}: expected {expected}, found {found}")]
    Mesh {
        /// Name of the array.
        field: &'static str,
        /// What is required.
        expected: String,
        /// What was found.
        found: String,
    },
    /// A file that cannot be opened or read.
    #[error(transparent)]
    Io(#[from] IoError),
    /// A file whose content breaks its format or a limit of [`LoadLimits`](crate::mesh::LoadLimits).
    #[error("{path}: {field}: expected {expected}, found {found}")]
    File {
        /// The file.
        path: std::path::PathBuf,
        /// The place in the file.
        field: String,
        /// What is required.
        expected: String,
        /// What was found.
        found: String,
    },
    /// A file that is well formed but needs something that is not implemented here.
    #[error("{path}: {what} is not supported")]
    Unsupported {
        /// The file.
        path: std::path::PathBuf,
        /// What it needs, and what helps.
        what: String,
    },
}
