//! Cameras as other programs write them: which program's they are, and one reader for each.
//!
//! Every reader takes bytes that nobody has checked. Counts claimed by a file are believed only as far as the bytes go that are
//! really there, and what cannot be used is refused with file, place and field.

mod checked;
pub mod colmap;
pub mod colmap_frames;
mod colmap_values;
mod files;
pub mod metashape;
pub mod opf;
mod origin;
mod photos;
pub mod polycam;
pub mod realitycapture;
mod transforms;
pub mod turntable;

use crate::camera::{
    Camera, Lens,
    scene::{IMAGE_EXTENSIONS, unreadable_kind},
};
use crate::{SceneError, error::In};
pub(crate) use checked::{coefficients, pinhole, rigid, world_to_camera};
use files::start_of;
pub(crate) use files::{bytes_of, entries, has_extension, inside, text_of};
use freerange_util::{Invalid, Note};
use glam::{DMat4, DVec3};
use photos::Photos;
pub(crate) use photos::listed;
use std::{
    collections::{BTreeSet, HashMap},
    path::{Path, PathBuf},
};
pub use turntable::{Turntable, in_order, photos_in};

/// Photos of one scene, at most.
pub(crate) const LARGEST_SCENE: usize = 10_000;
/// Image files that are taken without being named.
pub(crate) const IMAGES: [&str; 4] = IMAGE_EXTENSIONS;

/// Whose cameras they are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    /// `transforms.json` of NeRF tools and nerfstudio.
    Transforms,
    /// COLMAP's `cameras` and `images`, binary or text.
    Colmap,
    /// Polycam's raw export: one JSON file per photo.
    Polycam,
    /// Agisoft Metashape's camera export, XML.
    Metashape,
    /// RealityCapture's (RealityScan's) registration export, CSV.
    Realitycapture,
    /// Pix4D's Open Photogrammetry Format: `project.opf`.
    Opf,
    /// None: photos at even steps around the object.
    Turntable,
}

impl Format {
    /// All that a folder can be found to be.
    pub const ALL: [Self; 6] =
        [Self::Transforms, Self::Colmap, Self::Polycam, Self::Metashape, Self::Realitycapture, Self::Opf];

    /// As in options and reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Transforms => "transforms",
            Self::Colmap => "colmap",
            Self::Polycam => "polycam",
            Self::Metashape => "metashape",
            Self::Realitycapture => "realitycapture",
            Self::Opf => "opf",
            Self::Turntable => "turntable",
        }
    }
}

/// How large the camera's image is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Intrinsics {
    /// In pixels of an image of known size.
    Pixels(Camera),
    /// Relative to the image's longer side, for formats that do not tell sizes: focal length, and offset of the principal point
    /// from the middle.
    Relative {
        /// Focal length divided by the longer side.
        focal: f64,
        /// Principal point minus the middle, x and y, divided by the longer side.
        offset: [f64; 2],
        /// Rigid transform from world to camera.
        world_to_camera: DMat4,
        /// Whether the camera is that of the photo as viewers show it, turned by its EXIF data, instead of its stored pixels.
        upright: bool,
    },
}

/// A photo with its camera, as a reader found it; the image itself has not been looked at.
#[derive(Clone, Debug)]
pub struct Photo {
    /// File name as the format gives it, folders included.
    pub name: String,
    /// The image file.
    pub image: PathBuf,
    /// The mask file that the format names.
    pub mask: Option<PathBuf>,
    /// Its camera, without the lens.
    pub intrinsics: Intrinsics,
    /// Its lens.
    pub lens: Lens,
    /// Only compared with, not reconstructed from.
    pub further: bool,
}

impl Intrinsics {
    /// From world to camera.
    pub fn world_to_camera(&self) -> DMat4 {
        match self {
            Self::Pixels(camera) => camera.world_to_camera,
            Self::Relative { world_to_camera, .. } => *world_to_camera,
        }
    }

    fn world_to_camera_mut(&mut self) -> &mut DMat4 {
        match self {
            Self::Pixels(camera) => &mut camera.world_to_camera,
            Self::Relative { world_to_camera, .. } => world_to_camera,
        }
    }
}

impl Photo {
    /// Whether its camera is that of the photo as viewers show it.
    pub(crate) fn is_upright(&self) -> bool {
        matches!(self.intrinsics, Intrinsics::Relative { upright: true, .. })
    }

    /// The camera for an image of `size` (width, height), which must have the shape that the camera was made for.
    pub fn camera(&self, size: (u32, u32)) -> Result<Camera, SceneError> {
        let (width, height) = size;
        match self.intrinsics {
            Intrinsics::Pixels(camera) => {
                let expected = (camera.width, camera.height);
                // The same shape, up to one pixel of rounding.
                let (a, b) = (u64::from(width) * u64::from(expected.1), u64::from(height) * u64::from(expected.0));
                if a.abs_diff(b) > u64::from(expected.0.max(expected.1)) {
                    let file = self.image.clone();
                    return Err(SceneError::Size { file, of: "its camera's", expected, found: size });
                }
                Ok(camera.resized(width, height))
            }
            Intrinsics::Relative { focal, offset, world_to_camera, .. } => {
                let side = f64::from(width.max(height));
                let (cx, cy) = (0.5 * f64::from(width) + side * offset[0], 0.5 * f64::from(height) + side * offset[1]);
                Ok(Camera { width, height, fx: side * focal, fy: side * focal, cx, cy, world_to_camera })
            }
        }
    }
}

/// What a reader found.
#[derive(Clone, Debug)]
pub struct Cameras {
    /// Whose they are.
    pub format: Format,
    /// The photos, in the order of the file.
    pub photos: Vec<Photo>,
    /// The files that were read.
    pub files: Vec<PathBuf>,
    /// The scene's own folder: nothing outside of it is taken without being named.
    pub root: PathBuf,
    /// What was subtracted from all positions, in the scene's frame: cameras on maps lie where 32 bits do not resolve an object.
    pub origin: DVec3,
    /// Nothing says which way is up: the frame is the one that a reconstruction happened to have.
    pub any_up: bool,
    /// What was understood or passed over, for the user to read.
    pub notes: Vec<Note>,
}

impl Cameras {
    /// A path for the user to read: from the scene's folder on, where it lies there.
    pub(crate) fn short(&self, path: &Path) -> String {
        path.strip_prefix(&self.root).unwrap_or(path).display().to_string()
    }

    /// What a reader found; the rest is added by [`cameras_with`].
    fn new(format: Format, photos: Vec<Photo>, files: Vec<PathBuf>, notes: Vec<Note>) -> Self {
        let any_up = matches!(format, Format::Colmap | Format::Metashape);
        Self { format, photos, files, root: PathBuf::new(), origin: DVec3::ZERO, any_up, notes }
    }
}

/// How cameras are read.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReadConfig {
    /// Decides where a folder could be two things; without it that is an error that names both.
    pub format: Option<Format>,
    /// The folder holds photos without any cameras, taken like this.
    pub turntable: Option<Turntable>,
    /// The folder of the photos, where they do not lie where the format has them.
    pub images: Option<PathBuf>,
}

/// [`cameras_with`] with all photos in their usual places.
pub fn cameras(path: &Path, format: Option<Format>, turntable: Option<&Turntable>) -> Result<Cameras, SceneError> {
    cameras_with(path, &ReadConfig { format, turntable: turntable.copied(), images: None })
}

/// Reads the cameras of a scene: a folder, or a file of one of the formats.
pub fn cameras_with(path: &Path, config: &ReadConfig) -> Result<Cameras, SceneError> {
    let metadata = std::fs::metadata(path).map_err(|e| In(path).read(e))?;
    let (format, images) = (config.format, config.images.as_deref());
    if let Some(folder) = images {
        entries(folder)?;
    }
    if let Some(turntable) = &config.turntable {
        let folder = images.unwrap_or(path);
        return Ok(Cameras { root: folder.into(), ..turntable::read(folder, turntable)? });
    }
    let mut cameras = if metadata.is_dir() {
        let mut found: Vec<(Format, PathBuf)> = Vec::new();
        for candidate in Format::ALL {
            if format.is_none_or(|f| f == candidate) {
                found.extend(look_for(path, candidate)?.map(|file| (candidate, file)));
            }
        }
        match found.as_slice() {
            [] => return Err(nothing(path, format)?),
            [(format, file)] => read(*format, file, images)?,
            [(a, first), (b, second), ..] => {
                return Err(SceneError::Ambiguous {
                    folder: path.into(),
                    first: format!("{} ({})", a.name(), first.display()),
                    second: format!("{} ({})", b.name(), second.display()),
                    advice: format!("say which with --cameras {} or --cameras {}", a.name(), b.name()),
                });
            }
        }
    } else {
        let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        let own = match extension.as_deref() {
            Some("json") => Format::Transforms,
            Some("xml") => Format::Metashape,
            Some("csv") => Format::Realitycapture,
            Some("opf") => Format::Opf,
            Some("bin" | "txt") if colmap::is_one(path) => Format::Colmap,
            _ => {
                let expected =
                    "a folder, a file .json, .xml, .csv or .opf, or COLMAP's cameras or images, .bin or .txt";
                return Err(In(path).field("", "file name", expected, path.display()));
            }
        };
        if let Some(format) = format.filter(|f| *f != own) {
            let expected = format!("{} for this file", own.name());
            return Err(Invalid::new("--cameras", expected, format.name()).into());
        }
        match own {
            Format::Colmap => colmap::read(path.parent().unwrap_or(Path::new("")), images)?,
            own => read(own, path, images)?,
        }
    };
    if cameras.photos.len() > LARGEST_SCENE {
        let found = cameras.photos.len();
        return Err(In(path).field("", "photos", &format!("at most {LARGEST_SCENE}"), found));
    }
    cameras.root = root_of(path, cameras.format);
    different_files(&mut cameras)?;
    // One of several descriptions in a folder has a part of its photos.
    if cameras.format != Format::Transforms || metadata.is_dir() {
        cameras.notes.extend(without_camera(&cameras.photos));
    }
    cameras.settle_origin();
    Ok(cameras)
}

/// The folder of the scene that `path` names: a folder, or a file in it, or a COLMAP model in its `sparse`.
fn root_of(path: &Path, format: Format) -> PathBuf {
    let absolute = std::fs::canonicalize(path).unwrap_or_else(|_| path.into());
    let folder = if absolute.is_dir() { absolute.as_path() } else { absolute.parent().unwrap_or(Path::new("")) };
    if format == Format::Colmap { colmap::scene_of(folder).into() } else { folder.into() }
}

/// A file is one photo: under two poses it is an error that names both; under one pose twice it is used once.
fn different_files(cameras: &mut Cameras) -> Result<(), SceneError> {
    let mut seen: HashMap<PathBuf, (String, bool, DMat4)> = HashMap::new();
    let (mut twice, mut kept) = (0, Vec::with_capacity(cameras.photos.len()));
    for photo in std::mem::take(&mut cameras.photos) {
        let pose = photo.intrinsics.world_to_camera();
        match seen.get(&photo.image) {
            Some((other, _, others_pose)) if !others_pose.abs_diff_eq(pose, 1e-9) => {
                return Err(SceneError::SameFile { file: photo.image, first: other.clone(), second: photo.name });
            }
            // One that is reconstructed from may be compared with as well.
            Some((_, further, _)) if *further == photo.further => twice += 1,
            _ => {
                seen.insert(photo.image.clone(), (photo.name.clone(), photo.further, pose));
                kept.push(photo);
            }
        }
    }
    cameras.photos = kept;
    if twice > 0 {
        cameras.notes.push(Note::dropped(format!("{twice} photos are listed twice with one pose, and used once")));
    }
    Ok(())
}

/// A note on the images that lie beside the photos and have no camera: programs do not manage to place them all.
fn without_camera(photos: &[Photo]) -> Option<Note> {
    let folders: BTreeSet<&Path> = photos.iter().filter_map(|p| p.image.parent()).collect();
    let files = photos.iter().flat_map(|p| [Some(&p.image), p.mask.as_ref()]).flatten();
    let known: BTreeSet<&Path> = files.map(PathBuf::as_path).collect();
    let there = folders.into_iter().filter_map(|f| entries(f).ok()).flatten();
    let left: Vec<String> = there
        .filter(|p| has_extension(p, &IMAGES) && !known.contains(p.as_path()) && !goes_with_one(p, &known))
        .filter_map(|p| p.file_name().map(|n| n.to_string_lossy().into_owned()))
        .collect();
    let more = if left.len() > 6 { ", ..." } else { "" };
    let names = left.iter().take(6).cloned().collect::<Vec<_>>().join(", ");
    (!left.is_empty())
        .then(|| Note::dropped(format!("{} photos have no camera and are left out: {names}{more}", left.len())))
}

/// Whether a file is the mask, depth or normals of a photo beside it: `NAME.jpg.png`, `NAME.mask.png`, `NAME_depth_0001.png`.
fn goes_with_one(file: &Path, photos: &BTreeSet<&Path>) -> bool {
    let Some(own) = file.file_stem().map(|s| s.to_string_lossy().into_owned()) else { return false };
    let words = [".mask", "_mask", "_depth", "_normal"];
    let whose = words.iter().find_map(|word| own.split_once(word)).map(|(name, _)| name);
    let named = |name: &str| photos.contains(file.with_file_name(name).as_path());
    let with_extension = |name: &str| IMAGES.iter().any(|end| named(&format!("{name}.{end}")));
    match whose {
        Some(name) => named(name) || with_extension(name),
        None => named(&own),
    }
}

fn read(format: Format, file: &Path, images: Option<&Path>) -> Result<Cameras, SceneError> {
    match format {
        Format::Transforms if images.is_some() => Err(Invalid::new(
            "--images",
            "cameras that do not say where their photos are (colmap, polycam, metashape, realitycapture, opf)",
            "transforms.json, which does",
        )
        .into()),
        Format::Transforms => transforms::read(file),
        Format::Colmap => colmap::read(file, images),
        Format::Polycam => polycam::read(file, images),
        Format::Metashape => metashape::read(file, images),
        Format::Realitycapture => realitycapture::read(file, images),
        Format::Opf => opf::read(file, images),
        Format::Turntable => {
            let expected = "the format of a file; turntables have --turntable ELEVATION,FOV";
            Err(Invalid::new("--cameras", expected, "turntable").into())
        }
    }
}

/// The file or folder that makes `folder` a scene of this format, if it is one.
fn look_for(folder: &Path, format: Format) -> Result<Option<PathBuf>, SceneError> {
    Ok(match format {
        Format::Transforms => {
            let there = ["transforms.json", "transforms_train.json"].iter().any(|n| folder.join(n).is_file());
            there.then(|| folder.to_path_buf())
        }
        Format::Colmap => colmap::look_for(folder)?,
        Format::Polycam => polycam::look_for(folder),
        Format::Metashape => single(folder, "xml", metashape::is_one)?,
        Format::Realitycapture => single(folder, "csv", realitycapture::is_one)?,
        Format::Opf => single(folder, "opf", opf::is_one)?,
        Format::Turntable => None,
    })
}

/// The one file with this extension that looks right; several are an error that names two.
fn single(folder: &Path, extension: &str, right: fn(&[u8]) -> bool) -> Result<Option<PathBuf>, SceneError> {
    let mut found = Vec::new();
    for path in entries(folder)? {
        if has_extension(&path, &[extension]) && path.is_file() && right(&start_of(&path)?) {
            found.push(path);
        }
    }
    match found.as_slice() {
        [first, second, ..] => Err(SceneError::Ambiguous {
            folder: folder.into(),
            first: first.display().to_string(),
            second: second.display().to_string(),
            advice: "name the file instead of the folder".into(),
        }),
        _ => Ok(found.pop()),
    }
}

fn nothing(folder: &Path, format: Option<Format>) -> Result<SceneError, SceneError> {
    let there = entries(folder)?;
    if let Some((file, kind)) = there.iter().find_map(|f| Some((f, unreadable_kind(f)?))) {
        return Ok(In(file).unreadable(kind));
    }
    let names: Vec<String> =
        there.iter().take(8).filter_map(|p| p.file_name().map(|n| n.to_string_lossy().into_owned())).collect();
    let found = if names.is_empty() { "an empty folder".into() } else { names.join(", ") };
    Ok(match format {
        Some(format) => {
            let expected = format!("a folder with {} cameras", format.name());
            Invalid::new("--cameras", expected, format!("{}: {found}", folder.display())).into()
        }
        None => SceneError::Nothing { folder: folder.into(), found },
    })
}
