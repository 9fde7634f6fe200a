//! What can go wrong in this crate.

use std::path::PathBuf;

use freerange_util::IoError;

/// Errors of this crate.
#[derive(Debug, thiserror::Error)]
pub enum HubError {
    /// A name that is none of a model on the hub.
    #[error("expected hf:owner/name[@revision], each of letters, digits, '-', '_' and '.', found {found:?}")]
    Name {
        /// What was given.
        found: String,
    },
    /// A model is not in the cache, and this program cannot download.
    #[error("{model}: expected {files} in {}, found none; this program was built without downloads (build it with `cargo build --release --features fetch`)", folder.display())]
    Missing {
        /// The model.
        model: String,
        /// Where it would lie.
        folder: PathBuf,
        /// The files that are not there.
        files: String,
    },
    /// The cache holds something that this program did not write.
    #[error("{}: expected {expected}, found {found}", path.display())]
    Cache {
        /// The file.
        path: PathBuf,
        /// What should be there.
        expected: String,
        /// What is.
        found: String,
    },
    /// The hub could not be asked, or gave no useful answer.
    #[error("{url}: {reason}")]
    Download {
        /// What was asked for.
        url: String,
        /// What went wrong.
        reason: String,
    },
    /// What came is not what it should be.
    #[error("{url}: expected SHA-256 {expected}, found {found}")]
    Checksum {
        /// What was asked for.
        url: String,
        /// The hash that the hub names, or that was pinned before.
        expected: String,
        /// The hash of what came.
        found: String,
    },
    /// The operating system refused to read or write a file.
    #[error(transparent)]
    Io(#[from] IoError),
}
