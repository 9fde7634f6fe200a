//! What can go wrong in this crate.

use std::{fmt::Display, path::PathBuf};

use crate::SplatError;
use freerange_util::{Invalid, IoError};

/// Errors of this crate.
#[derive(Debug, thiserror::Error)]
pub enum FormatError {
    /// The operating system refused to read or write a file.
    #[error(transparent)]
    Io(#[from] IoError),
    /// A name whose extension is of no known format.
    #[error("{}: extension: expected one of {expected}, found {found}", file.display())]
    Unknown {
        /// The file.
        file: PathBuf,
        /// The extensions that are known.
        expected: Box<str>,
        /// That of the file.
        found: Box<str>,
    },
    /// A file does not hold what its extension says, or not as its format wants it.
    #[error("{}: {problem}", file.display())]
    Invalid {
        /// The file.
        file: PathBuf,
        /// Where in it, what should be there, and what is.
        problem: Invalid,
    },
    /// A `.ply` file cannot be read, or Gaussians cannot be written.
    #[error(transparent)]
    Gaussians(#[from] SplatError),
}

/// What is wrong with the bytes of a file.
pub fn problem(field: impl Into<String>, expected: impl Into<String>, found: impl Display) -> Invalid {
    // Enough to recognize it by; what is found may be long.
    Invalid::new(field, expected, found.to_string().chars().take(120).collect::<String>())
}
