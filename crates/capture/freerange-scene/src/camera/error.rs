//! The crate's error: what is wrong with which file, frame and field.

use std::path::PathBuf;

use freerange_util::IoError;

/// Where in a scene description something was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    /// The JSON file.
    pub file: PathBuf,
    /// Index into its `frames`, counted from 0; none for what concerns the whole file.
    pub frame: Option<usize>,
}

impl std::fmt::Display for Place {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", self.file.display())?;
        self.frame.map_or(Ok(()), |i| write!(f, ", frame {i}"))
    }
}

/// Why a scene, its frame or a choice of views is refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CameraError {
    /// A file or folder cannot be read.
    #[error("cannot read {0}")]
    Read(#[from] IoError),
    /// A folder holds no scene description.
    #[error("{}: expected transforms.json or transforms_train.json in this folder, found {found}", folder.display())]
    NoScene {
        /// The folder.
        folder: PathBuf,
        /// What is there instead.
        found: String,
    },
    /// A scene description is larger than any real one.
    #[error("{}: expected at most {limit} bytes, found {found}", file.display())]
    FileTooLarge {
        /// The file.
        file: PathBuf,
        /// The largest size accepted.
        limit: u64,
        /// Its size.
        found: u64,
    },
    /// A scene description is not JSON.
    #[error("{}: not valid JSON (numbers must be finite)", file.display())]
    Json {
        /// The file.
        file: PathBuf,
        /// Where and why.
        source: serde_json::Error,
    },
    /// A field is missing, of the wrong kind or out of range.
    #[error("{place}: field `{field}`: expected {expected}, found {found}")]
    Field {
        /// Where.
        place: Place,
        /// The field's name.
        field: String,
        /// What would be accepted.
        expected: String,
        /// What is there.
        found: String,
    },
    /// A feature that is recognized and not supported.
    #[error("{place}: {feature} is not supported; {advice}")]
    Unsupported {
        /// Where.
        place: Place,
        /// Its name.
        feature: String,
        /// What to do instead.
        advice: &'static str,
    },
    /// The transform of a frame is not rotation and translation.
    #[error("{place}: field `transform_matrix`: expected a rotation and a translation, found {found}")]
    NotRigid {
        /// Where.
        place: Place,
        /// What is wrong with it.
        found: String,
    },
    /// No image lies where a frame says.
    #[error("{place}: no image at {} (tried as written, and with .png, .jpg, .jpeg, .webp)", image.display())]
    MissingImage {
        /// Where.
        place: Place,
        /// The path looked for.
        image: PathBuf,
    },
    /// An image cannot be decoded.
    #[error("{place}: cannot decode {}", image.display())]
    Image {
        /// Where.
        place: Place,
        /// The image file.
        image: PathBuf,
        /// The decoder's reason.
        source: Box<image::ImageError>,
    },
    /// An image's size contradicts the intrinsics.
    #[error(
        "{place}: {}: expected {} x {} pixels (`w`, `h`) or the same shape, found {} x {}",
        image.display(), expected.0, expected.1, found.0, found.1
    )]
    ImageSize {
        /// Where.
        place: Place,
        /// The image file.
        image: PathBuf,
        /// Width and height of the intrinsics.
        expected: (u32, u32),
        /// Width and height of the image.
        found: (u32, u32),
    },
    /// The object cannot be told from what is behind it.
    #[error(
        "{place}: {}: expected an alpha channel or one plain color behind the object, found {found}; \
         cut the object out (PNG or WebP with transparency) or photograph it before a plain background",
        image.display()
    )]
    Background {
        /// Where.
        place: Place,
        /// The image file.
        image: PathBuf,
        /// What the image shows.
        found: String,
    },
    /// Two frames have one name.
    #[error("{place}: `{name}` is also the name of frame {other}; give every image another file name")]
    DuplicateName {
        /// Where.
        place: Place,
        /// The name.
        name: String,
        /// The earlier frame.
        other: usize,
    },
    /// Not enough views to see depth.
    #[error("{place}: expected at least 2 input views (4 or more are better), found {found}")]
    TooFewViews {
        /// Where.
        place: Place,
        /// Their number.
        found: usize,
    },
    /// All images are taken from one point.
    #[error("{place}: all {count} cameras stand at one point; expected views from different places")]
    SameCenter {
        /// Where.
        place: Place,
        /// The number of cameras.
        count: usize,
    },
    /// The images together exceed what is loaded at once.
    #[error("{place}: expected at most {limit} pixels in all images together; choose fewer frames or smaller images")]
    TooManyPixels {
        /// Where.
        place: Place,
        /// The limit.
        limit: u64,
    },
    /// The object's place or size does not follow from the views.
    #[error("cannot place the object: {0}")]
    Frame(String),
    /// Views cannot be chosen.
    #[error("cannot choose views: expected {expected}, found {found}")]
    Selection {
        /// What is needed.
        expected: String,
        /// What is there.
        found: String,
    },
}
