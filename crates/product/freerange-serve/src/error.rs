//! Why the server cannot start.

use freerange_util::{Invalid, IoError};

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

    /// For failures that are the server's own.
    pub(crate) fn own(what: impl std::fmt::Display) -> Self {
        tracing::error!("{what}");
        Self::new(500, "the server failed; its log says why")
    }
}

/// A cause and all that lies beneath it.
pub(crate) fn chain(error: &(dyn std::error::Error + 'static)) -> String {
    freerange_util::with_causes(error, "; because: ")
}
