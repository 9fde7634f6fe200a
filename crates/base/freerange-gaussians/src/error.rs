//! What can go wrong in this crate.

use std::path::PathBuf;

use freerange_util::IoError;

/// Errors of this crate. Rows and lines are counted from zero and one, respectively.
#[derive(Debug, thiserror::Error)]
pub enum SplatError {
    /// The operating system refused to read or write a file.
    #[error(transparent)]
    Io(#[from] IoError),
    /// The header of a `.ply` cannot be understood.
    #[error("{}: header line {line}: expected {expected}, found {found}", file.display())]
    PlyHeader {
        /// The file.
        file: PathBuf,
        /// Line of the header, from 1.
        line: usize,
        /// What should stand there.
        expected: Box<str>,
        /// What does.
        found: Box<str>,
    },
    /// The header of a `.ply` is in order, but does not describe Gaussians.
    #[error("{}: property {property:?} of element \"vertex\": expected {expected}, found {found}", file.display())]
    PlyProperty {
        /// The file.
        file: PathBuf,
        /// The property.
        property: Box<str>,
        /// What is needed.
        expected: Box<str>,
        /// What the header declares.
        found: Box<str>,
    },
    /// A value of a `.ply` is missing, unreadable or not finite.
    #[error("{}: element {element:?}, row {row}, property {property:?}: expected {expected}, found {found}", file.display())]
    PlyValue {
        /// The file.
        file: PathBuf,
        /// The element.
        element: Box<str>,
        /// Row of the element, from 0.
        row: u64,
        /// The property.
        property: Box<str>,
        /// What should stand there.
        expected: Box<str>,
        /// What does.
        found: Box<str>,
    },
    /// A Gaussian has a value that its channel cannot have.
    #[error("Gaussian {row}, channel {channel} ({name}): expected {expected}, found {found}")]
    Value {
        /// The Gaussian.
        row: usize,
        /// The channel, 0..14.
        channel: usize,
        /// The channel's name.
        name: &'static str,
        /// The values allowed.
        expected: &'static str,
        /// The value found.
        found: f32,
    },
    /// Nothing can be made of a cloud without Gaussians.
    #[error("expected at least one Gaussian, found none")]
    Empty,
    /// A slice deeper than the tree was asked for.
    #[error("depth {depth} needs {} Gaussians, but the tree has {leaves} (deepest complete slice: {})", pow2(*depth), leaves.ilog2())]
    Depth {
        /// The depth asked for.
        depth: u32,
        /// Leaves of the tree, at least 1.
        leaves: usize,
    },
    /// More Gaussians than a tree can number.
    #[error("expected at most {limit} Gaussians, found {found}")]
    TooMany {
        /// The limit.
        limit: usize,
        /// What was asked for.
        found: usize,
    },
    /// Normalization statistics that cannot be used.
    #[error("normalization, channel {channel} ({name}), {field}: expected {expected}, found {found}")]
    Normalization {
        /// `mean` or `std`.
        field: &'static str,
        /// The channel, 0..14.
        channel: usize,
        /// The channel's name.
        name: &'static str,
        /// The values allowed.
        expected: &'static str,
        /// The value found.
        found: f32,
    },
}

/// 2^depth as text, for depths whose power no integer holds.
fn pow2(depth: u32) -> String {
    1u64.checked_shl(depth).map_or_else(|| format!("2^{depth}"), |n| n.to_string())
}
