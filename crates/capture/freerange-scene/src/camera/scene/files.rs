//! Finding, decoding and preparing the images of a scene.

use super::{
    cut_out,
    json::{Description, FrameDescription, LARGEST_SIDE},
};
use crate::camera::{CameraError, Lens, View};
use freerange_util::IoError;
use image::{DynamicImage, ImageDecoder, ImageReader, RgbaImage};
use std::{
    collections::HashMap,
    path::{Path, PathBuf},
};

/// Image files that are read, by their extensions in small letters.
pub const IMAGE_EXTENSIONS: [&str; 4] = ["png", "jpg", "jpeg", "webp"];
/// Images that cameras write and that are not read, and what they are called.
const UNREADABLE: [(&str, &str); 11] = [
    ("heic", "HEIC"),
    ("heif", "HEIC"),
    ("avif", "AVIF"),
    ("tif", "TIFF"),
    ("tiff", "TIFF"),
    ("exr", "OpenEXR"),
    ("jxl", "JPEG XL"),
    ("dng", "raw"),
    ("cr2", "raw"),
    ("nef", "raw"),
    ("arw", "raw"),
];
/// All images of a scene together, in pixels (4 bytes each).
const LARGEST_SCENE: u64 = 1 << 30;
/// What one decoder may allocate, in bytes.
const LARGEST_DECODE: u64 = 2 << 30;

/// Where an image is, whose name a file of cameras gives.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Located {
    /// There, or with an extension added.
    There(PathBuf),
    /// The only file of that name with other capitals or another image extension.
    Renamed(PathBuf),
    /// Two files of that name with other extensions.
    Several(PathBuf, PathBuf),
    /// A file of that name of a kind that is not read, and what that is called.
    Unreadable(PathBuf, &'static str),
    /// Nowhere.
    Missing,
}

/// Looks for images; remembers what folders hold.
#[derive(Default)]
pub struct ImageFiles {
    /// Of each folder, its files by their names without extension, all in small letters.
    folders: HashMap<PathBuf, HashMap<String, Vec<PathBuf>>>,
}

impl ImageFiles {
    /// Entries of a folder that are looked at, at most.
    const MOST: usize = 100_000;

    /// What lies at `path`, up to capitals and the extension.
    pub fn locate(&mut self, path: &Path) -> Located {
        if path.is_file() {
            let kind = extension(path).and_then(|e| UNREADABLE.iter().find(|(known, _)| *known == e));
            return kind.map_or(Located::There(path.into()), |(_, kind)| Located::Unreadable(path.into(), kind));
        }
        let (Some(folder), Some(name)) = (path.parent(), path.file_name()) else { return Located::Missing };
        let name = name.to_string_lossy().to_lowercase();
        let files = self.folders.entry(folder.into()).or_insert_with(|| listed(folder));
        let none = Vec::new();
        let of = |stem: &str| files.get(stem).unwrap_or(&none).iter();
        let readable = |p: &&PathBuf| extension(p).is_some_and(|e| IMAGE_EXTENSIONS.contains(&e.as_str()));
        // An extension added, in the order in which they are tried.
        let added = |e: &&str| of(&name).find(|p| extension(p).is_some_and(|own| own == **e));
        if let Some(found) = IMAGE_EXTENSIONS.iter().find_map(added) {
            return Located::There(found.clone());
        }
        let stem = name.rsplit_once('.').map_or(name.as_str(), |(stem, _)| stem);
        let same = |p: &&PathBuf| p.file_name().is_some_and(|n| n.to_string_lossy().to_lowercase() == name);
        let capitals: Vec<&PathBuf> = of(stem).filter(same).filter(readable).collect();
        let others: Vec<&PathBuf> = of(stem).filter(readable).collect();
        for candidates in [capitals, others] {
            match candidates.as_slice() {
                [] => {}
                [one] => return Located::Renamed((*one).clone()),
                [first, second, ..] => return Located::Several((*first).clone(), (*second).clone()),
            }
        }
        let of_kind = |p: &PathBuf| {
            let own = extension(p)?;
            UNREADABLE.iter().find(|(known, _)| *known == own).map(|(_, kind)| Located::Unreadable(p.clone(), kind))
        };
        of(&name).chain(of(stem)).find_map(of_kind).unwrap_or(Located::Missing)
    }
}

fn extension(path: &Path) -> Option<String> {
    path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase())
}

fn listed(folder: &Path) -> HashMap<String, Vec<PathBuf>> {
    let mut files: HashMap<String, Vec<PathBuf>> = HashMap::new();
    let entries = std::fs::read_dir(folder).into_iter().flatten().take(ImageFiles::MOST).flatten();
    let mut paths: Vec<PathBuf> = entries.map(|e| e.path()).collect();
    paths.sort();
    for path in paths {
        let stem = path.file_stem().map(|s| s.to_string_lossy().to_lowercase()).unwrap_or_default();
        files.entry(stem).or_default().push(path);
    }
    files
}

/// The kind of image that a file's name promises, where it is one that is not read.
pub fn unreadable_kind(path: &Path) -> Option<&'static str> {
    let own = extension(path)?;
    UNREADABLE.iter().find(|(known, _)| *known == own).map(|(_, kind)| *kind)
}

/// The file name without an image's extension: `r_0.5` keeps its dot.
pub(super) fn name_of(path: &Path) -> String {
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    match name.rsplit_once('.') {
        Some((stem, end)) if IMAGE_EXTENSIONS.contains(&end.to_ascii_lowercase().as_str()) => stem.to_owned(),
        _ => name,
    }
}

/// The image file of a frame.
fn find(frame: &FrameDescription) -> Result<PathBuf, CameraError> {
    let place = || frame.place.clone();
    match ImageFiles::default().locate(&frame.image) {
        Located::There(path) | Located::Renamed(path) => Ok(path),
        Located::Several(first, second) => Err(CameraError::Field {
            place: place(),
            field: "file_path".into(),
            expected: "the name of one image".into(),
            found: format!("{}, which could be {} or {}", frame.image.display(), first.display(), second.display()),
        }),
        Located::Unreadable(path, kind) => Err(CameraError::Unsupported {
            place: place(),
            feature: format!("the {kind} image {}", path.display()),
            advice: CONVERT,
        }),
        Located::Missing => Err(CameraError::MissingImage { place: place(), image: frame.image.clone() }),
    }
}

/// What to do about an image of a kind that is not read.
pub const CONVERT: &str =
    "convert it to JPEG or PNG (`magick mogrify -format jpg *.heic`, or `sips -s format jpeg` on a Mac)";

fn decoder(path: &Path, frame: &FrameDescription) -> Result<impl ImageDecoder + use<>, CameraError> {
    let failed = |e| CameraError::Image { place: frame.place.clone(), image: path.to_path_buf(), source: Box::new(e) };
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(LARGEST_SIDE);
    limits.max_image_height = Some(LARGEST_SIDE);
    limits.max_alloc = Some(LARGEST_DECODE);
    let mut reader =
        ImageReader::open(path).and_then(|reader| reader.with_guessed_format()).map_err(IoError::at(path))?;
    reader.limits(limits);
    reader.into_decoder().map_err(failed)
}

/// Width and height of a frame's image, from its header.
pub fn image_size(frame: &FrameDescription) -> Result<(u32, u32), CameraError> {
    Ok(decoder(&find(frame)?, frame)?.dimensions())
}

/// An image whose size is not the intrinsics' own: widths and heights.
struct Rescaled {
    name: String,
    from: (u32, u32),
    to: (u32, u32),
}

/// Loads images and remembers what there is to tell about them.
#[derive(Default)]
pub(super) struct Images {
    pixels: u64,
    cut: Vec<(String, [u8; 3])>,
    rescaled: Vec<Rescaled>,
    undistorted: usize,
}

impl Images {
    /// The frames' views; `inputs` must show something.
    pub fn load_all(
        &mut self,
        description: &Description,
        frames: &[&FrameDescription],
        inputs: bool,
    ) -> Result<Vec<View>, CameraError> {
        tracing::debug!(file = %description.file.display(), frames = frames.len(), "loading images");
        frames.iter().map(|frame| self.load(frame, inputs)).collect()
    }

    fn load(&mut self, frame: &FrameDescription, input: bool) -> Result<View, CameraError> {
        let place = || frame.place.clone();
        let path = find(frame)?;
        let decoder = decoder(&path, frame)?;
        let (w, h) = decoder.dimensions();
        self.pixels += u64::from(w) * u64::from(h);
        if self.pixels > LARGEST_SCENE {
            return Err(CameraError::TooManyPixels { place: place(), limit: LARGEST_SCENE });
        }
        let mut camera = frame.camera(frame.size.unwrap_or((w, h)))?;
        if let Some(expected) = frame.size.filter(|size| *size != (w, h)) {
            // The same shape, up to one pixel of rounding.
            let (across, down) = (u64::from(w) * u64::from(expected.1), u64::from(h) * u64::from(expected.0));
            if across.abs_diff(down) > u64::from(expected.0.max(expected.1)) {
                return Err(CameraError::ImageSize { place: place(), image: path, expected, found: (w, h) });
            }
            camera = camera.resized(w, h);
            self.rescaled.push(Rescaled { name: frame.name.clone(), from: expected, to: (w, h) });
        }
        let mut image = DynamicImage::from_decoder(decoder)
            .map_err(|e| CameraError::Image { place: place(), image: path.clone(), source: Box::new(e) })?
            .into_rgba8();
        let background = |found: String| CameraError::Background { place: place(), image: path.clone(), found };
        let alpha = |image: &RgbaImage, value: u8| image.pixels().all(|p| p[3] == value);
        if alpha(&image, 255) {
            let (object, colour) = cut_out(&image).map_err(background)?;
            self.cut.push((frame.name.clone(), colour));
            image = object;
        } else if input && alpha(&image, 0) {
            return Err(background("an image that is transparent everywhere".into()));
        }
        if frame.lens != Lens::Ideal {
            if !frame.lens.is_one_to_one(&camera) {
                return Err(CameraError::Field {
                    place: place(),
                    field: "k1, k2, k3, k4, p1, p2".into(),
                    expected: "a distortion that maps the image one to one".into(),
                    found: format!("{:?}, which folds it", frame.lens),
                });
            }
            image = frame.lens.undistort(&image, &camera);
            self.undistorted += 1;
        }
        Ok(View { name: frame.name.clone(), camera, image })
    }

    pub fn into_notes(self) -> Vec<String> {
        let mut notes = Vec::new();
        if let Some((name, [r, g, b])) = self.cut.first() {
            let count = self.cut.len();
            notes.push(format!(
                "{count} images have no transparency: their plain background ({name}: rgb {r} {g} {b}) was cut away"
            ));
        }
        if let Some(Rescaled { name, from, to }) = self.rescaled.first() {
            let count = self.rescaled.len();
            notes.push(format!(
                "{count} images differ in size from `w`, `h` ({name}: {} x {} instead of {} x {}); intrinsics were scaled",
                to.0, to.1, from.0, from.1
            ));
        }
        if self.undistorted > 0 {
            notes.push(format!("lens distortion was removed from {} images", self.undistorted));
        }
        notes
    }
}
