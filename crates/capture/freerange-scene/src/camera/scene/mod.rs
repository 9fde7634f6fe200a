//! Scenes: folders of posed images as NeRF's data sets and nerfstudio describe them.
//!
//! A scene is a folder with `transforms.json`, or with `transforms_train.json` (the inputs) and
//! `transforms_test.json` or `transforms_val.json` (further views), or the path of one such file. Poses there are
//! camera-to-world with OpenGL axes; here they become OpenCV's world-to-camera.

mod cutout;
mod files;
mod json;
mod locate;
mod pose;
mod write;

pub use cutout::{BACKGROUND_TOLERANCE, cut_out, fills_frame};
pub(crate) use cutout::{Backdrop, find_backdrop, within_black};
pub use files::image_size;
pub use json::{Description, FrameDescription};
pub use locate::{CONVERT, IMAGE_EXTENSIONS, ImageFiles, Located, unreadable_kind};
pub use pose::{LARGEST_COORDINATE, nearest_rotation};
pub use write::transforms_json;

use freerange_util::IoError;

use crate::camera::{Camera, CameraError, View, error::Place};
use files::Images;
use std::path::{Path, PathBuf};

/// Posed images of one object.
#[derive(Clone, Debug)]
pub struct Scene {
    /// The views to reconstruct from, two or more.
    pub inputs: Vec<View>,
    /// Further views, for comparison; may be empty.
    pub further: Vec<View>,
    /// What was understood or changed while loading, for the user to read.
    pub notes: Vec<String>,
    /// The JSON files that were read, the inputs' first.
    pub files: Vec<PathBuf>,
}

impl Scene {
    /// Loads a scene from a folder or from one JSON file, images included.
    ///
    /// Images come out as 8-bit RGBA with straight alpha. One without alpha must show the object before one plain
    /// color, which is then cut away. Whatever cannot be used is refused with its file, frame and field.
    pub fn load(path: &Path) -> Result<Self, CameraError> {
        let found = Found::at(path)?;
        let mut notes = found.notes;
        let mut files = vec![found.inputs.clone()];
        let description = Description::read(&found.inputs)?.without_masks()?;
        let (train, rest) = description.split();
        let whole = Place { file: found.inputs.clone(), frame: None };
        if train.len() < 2 {
            return Err(CameraError::TooFewViews { place: whole, found: train.len() });
        }
        let mut images = Images::default();
        let inputs = images.load_all(&description, &train, true)?;
        refuse_one_center(&inputs, whole)?;
        let mut further = images.load_all(&description, &rest, false)?;
        notes.extend(description.notes);
        if let Some(file) = found.further {
            let description = Description::read(&file)?.without_masks()?;
            let all: Vec<&FrameDescription> = description.frames.iter().collect();
            further.extend(images.load_all(&description, &all, false)?);
            notes.extend(description.notes);
            files.push(file);
        }
        for note in images.into_notes() {
            notes.push(note);
        }
        let mut seen = std::collections::HashSet::new();
        notes.retain(|note| seen.insert(note.clone()));
        Ok(Self { inputs, further, notes, files })
    }
}

/// The cameras of a scene folder or JSON file, with their names. Images are needed only where the file does not say
/// `w` and `h`, and then only their headers are read. Lens distortion is left out: the cameras are those of the
/// undistorted images.
pub fn load_cameras(path: &Path) -> Result<Vec<(String, Camera)>, CameraError> {
    let description = Description::read(&Found::at(path)?.inputs)?;
    description
        .frames
        .iter()
        .map(|frame| {
            let size = match frame.size {
                Some(size) => size,
                None => files::image_size(frame)?,
            };
            Ok((frame.name.clone(), frame.camera(size)?))
        })
        .collect()
}

/// Which files make up a scene.
pub struct Found {
    /// The file with the input views.
    pub inputs: PathBuf,
    /// The file with further views.
    pub further: Option<PathBuf>,
    /// What was passed over.
    pub notes: Vec<String>,
}

impl Found {
    /// Looks into a folder, or takes one file as it is.
    pub fn at(path: &Path) -> Result<Self, CameraError> {
        if !std::fs::metadata(path).map_err(IoError::at(path))?.is_dir() {
            return Ok(Self { inputs: path.to_path_buf(), further: None, notes: Vec::new() });
        }
        let there = |name: &str| Some(path.join(name)).filter(|p| p.is_file());
        let train = there("transforms_train.json");
        if let Some(inputs) = there("transforms.json") {
            let note = "transforms.json is used; transforms_train.json beside it is not read";
            let notes = train.map(|_| note.to_owned()).into_iter().collect();
            return Ok(Self { inputs, further: None, notes });
        }
        if let Some(inputs) = train {
            let further = there("transforms_test.json").or_else(|| there("transforms_val.json"));
            return Ok(Self { inputs, further, notes: Vec::new() });
        }
        let mut others: Vec<String> = std::fs::read_dir(path)
            .map_err(IoError::at(path))?
            .flatten()
            .map(|entry| entry.file_name().to_string_lossy().into_owned())
            .filter(|name| name.ends_with(".json"))
            .take(20)
            .collect();
        others.sort();
        let found = match others.as_slice() {
            [] => "no .json file".to_owned(),
            names => format!("{} (a file can be named instead of the folder)", names.join(", ")),
        };
        Err(CameraError::NoScene { folder: path.to_path_buf(), found })
    }
}

/// Without a baseline there is no depth, whatever the images show.
fn refuse_one_center(views: &[View], place: Place) -> Result<(), CameraError> {
    let first = views[0].camera.center();
    let same = |view: &View| view.camera.center().distance(first) <= 1e-6 * (1e-6 + first.length());
    if views.iter().all(same) {
        return Err(CameraError::SameCenter { place, count: views.len() });
    }
    Ok(())
}
