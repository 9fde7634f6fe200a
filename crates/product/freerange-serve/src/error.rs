//! Why the server cannot start.

use std::path::Path;

use freerange_util::{Invalid, IoError};

use crate::disk::is_full;

/// Why a server cannot be.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServeError {
    /// An option cannot be used.
    #[error(transparent)]
    Option(#[from] Invalid),
    /// The address cannot be listened at.
    #[error("cannot listen at {address}: {source}")]
    Listen {
        /// The address.
        address: String,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The folder of jobs cannot be used.
    #[error(transparent)]
    Folder(#[from] IoError),
}

/// Why a request is not done: a status of HTTP, and a sentence for who asked.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// The status.
    pub status: u16,
    /// The sentence; plain text, which may hold what a client sent.
    pub text: String,
}

impl Refusal {
    pub(crate) fn new(status: u16, text: impl Into<String>) -> Self {
        Self { status, text: text.into() }
    }

    /// For failures that are the server's own. A full disk is named: whoever asked may know whom to tell, or remove jobs.
    pub(crate) fn own(what: impl std::fmt::Display) -> Self {
        let text = what.to_string();
        tracing::error!("{text}");
        match is_full(&text) {
            true => Self::new(507, "the server's disk is full"),
            false => Self::new(500, "the server failed; its log says why"),
        }
    }

    /// The same for a file of a job: with its name, and without the folders that it lies in.
    pub(crate) fn file<E: std::fmt::Display>(path: &Path) -> impl FnOnce(E) -> Self {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        move |e| Self::own(format!("{name}: {e}"))
    }
}

/// A cause and all that lies beneath it.
pub(crate) fn chain(error: &(dyn std::error::Error + 'static)) -> String {
    freerange_util::with_causes(error, "; because: ")
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn a_full_disk_is_named() {
        let full = || std::io::Error::from_raw_os_error(28); // ENOSPC
        let nested = IoError::at(std::path::Path::new("job.json"))(full());
        for refusal in [Refusal::own(full()), Refusal::own(nested)] {
            assert_eq!(refusal, Refusal::new(507, "the server's disk is full"));
        }
        assert_eq!(Refusal::own(std::io::Error::from_raw_os_error(2)).status, 500);
        let named = Refusal::file::<std::io::Error>(Path::new("/srv/keep/ID/job.json"))(full());
        assert_eq!(named, Refusal::new(507, "the server's disk is full"));
    }
}
