//! The crate's error: what is wrong with which file, where in it, and what was expected.

use std::path::{Path, PathBuf};

use freerange_util::{Invalid, IoError, Stopped};

/// Why photos cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SceneError {
    /// A `transforms.json`, or what follows from all views together.
    #[error(transparent)]
    Camera(#[from] crate::camera::CameraError),
    /// A file or folder cannot be read.
    #[error("cannot read {0}")]
    Read(#[source] IoError),
    /// A file or folder cannot be written.
    #[error("cannot write {0}")]
    Write(#[source] IoError),
    /// A file is larger than any real one.
    #[error("{}: expected at most {limit} bytes, found {found}", file.display())]
    TooLarge {
        /// The file.
        file: PathBuf,
        /// The largest size accepted.
        limit: u64,
        /// Its size.
        found: u64,
    },
    /// A folder holds nothing that is known.
    #[error(
        "{}: expected cameras (transforms.json, a COLMAP model, Polycam's keyframes, a Metashape .xml, a RealityCapture .csv or a Pix4D .opf), \
         found {found}; photos without cameras: `freerange poses PHOTOS -o SCENE` finds them with COLMAP; on a turntable in even steps: \
         --turntable ELEVATION,FOV",
        folder.display()
    )]
    Nothing {
        /// The folder.
        folder: PathBuf,
        /// What is there instead.
        found: String,
    },
    /// A folder could be two things.
    #[error("{}: could be {first} or {second}; {advice}", folder.display())]
    Ambiguous {
        /// The folder.
        folder: PathBuf,
        /// One of them.
        first: String,
        /// The other.
        second: String,
        /// The option that decides.
        advice: String,
    },
    /// A value is missing, of the wrong kind or out of range.
    #[error("{}{}: `{field}`: expected {expected}, found {found}", file.display(), at(place))]
    Field {
        /// The file.
        file: PathBuf,
        /// Where in it, such as `line 3` or `camera 2`; empty for the whole file.
        place: String,
        /// Its name.
        field: String,
        /// What would be accepted.
        expected: String,
        /// What is there.
        found: String,
    },
    /// A file that does not have its format's form.
    #[error("{}{}: {what}", file.display(), at(place))]
    Malformed {
        /// The file.
        file: PathBuf,
        /// Where in it.
        place: String,
        /// What is wrong.
        what: String,
    },
    /// Something that is recognized and cannot be used.
    #[error("{}{}: {feature} is not supported; {advice}", file.display(), at(place))]
    Unsupported {
        /// The file.
        file: PathBuf,
        /// Where in it.
        place: String,
        /// Its name.
        feature: String,
        /// What to do instead.
        advice: &'static str,
    },
    /// An image is not there.
    #[error("{place}: none of its images is there, {} the first (looked in {}; --images FOLDER says where else)", image.display(), folders.join(", "))]
    MissingImage {
        /// The file and place that name it.
        place: String,
        /// Its name.
        image: PathBuf,
        /// Where it was looked for.
        folders: Vec<String>,
    },
    /// One image file is two photos.
    #[error(
        "{}: expected one photo for this file, found two with different poses: {first} and {second}; give photos names of their own, or folders \
         as in the cameras' file",
        file.display()
    )]
    SameFile {
        /// The image.
        file: PathBuf,
        /// Name of one photo.
        first: String,
        /// Name of the other.
        second: String,
    },
    /// An image or mask cannot be decoded.
    #[error("{}: cannot decode", file.display())]
    Image {
        /// The file.
        file: PathBuf,
        /// The decoder's reason.
        source: Box<image::ImageError>,
    },
    /// A size contradicts another.
    #[error("{}: expected {} x {} pixels ({of}) or the same shape, found {} x {}", file.display(), expected.0, expected.1, found.0, found.1)]
    Size {
        /// The image or mask.
        file: PathBuf,
        /// Whose size is expected.
        of: &'static str,
        /// Width and height expected.
        expected: (u32, u32),
        /// Width and height found.
        found: (u32, u32),
    },
    /// A mask is missing or shows nothing.
    #[error("{name}: expected {expected}, found {found}")]
    Mask {
        /// The photo.
        name: String,
        /// What would be accepted.
        expected: String,
        /// What is there.
        found: String,
    },
    /// Not enough photos.
    #[error("{}: expected at least {expected} photos with poses, found {found}", file.display())]
    TooFew {
        /// The file or folder.
        file: PathBuf,
        /// The least number.
        expected: usize,
        /// Their number.
        found: usize,
    },
    /// The object cannot be told from what is around it, or the views contradict each other.
    #[error(
        "the object could not be cut out of the photos: {reason}; give masks (--masks FOLDER, white is the object)"
    )]
    NotCutOut {
        /// Why.
        reason: String,
    },
    /// Photos take more memory than they may.
    #[error(
        "{photos} photos: expected at most {limit} MB of memory for photos and masks at the size used, found {needed} MB; fewer photos, a \
         smaller --max-resolution, or masks with them (estimating masks takes several times as much)"
    )]
    Memory {
        /// Their number.
        photos: usize,
        /// The limit, in megabytes.
        limit: u64,
        /// What they would take, in megabytes.
        needed: u64,
    },
    /// Reading was stopped ([`LoadConfig::stop`](crate::LoadConfig::stop)).
    #[error(transparent)]
    Stopped(#[from] Stopped),
    /// An option cannot be used.
    #[error(transparent)]
    Option(#[from] Invalid),
}

fn at(place: &str) -> String {
    if place.is_empty() { String::new() } else { format!(", {place}") }
}

/// Shorthands for the readers: errors about one file.
#[derive(Clone, Copy)]
pub(crate) struct In<'a>(pub &'a Path);

impl In<'_> {
    pub fn field(self, place: &str, field: &str, expected: &str, found: impl ToString) -> SceneError {
        let found: String = found.to_string().chars().take(80).collect();
        SceneError::Field {
            file: self.0.into(),
            place: place.into(),
            field: field.into(),
            expected: expected.into(),
            found,
        }
    }

    pub fn malformed(self, place: &str, what: impl ToString) -> SceneError {
        SceneError::Malformed { file: self.0.into(), place: place.into(), what: what.to_string() }
    }

    pub fn unsupported(self, place: &str, feature: impl ToString, advice: &'static str) -> SceneError {
        SceneError::Unsupported { file: self.0.into(), place: place.into(), feature: feature.to_string(), advice }
    }

    /// An image of a kind that is not decoded.
    pub fn unreadable(self, kind: &str) -> SceneError {
        self.unsupported("", format!("a {kind} image"), crate::camera::scene::CONVERT)
    }

    pub fn read(self, source: std::io::Error) -> SceneError {
        SceneError::Read(IoError::at(self.0)(source))
    }
}
