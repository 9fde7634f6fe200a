//! What can go wrong in this crate.

use std::{fmt::Display, io, path::PathBuf};

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

/// What is said of bytes that end too early.
pub const CUT_OFF: &str = "cut off or incomplete";

/// The end of a zip archive begins with it.
const END_OF_ARCHIVE: &[u8] = b"PK\x05\x06";

/// What is wrong with the bytes of a file.
pub fn problem(field: impl Into<String>, expected: impl Into<String>, found: impl Display) -> Invalid {
    // Enough to recognize it by; what is found may be long.
    Invalid::new(field, expected, found.to_string().chars().take(120).collect::<String>())
}

/// What is found where `count` bytes are left, and more are needed.
pub fn ended(count: usize) -> String {
    format!("{count} and the end: {CUT_OFF}")
}

/// What is found in place of something whole; `e` says why.
fn cut_off(e: impl Display) -> String {
    format!("one that is {CUT_OFF} ({e})")
}

/// What is wrong with a compressed stream.
pub fn stream_problem(field: &str, e: &io::Error) -> Invalid {
    let found = if e.kind() == io::ErrorKind::UnexpectedEof { cut_off(e) } else { e.to_string() };
    problem(field, "a compressed stream", found)
}

/// What is wrong with JSON.
pub fn json_problem(field: &str, expected: &str, e: &serde_json::Error) -> Invalid {
    problem(field, expected, if e.is_eof() { cut_off(e) } else { e.to_string() })
}

/// What is wrong with a zip archive. The list of its files is at its end.
pub fn archive_problem(bytes: &[u8], expected: &str, e: impl Display) -> Invalid {
    let is_part = bytes.starts_with(b"PK") && !bytes.windows(END_OF_ARCHIVE.len()).any(|w| w == END_OF_ARCHIVE);
    problem("archive", expected, if is_part { cut_off(e) } else { e.to_string() })
}
