//! What can go wrong with shards.

use std::path::PathBuf;

use freerange_util::{Invalid, IoError};

/// What can go wrong with training data.
#[derive(Debug, thiserror::Error)]
pub enum DataError {
    /// An object has no slice of its tree at the asked depth.
    #[error("object {object}: no Gaussians at depth {expected}; it has depths {found:?}")]
    Depth {
        /// The object.
        object: String,
        /// The depth asked for.
        expected: u32,
        /// The depths there are.
        found: Vec<u32>,
    },
    /// A configuration field has an impossible value.
    #[error(transparent)]
    Config(#[from] Invalid),
    /// A file or folder is not what it should be.
    #[error("{}: {problem}", path.display())]
    File {
        /// The file or folder.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
    /// Reading or writing failed.
    #[error(transparent)]
    Io(#[from] IoError),
    /// A place for shards that cannot be used.
    #[error("{location}: {problem}")]
    Store {
        /// The place, as it was given.
        location: String,
        /// What is wrong.
        problem: String,
    },
    /// An object in a shard is not what it should be.
    #[error("{}: object {sample}, entry {entry}: expected {expected}, found {found}", shard.display())]
    Sample {
        /// The shard.
        shard: PathBuf,
        /// Key of the object.
        sample: Box<str>,
        /// The entry, without the key.
        entry: Box<str>,
        /// What would be accepted.
        expected: Box<str>,
        /// What is there.
        found: Box<str>,
    },
    /// A thread that makes objects ended early.
    #[error("the thread that makes object {index} has died")]
    Worker {
        /// Number of the object.
        index: u64,
    },
    /// Too many objects could not be read.
    #[error("{broken} of {read} objects could not be read, the last one because of: {last}")]
    TooManyBroken {
        /// Objects that could not be read.
        broken: u64,
        /// Objects asked for.
        read: u64,
        /// What was wrong with the last one.
        last: Box<DataError>,
    },
    /// A source other than shards has no object for a number.
    #[error(transparent)]
    Source(Box<dyn std::error::Error + Send + Sync>),
    /// The cameras.
    #[error(transparent)]
    Camera(#[from] freerange_scene::camera::CameraError),
    /// The Gaussians or their tree.
    #[error(transparent)]
    Splat(#[from] freerange_gaussians::SplatError),
}

impl DataError {
    /// The error of a source of its own kind.
    pub fn from_source(error: impl std::error::Error + Send + Sync + 'static) -> Self {
        Self::Source(Box::new(error))
    }
}
