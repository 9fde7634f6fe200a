//! Why a metric cannot be computed.

#[cfg(feature = "networks")]
use std::path::Path;
use std::path::PathBuf;

use freerange_raster::metrics::ImageError;

/// Why two images cannot be compared, or why a network cannot be used for it.
///
/// Reasons that come from other libraries are kept as text, so that errors can be compared and stored in reports.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum MetricsError {
    /// Two images cannot be compared.
    #[error(transparent)]
    Images(#[from] ImageError),
    /// A metric's name is unknown.
    #[error("unknown metric `{found}`, expected one of: {expected}")]
    UnknownMetric {
        /// What was asked for.
        found: String,
        /// All names, separated by commas.
        expected: String,
    },
    /// A set of weights is unknown.
    #[error("unknown weights `{found}`, expected one of: {expected}")]
    UnknownWeights {
        /// What was asked for.
        found: String,
        /// All names, separated by commas.
        expected: String,
    },
    /// The statistics of two sets of features do not go together, or are of too few features.
    #[error("Frechet distance: {what} is {found}, expected {expected}")]
    Statistics {
        /// Which quantity.
        what: &'static str,
        /// What it has to be.
        expected: String,
        /// What it is.
        found: String,
    },
    /// Weights are not there.
    #[error("weights `{name}` not found ({file} in none of {searched}): run `freerange weights fetch {name}`")]
    NotFound {
        /// Name of the set of weights.
        name: String,
        /// The first file that is missing.
        file: String,
        /// The folders that were searched.
        searched: String,
    },
    /// A file could not be read or written.
    #[error("{}: {reason}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the operating system says.
        reason: String,
    },
    /// A file is not of its kind.
    #[error("{}: not a valid {kind}: {reason}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// The kind of file that was expected.
        kind: &'static str,
        /// What is wrong with it.
        reason: String,
    },
    /// A file of weights does not hold what the network needs.
    #[error("{}: tensor `{tensor}` is {found}, expected {expected}", path.display())]
    Tensor {
        /// The file.
        path: PathBuf,
        /// The tensor's name.
        tensor: String,
        /// The shape or property it should have.
        expected: String,
        /// What it is.
        found: String,
    },
    /// A file's SHA-256 is not the published one.
    #[error("{}: SHA-256 is {found}, expected {expected}: the download is damaged or another file", path.display())]
    Checksum {
        /// The file.
        path: PathBuf,
        /// The hexadecimal digits it should have (or begin with).
        expected: String,
        /// The hexadecimal digits it has.
        found: String,
    },
    /// A download failed.
    #[error("{url}: {reason}")]
    Download {
        /// Where from.
        url: String,
        /// Why.
        reason: String,
    },
}

#[cfg(feature = "networks")]
impl MetricsError {
    pub(crate) fn io(path: &Path, reason: impl ToString) -> Self {
        Self::Io { path: path.to_owned(), reason: reason.to_string() }
    }

    pub(crate) fn format(path: &Path, kind: &'static str, reason: impl ToString) -> Self {
        Self::Format { path: path.to_owned(), kind, reason: reason.to_string() }
    }
}
