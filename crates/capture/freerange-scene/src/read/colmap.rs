//! COLMAP's sparse models: `cameras` and `images`, binary or text.
//!
//! Written after the format's documentation; points are not read, rigs and frames compared with.
//! Poses are world to camera with OpenCV's axes,
//! pixel centers lie at +0.5, numbers in binary files are little-endian.

pub use super::colmap_values::ColmapImage;
use super::{
    Cameras, Format, Intrinsics, Photo, Photos, bytes_of, coefficients, colmap_frames,
    colmap_values::{Bytes, number},
    pinhole, rigid, text_of,
};
use crate::camera::Lens;
use crate::{SceneError, error::In};
use freerange_util::Note;
use glam::{DMat3, DQuat, DVec3};
use std::{
    collections::{HashMap, HashSet},
    path::{Path, PathBuf},
};

/// Names of COLMAP's camera models in the order of their numbers.
const MODELS: [&str; 18] = [
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
    "SIMPLE_DIVISION",
    "DIVISION",
    "SIMPLE_FISHEYE",
    "FISHEYE",
    "EUCM",
    "EQUIRECTANGULAR",
];

/// Whether a file has a name of those of a model.
pub(super) fn is_one(file: &Path) -> bool {
    let names = ["cameras", "images", "points3D", "frames", "rigs"];
    file.file_stem().is_some_and(|stem| names.iter().any(|name| stem == *name))
}

/// A camera: size, focal lengths, principal point, lens.
#[derive(Clone, Debug, PartialEq)]
pub struct ColmapCamera {
    /// Width and height in pixels.
    pub size: (u64, u64),
    /// Focal lengths, x and y, in pixels.
    pub focal: [f64; 2],
    /// Principal point in pixels.
    pub principal: [f64; 2],
    /// Its lens.
    pub lens: Lens,
}

/// How many parameters a model has.
fn parameter_count(model: &str) -> Option<usize> {
    Some(match model {
        "EQUIRECTANGULAR" => 2,
        "SIMPLE_PINHOLE" | "SIMPLE_FISHEYE" => 3,
        "PINHOLE" | "SIMPLE_RADIAL" | "SIMPLE_RADIAL_FISHEYE" | "SIMPLE_DIVISION" | "FISHEYE" => 4,
        "RADIAL" | "RADIAL_FISHEYE" | "FOV" | "DIVISION" => 5,
        "EUCM" => 6,
        "OPENCV" | "OPENCV_FISHEYE" => 8,
        "FULL_OPENCV" | "THIN_PRISM_FISHEYE" => 12,
        "RAD_TAN_THIN_PRISM_FISHEYE" => 16,
        _ => return None,
    })
}

/// Whether a model has one focal length for both axes.
fn has_one_focal(model: &str) -> bool {
    model.starts_with("SIMPLE_") || ["RADIAL", "RADIAL_FISHEYE"].contains(&model)
}

fn camera(file: &Path, place: &str, model: &str, size: (u64, u64), p: &[f64]) -> Result<ColmapCamera, SceneError> {
    let expected = parameter_count(model)
        .ok_or_else(|| In(file).field(place, "model", "the name of a camera model", format!("{model:?}")))?;
    if p.len() != expected {
        return Err(In(file).field(place, "params", &format!("{expected} numbers for {model}"), p.len()));
    }
    if model == "EQUIRECTANGULAR" {
        // All around, whatever the parameters: they are width and height again.
        let (w, h) = (size.0 as f64, size.1 as f64);
        let focal = [w / std::f64::consts::TAU, h / std::f64::consts::PI];
        return Ok(ColmapCamera { size, focal, principal: [0.5 * w, 0.5 * h], lens: Lens::Equirectangular });
    }
    let (focal, c) = if has_one_focal(model) { ([p[0], p[0]], 1) } else { ([p[0], p[1]], 2) };
    let k = &p[c + 2..];
    coefficients(file, place, &["distortion"; 12], k)?;
    let lens = match (model, k) {
        ("SIMPLE_RADIAL", &[k1]) => Lens::brown([k1, 0.0, 0.0, 0.0], [0.0; 2]),
        ("RADIAL", &[k1, k2]) => Lens::brown([k1, k2, 0.0, 0.0], [0.0; 2]),
        ("OPENCV", &[k1, k2, p1, p2]) => Lens::brown([k1, k2, 0.0, 0.0], [p1, p2]),
        ("FULL_OPENCV", &[k1, k2, p1, p2, k3, d1, d2, d3]) => {
            Lens::Brown { k: [k1, k2, k3, 0.0], d: [d1, d2, d3], p: [p1, p2] }
        }
        ("SIMPLE_FISHEYE" | "FISHEYE", _) => Lens::Fisheye { k: [0.0; 4] },
        ("SIMPLE_RADIAL_FISHEYE", &[k1]) => Lens::Fisheye { k: [k1, 0.0, 0.0, 0.0] },
        ("RADIAL_FISHEYE", &[k1, k2]) => Lens::Fisheye { k: [k1, k2, 0.0, 0.0] },
        ("OPENCV_FISHEYE", &[k1, k2, k3, k4]) => Lens::Fisheye { k: [k1, k2, k3, k4] },
        ("THIN_PRISM_FISHEYE", &[k1, k2, p1, p2, k3, k4, sx1, sy1]) => {
            Lens::ThinPrism { k: [k1, k2, k3, k4], p: [p1, p2], s: [sx1, sy1] }
        }
        ("RAD_TAN_THIN_PRISM_FISHEYE", &[k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3]) => {
            Lens::Aria { k: [k0, k1, k2, k3, k4, k5], p: [p0, p1], s: [s0, s1, s2, s3] }
        }
        ("SIMPLE_DIVISION" | "DIVISION", &[0.0]) => Lens::Ideal,
        ("SIMPLE_DIVISION" | "DIVISION", &[k]) => Lens::Division { k },
        ("FOV", &[omega]) if omega.abs() < 1e-6 => Lens::Ideal,
        ("FOV", &[omega]) if (0.0..std::f64::consts::PI).contains(&omega) => Lens::Fov { omega },
        ("FOV", &[omega]) => return Err(In(file).field(place, "omega", "an angle from 0 to pi", omega)),
        ("EUCM", &[alpha, beta]) if (0.0..=1.0).contains(&alpha) && beta > 0.0 => Lens::Eucm { alpha, beta },
        ("EUCM", _) => return Err(In(file).field(place, "alpha, beta", "0 to 1, and above 0", format!("{k:?}"))),
        _ => Lens::Ideal,
    };
    Ok(ColmapCamera { size, focal, principal: [p[c], p[c + 1]], lens })
}

fn image(
    file: &Path,
    place: &str,
    id: u32,
    q: [f64; 4],
    t: [f64; 3],
    camera: u32,
    name: String,
) -> Result<ColmapImage, SceneError> {
    let [w, x, y, z] = q;
    let rotation = DQuat::from_xyzw(x, y, z, w);
    let length = rotation.length();
    if !(0.99..=1.01).contains(&length) {
        return Err(In(file).field(place, "QW QX QY QZ", "a unit quaternion", format!("{q:?}")));
    }
    if name.is_empty() {
        return Err(In(file).field(place, "NAME", "a file name", "nothing"));
    }
    Ok(ColmapImage { id, rotation: rotation.normalize(), translation: DVec3::from_array(t), camera, name })
}

/// Reads `cameras.bin`: cameras by number.
pub fn cameras_binary(file: &Path, bytes: &[u8]) -> Result<HashMap<u32, ColmapCamera>, SceneError> {
    let mut bytes = Bytes::new(file, bytes);
    let count = bytes.u64("number of cameras")?;
    let mut cameras = HashMap::new();
    for i in 0..count {
        let place = format!("camera {i}");
        let (id, model) = (bytes.u32(&place)?, bytes.u32(&place)?);
        let size = (bytes.u64(&place)?, bytes.u64(&place)?);
        let model = *MODELS
            .get(model as usize)
            .ok_or_else(|| In(file).field(&place, "model", "the number of a camera model, 0 to 17", model))?;
        let mut parameters = Vec::new();
        for _ in 0..parameter_count(model).unwrap_or(0) {
            parameters.extend(bytes.f64s::<1>(&place)?);
        }
        if cameras.insert(id, camera(file, &place, model, size, &parameters)?).is_some() {
            return Err(In(file).field(&place, "CAMERA_ID", "a number of its own", id));
        }
    }
    bytes.end()?;
    Ok(cameras)
}

/// Reads `images.bin`.
pub fn images_binary(file: &Path, bytes: &[u8]) -> Result<Vec<ColmapImage>, SceneError> {
    let mut bytes = Bytes::new(file, bytes);
    let count = bytes.u64("number of images")?;
    let mut images = Vec::new();
    for i in 0..count {
        let place = format!("image {i}");
        let id = bytes.u32(&place)?;
        let (q, t) = (bytes.f64s(&place)?, bytes.f64s(&place)?);
        let camera = bytes.u32(&place)?;
        let name = bytes.text(&place)?;
        images.push(image(file, &place, id, q, t, camera, name)?);
        let keypoints = bytes.u64(&place)?;
        // x, y and the number of a point: 24 bytes each.
        bytes.take(keypoints.saturating_mul(24), &format!("{place}, its {keypoints} keypoints"))?;
    }
    bytes.end()?;
    Ok(images)
}

/// Reads `cameras.txt`: cameras by number.
pub fn cameras_text(file: &Path, bytes: &[u8]) -> Result<HashMap<u32, ColmapCamera>, SceneError> {
    let mut cameras = HashMap::new();
    for (i, line) in text_of(file, bytes)?.lines().enumerate() {
        let place = format!("line {}", i + 1);
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let mut words = line.split_ascii_whitespace();
        let id = number(file, &place, "CAMERA_ID", words.next())?;
        let model = words.next().unwrap_or("");
        let size = (number(file, &place, "WIDTH", words.next())?, number(file, &place, "HEIGHT", words.next())?);
        let parameters =
            words.map(|w| number(file, &place, "PARAMS", Some(w))).collect::<Result<Vec<f64>, SceneError>>()?;
        if cameras.insert(id, camera(file, &place, model, size, &parameters)?).is_some() {
            return Err(In(file).field(&place, "CAMERA_ID", "a number of its own", id));
        }
    }
    Ok(cameras)
}

/// Reads `images.txt`: two lines for each image, the second (keypoints, maybe empty, or not there at all) passed over.
pub fn images_text(file: &Path, bytes: &[u8]) -> Result<Vec<ColmapImage>, SceneError> {
    let mut images = Vec::new();
    // Whether the last image's keypoints may still come.
    let mut keypoints = false;
    for (i, line) in text_of(file, bytes)?.lines().enumerate() {
        let place = format!("line {}", i + 1);
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            keypoints &= !line.is_empty();
            continue;
        }
        if std::mem::take(&mut keypoints) && are_keypoints(line) {
            continue;
        }
        let mut rest = line;
        let mut word = || {
            let (word, tail) = rest.trim_start().split_once(char::is_whitespace).unwrap_or((rest.trim_start(), ""));
            rest = tail;
            (!word.is_empty()).then_some(word)
        };
        let id = number(file, &place, "IMAGE_ID", word())?;
        let (mut q, mut t) = ([0.0; 4], [0.0; 3]);
        for (v, name) in q.iter_mut().zip(["QW", "QX", "QY", "QZ"]) {
            *v = number(file, &place, name, word())?;
        }
        for (v, name) in t.iter_mut().zip(["TX", "TY", "TZ"]) {
            *v = number(file, &place, name, word())?;
        }
        let camera = number(file, &place, "CAMERA_ID", word())?;
        // The rest of the line: names may contain spaces.
        images.push(image(file, &place, id, q, t, camera, rest.trim().to_owned())?);
        keypoints = true;
    }
    Ok(images)
}

/// Whether a line may be an image's keypoints: x, y and the number of a point, -1 or a whole one, each.
fn are_keypoints(line: &str) -> bool {
    let words: Vec<&str> = line.split_ascii_whitespace().collect();
    let point = |p: &[&str]| p[0].parse::<f64>().is_ok() && p[1].parse::<f64>().is_ok() && p[2].parse::<i64>().is_ok();
    words.len().is_multiple_of(3) && words.chunks_exact(3).all(point)
}

/// Both files of a model in `folder`, binary before text.
fn files(folder: &Path) -> Option<[PathBuf; 2]> {
    ["bin", "txt"]
        .map(|extension| ["cameras", "images"].map(|name| folder.join(format!("{name}.{extension}"))))
        .into_iter()
        .find(|files| files.iter().all(|f| f.is_file()))
}

/// The folder of the model that belongs to a scene: `sparse/0`, `sparse`, or the scene itself. Several numbered models are an
/// error, as COLMAP writes one for each group of photos that it could connect.
pub(super) fn look_for(scene: &Path) -> Result<Option<PathBuf>, SceneError> {
    let sparse = scene.join("sparse");
    let mut numbered = Vec::new();
    for folder in [&sparse, &scene.to_path_buf()].into_iter().filter(|f| f.is_dir()) {
        let number =
            |p: &PathBuf| p.file_name().is_some_and(|n| n.to_string_lossy().bytes().all(|b| b.is_ascii_digit()));
        numbered.extend(super::entries(folder)?.into_iter().filter(|p| number(p) && files(p).is_some()));
    }
    if let [first, second, ..] = numbered.as_slice() {
        return Err(SceneError::Ambiguous {
            folder: scene.into(),
            first: first.display().to_string(),
            second: second.display().to_string(),
            advice: "COLMAP found separate groups of photos; name one of these folders instead".into(),
        });
    }
    Ok(numbered.into_iter().chain([sparse, scene.to_path_buf()]).find(|folder| files(folder).is_some()))
}

/// The scene that a model's folder belongs to: the folder above `sparse`, else its own.
pub(super) fn scene_of(model: &Path) -> &Path {
    let named = |folder: &Path, name: &str| folder.file_name().is_some_and(|n| n == name);
    let above = model.ancestors().take(2).find(|f| named(f, "sparse")).and_then(Path::parent);
    above.unwrap_or(model)
}

/// Reads the model in `folder`. Images are looked for in `images_in`, else in `images` of the scene or beside the model, else in their
/// folders themselves.
pub(super) fn read(folder: &Path, images_in: Option<&Path>) -> Result<Cameras, SceneError> {
    let [cameras_file, images_file] = files(folder).ok_or_else(|| {
        In(folder).malformed("", "expected cameras.bin and images.bin, or cameras.txt and images.txt, in this folder")
    })?;
    let binary = super::has_extension(&cameras_file, &["bin"]);
    let (camera_bytes, image_bytes) = (bytes_of(&cameras_file)?, bytes_of(&images_file)?);
    let (cameras, mut images) = match binary {
        true => (cameras_binary(&cameras_file, &camera_bytes)?, images_binary(&images_file, &image_bytes)?),
        false => (cameras_text(&cameras_file, &camera_bytes)?, images_text(&images_file, &image_bytes)?),
    };
    drop((camera_bytes, image_bytes));
    images.sort_by(|a, b| a.name.cmp(&b.name));
    let disagreement = colmap_frames::disagreement(folder, binary, &images)?;
    let absolute = std::fs::canonicalize(folder).map_err(|e| In(folder).read(e))?;
    let scene = scene_of(&absolute);
    let within: Vec<&Path> = absolute.ancestors().take_while(|f| f.starts_with(scene)).collect();
    let mut folders: Vec<PathBuf> = within.iter().map(|f| f.join("images")).filter(|f| f.is_dir()).collect();
    folders.extend(within.iter().map(|f| f.to_path_buf()));
    if let Some(images) = images_in {
        folders = vec![images.to_path_buf()];
    }
    let mut found = Photos::new(&images_file, folders);
    let mut names = HashSet::new();
    let mut photos = Vec::with_capacity(images.len());
    for i in images {
        let place = format!("image {:?}", i.name);
        let camera = cameras
            .get(&i.camera)
            .ok_or_else(|| In(&images_file).field(&place, "CAMERA_ID", "a camera of the cameras file", i.camera))?;
        if !names.insert(i.name.clone()) {
            return Err(In(&images_file).field(&place, "NAME", "a name of its own", "another image with it"));
        }
        let rotation = DMat3::from_quat(i.rotation);
        let center = -(rotation.transpose() * i.translation);
        let pose = rigid(&images_file, &place, rotation, i.translation, center)?;
        let place = format!("camera {}", i.camera);
        let pixels = pinhole(&cameras_file, &place, camera.size, camera.focal, camera.principal, pose)?;
        let Some(image) = found.find(&i.name)? else { continue };
        let intrinsics = Intrinsics::Pixels(pixels);
        photos.push(Photo { name: i.name, image, mask: None, intrinsics, lens: camera.lens, further: false });
    }
    let mut notes: Vec<Note> = disagreement.into_iter().collect();
    found.finish(&mut notes)?;
    if binary && folder.join("cameras.txt").is_file() {
        let text = format!("{}: the binary files are read, not the text files beside them", folder.display());
        notes.push(Note::dropped(text));
    }
    Ok(Cameras::new(Format::Colmap, photos, vec![cameras_file, images_file], notes))
}
