//! What can go wrong in this crate.

use std::{fmt::Display, io, path::Path, path::PathBuf};

use freerange_splat::SplatError;

/// Errors of this crate.
#[derive(Debug, thiserror::Error)]
pub enum FormatError {
    /// The operating system refused to read or write a file.
    #[error("{}: {source}", file.display())]
    Io {
        /// The file.
        file: PathBuf,
        /// Why.
        source: io::Error,
    },
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
    #[error("{}: {field}: expected {expected}, found {found}", file.display())]
    Invalid {
        /// The file.
        file: PathBuf,
        /// Where in it.
        field: Box<str>,
        /// What should be there.
        expected: Box<str>,
        /// What is.
        found: Box<str>,
    },
    /// A `.ply` file cannot be read, or Gaussians cannot be written.
    #[error(transparent)]
    Gaussians(#[from] SplatError),
}

/// What is wrong with the bytes of a file.
#[derive(Debug)]
pub struct Problem {
    field: Box<str>,
    expected: Box<str>,
    found: Box<str>,
}

impl Problem {
    pub fn new(field: impl Into<Box<str>>, expected: impl Into<Box<str>>, found: impl Display) -> Self {
        // Enough to recognise it by; what is found may be long.
        let found: String = found.to_string().chars().take(120).collect();
        Self { field: field.into(), expected: expected.into(), found: found.into() }
    }

    pub fn within(self, file: &Path) -> FormatError {
        FormatError::Invalid { file: file.into(), field: self.field, expected: self.expected, found: self.found }
    }
}
