//! Reading `transforms*.json`: every field checked, with its frame and name in the error.

use super::{
    locate::{LARGEST_SIDE, name_of},
    pose,
};
use crate::camera::{Camera, CameraError, Lens, error::Place};
use freerange_util::IoError;
use glam::DMat4;
use serde_json::{Map, Value};
use std::{
    collections::{HashMap, HashSet},
    io::Read,
    path::{Path, PathBuf},
};

/// Largest scene description accepted; some ten thousand frames.
const LARGEST_FILE: u64 = 16 << 20;
/// Camera models that are a pinhole with at most the distortion that [`Lens`] describes.
const PINHOLES: [&str; 6] = ["PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"];
/// OpenCV's fisheye model, as nerfstudio and COLMAP call it.
const FISHEYE: &str = "OPENCV_FISHEYE";

/// One `transforms*.json`: every field checked, no image looked at.
pub struct Description {
    /// The file.
    pub file: PathBuf,
    /// Its frames, one or more.
    pub frames: Vec<FrameDescription>,
    /// What was understood, for the user to read.
    pub notes: Vec<String>,
    /// The poses are in COLMAP's arbitrary frame, whose axes were only exchanged (nerfstudio's `applied_transform`): +z need not be up.
    pub any_up: bool,
    /// `train_filenames`, as [`plain_path`] spells them, or what is in no other list; none where the file has no list.
    train: Option<HashSet<String>>,
}

/// One frame, its pose checked; the image itself has not been looked at.
pub struct FrameDescription {
    /// Which file and frame this is, for messages.
    pub place: Place,
    /// The image's file name without its extension; with its folders where other frames have the same.
    pub name: String,
    /// `file_path` as resolved against the JSON's folder; the extension may be missing.
    pub image: PathBuf,
    /// `mask_path`, resolved likewise.
    pub mask: Option<PathBuf>,
    /// `w` and `h`, where given.
    pub size: Option<(u32, u32)>,
    /// Its lens.
    pub lens: Lens,
    written: String,
    focal: Focal,
    principal: [Option<f64>; 2],
    world_to_camera: DMat4,
}

/// Focal length along x, and along y where it is given apart.
enum Focal {
    Pixels(f64, Option<f64>),
    /// Fields of view in radians.
    Angles(f64, Option<f64>),
}

impl Description {
    /// Reads and checks a file.
    pub fn read(file: &Path) -> Result<Self, CameraError> {
        Self::parse(file, &read_limited(file)?)
    }

    /// Checks a file's bytes; nothing is read, `file` is for messages and to resolve paths.
    pub fn parse(file: &Path, bytes: &[u8]) -> Result<Self, CameraError> {
        let place = Place { file: file.to_path_buf(), frame: None };
        let root: Value = serde_json::from_slice(bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes))
            .map_err(|source| CameraError::Json { file: file.to_path_buf(), source })?;
        let Value::Object(root) = &root else {
            return Err(field(&place, "(whole file)", "an object with `frames`", describe(&root)));
        };
        let frames = match root.get("frames") {
            Some(Value::Array(frames)) if !frames.is_empty() => frames,
            other => return Err(field(&place, "frames", "a list of one or more frames", found(other))),
        };
        let folder = file.parent().unwrap_or(Path::new(""));
        let mut frames: Vec<FrameDescription> = frames
            .iter()
            .enumerate()
            .map(|(i, frame)| FrameDescription::read(frame, root, folder, Place { frame: Some(i), ..place.clone() }))
            .collect::<Result<_, _>>()?;
        different_names(&mut frames)?;
        let mut train = listed(root, "train_filenames", &place)?;
        let mut any_up = false;
        let mut notes = Vec::new();
        let ours: HashSet<&str> = frames.iter().map(|f| f.written.as_str()).collect();
        if let Some(train) = &train {
            let strange = train.iter().filter(|t| !ours.contains(t.as_str())).min();
            match strange {
                Some(name) if train.iter().all(|t| !ours.contains(t.as_str())) => {
                    let expected = "names of which at least one is a frame's `file_path`";
                    return Err(field(&place, "train_filenames", expected, format!("{name:?}, ..., none of them")));
                }
                Some(name) => {
                    notes.push(format!("{}: `train_filenames` has {name:?}, which no frame has", file.display()))
                }
                None => {}
            }
            let others: Vec<&str> =
                frames.iter().map(|f| f.written.as_str()).filter(|name| !train.contains(*name)).collect();
            if let Some(first) = others.first() {
                notes.push(format!(
                    "{}: {} frames that are not in `train_filenames` are only compared with ({first})",
                    file.display(),
                    others.len()
                ));
            }
        }
        let mut held = listed(root, "test_filenames", &place)?.unwrap_or_default();
        held.extend(listed(root, "val_filenames", &place)?.unwrap_or_default());
        if train.is_none() && ours.iter().any(|name| held.contains(*name)) {
            let file = file.display();
            notes.push(format!("{file}: frames of `test_filenames` and `val_filenames` are only compared with"));
            train = Some(ours.iter().filter(|name| !held.contains(**name)).map(|name| (*name).to_owned()).collect());
        }
        if root.get("applied_transform").is_some_and(|v| !v.is_null()) {
            any_up = root.get("orientation_override").and_then(Value::as_str) != Some("none");
            let name = file.display();
            notes.push(format!(
                "{name}: the poses already contain `applied_transform`; results are in the poses' frame"
            ));
        }
        Ok(Self { file: file.to_path_buf(), frames, notes, any_up, train })
    }

    /// Refuses masks in files of their own, which only the crate `freerange-scene` reads.
    pub(super) fn without_masks(self) -> Result<Self, CameraError> {
        match self.frames.iter().find(|frame| frame.mask.is_some()) {
            None => Ok(self),
            Some(frame) => Err(CameraError::Unsupported {
                place: frame.place.clone(),
                feature: "`mask_path`".into(),
                advice: "put the mask into the image's alpha channel",
            }),
        }
    }

    /// The frames to reconstruct from, and the others.
    pub fn split(&self) -> (Vec<&FrameDescription>, Vec<&FrameDescription>) {
        self.frames.iter().partition(|f| self.train.as_ref().is_none_or(|t| t.contains(&f.written)))
    }
}

impl FrameDescription {
    fn read(frame: &Value, root: &Map<String, Value>, folder: &Path, place: Place) -> Result<Self, CameraError> {
        let Value::Object(frame) = frame else {
            return Err(field(&place, "frames", "an object for each frame", describe(frame)));
        };
        let fields = Fields { frame, root, place: &place };
        fields.refuse_unsupported()?;
        let written = match frame.get("file_path") {
            Some(Value::String(path)) if !plain_path(path).is_empty() => plain_path(path),
            other => return Err(field(&place, "file_path", "a file name", found(other))),
        };
        let world_to_camera = pose::world_to_camera(&fields.transform_matrix()?, &place)?;
        let size = match (fields.side("w")?, fields.side("h")?) {
            (Some(w), Some(h)) => Some((w, h)),
            (None, None) => None,
            (w, _) => {
                let missing = if w.is_none() { "w" } else { "h" };
                return Err(field(&place, missing, "both `w` and `h`, or neither", "only one".into()));
            }
        };
        let focal = fields.focal()?;
        let principal = [fields.number("cx")?, fields.number("cy")?];
        let lens = fields.lens()?;
        let mask = match fields.get("mask_path") {
            None => None,
            Some(Value::String(path)) if !path.is_empty() => Some(folder.join(plain_path(path))),
            other => return Err(field(&place, "mask_path", "a file name", found(other))),
        };
        let image = folder.join(&written);
        let name = name_of(&image);
        if name.is_empty() {
            return Err(field(&place, "file_path", "a file name", format!("{written:?}")));
        }
        Ok(Self { name, image, mask, size, lens, written, focal, principal, world_to_camera, place })
    }

    /// Whether some of its intrinsics are in pixels, so that they are those of an image of one size.
    pub fn is_in_pixels(&self) -> bool {
        matches!(self.focal, Focal::Pixels(..)) || self.principal.iter().any(Option::is_some)
    }

    /// The frame's camera for an image of `size` (width, height): the file's own, or the image's where it has none.
    pub fn camera(&self, size: (u32, u32)) -> Result<Camera, CameraError> {
        let (w, h) = (f64::from(size.0), f64::from(size.1));
        let from_angle = |angle: f64, side: f64| 0.5 * side / (0.5 * angle).tan();
        let (fx, fy) = match self.focal {
            Focal::Pixels(x, y) => (x, y.unwrap_or(x)),
            Focal::Angles(x, y) => {
                let fx = from_angle(x, w);
                (fx, y.map_or(fx, |y| from_angle(y, h)))
            }
        };
        let principal = |i: usize, name: &str, side: f64| match self.principal[i] {
            Some(c) if !(-side..=2.0 * side).contains(&c) => {
                Err(field(&self.place, name, &format!("a point near the image's {side} pixels"), c.to_string()))
            }
            c => Ok(c.unwrap_or(0.5 * side)),
        };
        for (name, f, side) in [("fl_x", fx, w), ("fl_y", fy, h)] {
            if !(1e-2 * side..=1e3 * side).contains(&f) {
                let expected = format!("a focal length between 0.01 and 1000 times the image's {side} pixels");
                return Err(field(&self.place, name, &expected, f.to_string()));
            }
        }
        let (cx, cy) = (principal(0, "cx", w)?, principal(1, "cy", h)?);
        let (width, height) = size;
        Ok(Camera { width, height, fx, fy, cx, cy, world_to_camera: self.world_to_camera })
    }
}

/// A frame's fields; those of the whole file stand in for missing ones.
struct Fields<'a> {
    frame: &'a Map<String, Value>,
    root: &'a Map<String, Value>,
    place: &'a Place,
}

impl Fields<'_> {
    fn get(&self, name: &str) -> Option<&Value> {
        let present = |map: &'_ Map<String, Value>| map.get(name).is_some_and(|v| !v.is_null());
        [self.frame, self.root].into_iter().find(|map| present(map)).and_then(|map| map.get(name))
    }

    fn number(&self, name: &str) -> Result<Option<f64>, CameraError> {
        self.get(name).map(|v| finite(v).ok_or_else(|| self.wrong(name, "a finite number"))).transpose()
    }

    fn wrong(&self, name: &str, expected: &str) -> CameraError {
        field(self.place, name, expected, found(self.get(name)))
    }

    /// An image side in pixels; some programs write it as a float.
    fn side(&self, name: &str) -> Result<Option<u32>, CameraError> {
        let Some(v) = self.number(name)? else { return Ok(None) };
        if v.fract() != 0.0 || !(1.0..=f64::from(LARGEST_SIDE)).contains(&v) {
            return Err(self.wrong(name, &format!("a whole number from 1 to {LARGEST_SIDE}")));
        }
        Ok(Some(v as u32))
    }

    fn focal(&self) -> Result<Focal, CameraError> {
        let positive = |name: &str| match self.number(name)? {
            Some(v) if v <= 0.0 => Err(self.wrong(name, "a positive number of pixels")),
            v => Ok(v),
        };
        let angle = |name: &str| match self.number(name)? {
            Some(v) if !(v > 0.0 && v < std::f64::consts::PI) => {
                Err(self.wrong(name, "an angle in radians between 0 and pi"))
            }
            v => Ok(v),
        };
        let (fx, fy) = (positive("fl_x")?, positive("fl_y")?);
        let (ax, ay) = (angle("camera_angle_x")?, angle("camera_angle_y")?);
        // A frame's own angle counts for more than the whole file's pixels.
        let own = |name: &str| self.frame.get(name).is_some_and(|v| !v.is_null());
        match (fx, ax) {
            (Some(_), Some(ax)) if own("camera_angle_x") && !own("fl_x") => Ok(Focal::Angles(ax, ay)),
            (Some(fx), _) => Ok(Focal::Pixels(fx, fy)),
            (None, Some(ax)) => Ok(Focal::Angles(ax, ay)),
            (None, None) => Err(field(self.place, "fl_x", "`fl_x` or `camera_angle_x`", "neither".into())),
        }
    }

    fn lens(&self) -> Result<Lens, CameraError> {
        let coefficient = |name: &str| match self.number(name)?.unwrap_or(0.0) {
            v if v.abs() <= 100.0 => Ok(v),
            _ => Err(self.wrong(name, "a distortion coefficient between -100 and 100")),
        };
        let k = [coefficient("k1")?, coefficient("k2")?, coefficient("k3")?, coefficient("k4")?];
        let p = [coefficient("p1")?, coefficient("p2")?];
        if self.fisheye()? {
            return match p {
                [0.0, 0.0] => Ok(Lens::Fisheye { k }),
                _ => Err(self.wrong("p1", "no tangential coefficients with a fisheye")),
            };
        }
        let lens = Lens::brown(k, p);
        let model = self.get("camera_model").and_then(Value::as_str).unwrap_or("OPENCV");
        if model.ends_with("PINHOLE") && lens != Lens::Ideal {
            return Err(self.wrong("camera_model", "OPENCV, as there are distortion coefficients"));
        }
        Ok(lens)
    }

    fn transform_matrix(&self) -> Result<Vec<[f64; 4]>, CameraError> {
        let wrong = |found: String| field(self.place, "transform_matrix", "3 or 4 rows of 4 finite numbers", found);
        let rows = match self.frame.get("transform_matrix") {
            Some(Value::Array(rows)) if rows.len() == 3 || rows.len() == 4 => rows,
            Some(Value::Array(rows)) => return Err(wrong(format!("a list of {}", rows.len()))),
            other => return Err(wrong(found(other))),
        };
        let row = |row: &Value| {
            let numbers = row.as_array().filter(|r| r.len() == 4)?;
            let mut out = [0.0; 4];
            for (o, v) in out.iter_mut().zip(numbers) {
                *o = finite(v)?;
            }
            Some(out)
        };
        rows.iter().map(|r| row(r).ok_or_else(|| wrong(format!("the row {}", describe(r))))).collect()
    }

    /// Whether the model is a fisheye, by name or by instant-ngp's flag.
    fn fisheye(&self) -> Result<bool, CameraError> {
        let flag = match self.get("is_fisheye") {
            None => false,
            Some(Value::Bool(flag)) => *flag,
            Some(_) => return Err(self.wrong("is_fisheye", "true or false")),
        };
        let named = self.get("camera_model").and_then(Value::as_str) == Some(FISHEYE);
        if flag && !named && self.get("camera_model").is_some() {
            return Err(self.wrong("camera_model", "OPENCV_FISHEYE, as `is_fisheye` is true"));
        }
        Ok(flag || named)
    }

    /// Names what would change the picture if it were ignored.
    fn refuse_unsupported(&self) -> Result<(), CameraError> {
        let refuse =
            |feature: String, advice| Err(CameraError::Unsupported { place: self.place.clone(), feature, advice });
        let undistort = "undistort the images first";
        match self.get("camera_model") {
            Some(Value::String(model)) if PINHOLES.contains(&model.as_str()) || model == FISHEYE => {}
            Some(model) => return refuse(format!("`camera_model` {}", describe(model)), undistort),
            None => {}
        }
        for name in ["k5", "k6"] {
            if self.number(name)?.is_some_and(|v| v != 0.0) {
                return refuse(format!("the distortion coefficient `{name}`"), undistort);
            }
        }
        if let Some(list) = self.get("distortion_params") {
            let zero = list.as_array().is_some_and(|l| l.iter().all(|v| v.as_f64() == Some(0.0)));
            if !zero {
                return refuse("`distortion_params`".into(), "write the coefficients as k1 to k4, p1, p2");
            }
        }
        Ok(())
    }
}

/// The names in a list of the whole file, as [`plain_path`] spells them; none where there is no such list.
fn listed(root: &Map<String, Value>, list: &str, place: &Place) -> Result<Option<HashSet<String>>, CameraError> {
    match root.get(list) {
        None | Some(Value::Null) => Ok(None),
        Some(Value::Array(names)) => Ok(Some(names.iter().filter_map(|n| n.as_str().map(plain_path)).collect())),
        other => Err(field(place, list, "a list of file names", found(other))),
    }
}

/// A path as it is compared and resolved: separated by `/`, without `./` at its beginning and doubled separators.
fn plain_path(written: &str) -> String {
    let written = written.replace('\\', "/");
    let parts: Vec<&str> = written
        .split('/')
        .enumerate()
        .filter(|(i, p)| (*i == 0 || !p.is_empty()) && *p != ".")
        .map(|(_, p)| p)
        .collect();
    parts.join("/")
}

/// Names that several frames have get their folders, as in `cam0_0001`; two frames of one name are an error then.
fn different_names(frames: &mut [FrameDescription]) -> Result<(), CameraError> {
    let mut counts: HashMap<String, usize> = HashMap::new();
    frames.iter().for_each(|f| *counts.entry(f.name.clone()).or_default() += 1);
    for frame in frames.iter_mut().filter(|f| counts[&f.name] > 1) {
        let folders = frame.written.rsplit_once('/').map_or("", |(folders, _)| folders).replace('/', "_");
        if !folders.is_empty() {
            frame.name = format!("{folders}_{}", frame.name);
        }
    }
    let mut names: HashMap<&str, usize> = HashMap::new();
    for (i, frame) in frames.iter().enumerate() {
        if let Some(other) = names.insert(&frame.name, i) {
            let (place, name) = (frame.place.clone(), frame.name.clone());
            return Err(CameraError::DuplicateName { place, name, other });
        }
    }
    Ok(())
}

fn finite(v: &Value) -> Option<f64> {
    v.as_f64().filter(|v| v.is_finite())
}

fn field(place: &Place, name: &str, expected: &str, found: String) -> CameraError {
    CameraError::Field { place: place.clone(), field: name.into(), expected: expected.into(), found }
}

fn found(value: Option<&Value>) -> String {
    value.map_or_else(|| "nothing".into(), describe)
}

/// A value in few words, whatever its size.
fn describe(value: &Value) -> String {
    match value {
        Value::Object(map) => format!("an object of {} fields", map.len()),
        Value::Array(list) if list.len() > 8 => format!("a list of {}", list.len()),
        Value::Array(list) => {
            format!(
                "[{}]",
                list.iter()
                    .map(|v| if v.is_array() { "[..]".into() } else { describe(v) })
                    .collect::<Vec<_>>()
                    .join(", ")
            )
        }
        Value::String(text) => format!("{:?}", text.chars().take(60).collect::<String>()),
        other => other.to_string(),
    }
}

fn read_limited(file: &Path) -> Result<Vec<u8>, CameraError> {
    let failed = |e| IoError::at(file)(e);
    // A pipe or device would never end.
    let metadata = std::fs::metadata(file).map_err(failed)?;
    if !metadata.is_file() {
        return Err(failed(std::io::Error::other("not a regular file")).into());
    }
    let mut bytes = Vec::new();
    std::fs::File::open(file).and_then(|f| f.take(LARGEST_FILE + 1).read_to_end(&mut bytes)).map_err(failed)?;
    if bytes.len() as u64 > LARGEST_FILE {
        let found = metadata.len().max(bytes.len() as u64);
        return Err(CameraError::FileTooLarge { file: file.to_path_buf(), limit: LARGEST_FILE, found });
    }
    Ok(bytes)
}
