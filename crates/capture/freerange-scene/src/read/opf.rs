//! Pix4D's Open Photogrammetry Format: `project.opf`, which names `calibrated_cameras.json`, `camera_list.json` and
//! `input_cameras.json`.
//!
//! Orientations are omega, phi, kappa in degrees, `R_x(omega) R_y(phi) R_z(kappa)` from a camera's axes (right, up, back) to the processing
//! frame; positions are in that frame, in which results are, before its shift to the ground. Only the input cameras say
//! how large images are. Without them each is taken to be as large as its file.

use super::{Cameras, Format, Photo, Photos, bytes_of, coefficients, pinhole, world_to_camera};
use crate::camera::Lens;
use crate::{SceneError, error::In, read::Intrinsics};
use freerange_util::Note;
use glam::{DMat3, DVec3};
use serde_json::Value;
use std::{
    collections::HashMap,
    path::{Path, PathBuf},
};

const CALIBRATED: &str = "application/opf-calibrated-cameras+json";
const LIST: &str = "application/opf-camera-list+json";
const INPUT: &str = "application/opf-input-cameras+json";

/// Whether a file's beginning looks like one of these.
pub(super) fn is_one(start: &[u8]) -> bool {
    String::from_utf8_lossy(start).contains("application/opf-project+json")
}

/// A camera of `calibrated_cameras.json`.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibrated {
    /// Its number, by which the list names its file.
    pub id: u64,
    /// The number of its sensor, whose size the input cameras have.
    pub sensor: u64,
    /// Focal length in pixels.
    pub focal: f64,
    /// Principal point in pixels.
    pub principal: [f64; 2],
    /// Its lens.
    pub lens: Lens,
    /// Right, down and forward in the world, as columns.
    pub axes: DMat3,
    /// Where it stands.
    pub center: DVec3,
}

fn json(file: &Path, bytes: &[u8]) -> Result<Value, SceneError> {
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    serde_json::from_slice(bytes).map_err(|e| In(file).malformed("", format!("not JSON: {e}")))
}

fn list<'a>(file: &Path, root: &'a Value, name: &str) -> Result<&'a Vec<Value>, SceneError> {
    root[name].as_array().ok_or_else(|| In(file).field("", name, "a list", &root[name]))
}

fn id(file: &Path, place: &str, value: &Value, name: &str) -> Result<u64, SceneError> {
    value[name].as_u64().ok_or_else(|| In(file).field(place, name, "a whole number", &value[name]))
}

fn numbers<const N: usize>(file: &Path, place: &str, value: &Value, name: &str) -> Result<[f64; N], SceneError> {
    let found = value[name].as_array().filter(|list| list.len() == N);
    let found =
        found.and_then(|list| list.iter().map(|v| v.as_f64().filter(|v| v.is_finite())).collect::<Option<Vec<_>>>());
    let found = found.and_then(|list| <[f64; N]>::try_from(list).ok());
    found.ok_or_else(|| In(file).field(place, name, &format!("{N} numbers"), &value[name]))
}

/// Reads `calibrated_cameras.json`.
pub fn calibrated(file: &Path, bytes: &[u8]) -> Result<Vec<Calibrated>, SceneError> {
    let root = json(file, bytes)?;
    let mut sensors = HashMap::new();
    for (i, sensor) in list(file, &root, "sensors")?.iter().enumerate() {
        let place = format!("sensor {i}");
        sensors.insert(id(file, &place, sensor, "id")?, (&sensor["internals"], place));
    }
    let mut cameras = Vec::new();
    for (i, camera) in list(file, &root, "cameras")?.iter().enumerate() {
        let place = format!("camera {i}");
        let sensor = id(file, &place, camera, "sensor_id")?;
        let (internals, sensor_place) =
            sensors.get(&sensor).ok_or_else(|| In(file).field(&place, "sensor_id", "the id of a sensor", sensor))?;
        match internals["type"].as_str() {
            Some("perspective") => {}
            Some(kind @ ("fisheye" | "spherical")) => {
                return Err(In(file).unsupported(
                    sensor_place,
                    format!("the sensor type {kind}"),
                    "undistort the photos first",
                ));
            }
            _ => return Err(In(file).field(sensor_place, "type", "perspective", &internals["type"])),
        }
        let k: [f64; 3] = numbers(file, sensor_place, internals, "radial_distortion")?;
        let p: [f64; 2] = numbers(file, sensor_place, internals, "tangential_distortion")?;
        coefficients(file, sensor_place, &["radial_distortion"; 3], &k)?;
        coefficients(file, sensor_place, &["tangential_distortion"; 2], &p)?;
        let focal = internals["focal_length_px"].as_f64().filter(|f| *f > 0.0);
        let focal = focal.ok_or_else(|| {
            In(file).field(sensor_place, "focal_length_px", "a number above 0", &internals["focal_length_px"])
        })?;
        let [omega, phi, kappa] = numbers::<3>(file, &place, camera, "orientation_deg")?.map(f64::to_radians);
        let turned = DMat3::from_rotation_x(omega) * DMat3::from_rotation_y(phi) * DMat3::from_rotation_z(kappa);
        cameras.push(Calibrated {
            id: id(file, &place, camera, "id")?,
            sensor,
            focal,
            principal: numbers(file, sensor_place, internals, "principal_point_px")?,
            lens: Lens::brown([k[0], k[1], k[2], 0.0], p),
            axes: DMat3::from_cols(turned.x_axis, -turned.y_axis, -turned.z_axis),
            center: DVec3::from_array(numbers(file, &place, camera, "position")?),
        });
    }
    Ok(cameras)
}

/// The path that a URI means: `file://` and escapes taken away. What is no valid URI stays as it is.
fn path_of(uri: &str) -> String {
    let uri = uri.strip_prefix("file://").unwrap_or(uri);
    let (mut bytes, mut rest) = (Vec::with_capacity(uri.len()), uri.as_bytes());
    while let [first, tail @ ..] = rest {
        let digit = |i: usize| tail.get(i).and_then(|d| char::from(*d).to_digit(16));
        match digit(0).zip(digit(1)).filter(|_| *first == b'%') {
            Some((high, low)) => {
                bytes.push((16 * high + low) as u8);
                rest = &tail[2..];
            }
            None => {
                bytes.push(*first);
                rest = tail;
            }
        }
    }
    String::from_utf8(bytes).unwrap_or_else(|_| uri.to_owned())
}

/// Reads `camera_list.json`: the URI of each camera's image, by the camera's number.
pub fn uris(file: &Path, bytes: &[u8]) -> Result<HashMap<u64, String>, SceneError> {
    let root = json(file, bytes)?;
    let mut uris = HashMap::new();
    for (i, camera) in list(file, &root, "cameras")?.iter().enumerate() {
        let place = format!("camera {i}");
        let uri = camera["uri"].as_str().ok_or_else(|| In(file).field(&place, "uri", "a path", &camera["uri"]))?;
        let number = id(file, &place, camera, "id")?;
        if uris.insert(number, uri.to_owned()).is_some() {
            return Err(In(file).field(&place, "id", "a number of its own", number));
        }
    }
    Ok(uris)
}

/// Reads `input_cameras.json`: width and height of each sensor's images in pixels, by the sensor's number.
pub fn sizes(file: &Path, bytes: &[u8]) -> Result<HashMap<u64, (u64, u64)>, SceneError> {
    let root = json(file, bytes)?;
    let mut sizes = HashMap::new();
    for (i, sensor) in list(file, &root, "sensors")?.iter().enumerate() {
        let (place, name) = (format!("sensor {i}"), "image_size_px");
        let side = |k: usize| sensor[name][k].as_u64().filter(|side| *side > 0);
        let (Some(width), Some(height), 2) = (side(0), side(1), sensor[name].as_array().map_or(0, Vec::len)) else {
            return Err(In(file).field(&place, name, "2 whole numbers above 0", &sensor[name]));
        };
        let number = id(file, &place, sensor, "id")?;
        if sizes.insert(number, (width, height)).is_some() {
            return Err(In(file).field(&place, "id", "a number of its own", number));
        }
    }
    Ok(sizes)
}

/// The input cameras that `project.opf` names, where it names some and they are in its folder.
pub fn input_cameras(file: &Path, bytes: &[u8]) -> Result<Option<PathBuf>, SceneError> {
    let root = json(file, bytes)?;
    Ok(resource(file, &root, INPUT).ok().filter(|input| input.is_file()))
}

/// Reads `project.opf`: its calibrated cameras and its list of cameras, both in its folder.
pub fn project(file: &Path, bytes: &[u8]) -> Result<[PathBuf; 2], SceneError> {
    let root = json(file, bytes)?;
    Ok([resource(file, &root, CALIBRATED)?, resource(file, &root, LIST)?])
}

/// The file of this kind that a project names, relative to it.
fn resource(project: &Path, root: &Value, kind: &str) -> Result<PathBuf, SceneError> {
    let items = list(project, root, "items")?.iter();
    let resources = items.filter_map(|item| item["resources"].as_array()).flatten();
    let mut named = resources.filter(|r| r["format"].as_str() == Some(kind)).filter_map(|r| r["uri"].as_str());
    let (Some(uri), None) = (named.next(), named.next()) else {
        return Err(In(project).field("items", kind, "one resource of this format", "none, or several"));
    };
    let folder = project.parent().unwrap_or(Path::new(""));
    super::inside(folder, &path_of(uri))
        .ok_or_else(|| In(project).field("items", "uri", "a file beside the project", uri))
}

pub(super) fn read(file: &Path, images: Option<&Path>) -> Result<Cameras, SceneError> {
    let bytes = bytes_of(file)?;
    let [cameras_file, list_file] = project(file, &bytes)?;
    let input_file = input_cameras(file, &bytes)?;
    let sizes = match &input_file {
        Some(input) => sizes(input, &bytes_of(input)?)?,
        None => HashMap::new(),
    };
    let uris = uris(&list_file, &bytes_of(&list_file)?)?;
    let mut found = Photos::beside(file, images);
    let mut photos = Vec::new();
    for (i, camera) in calibrated(&cameras_file, &bytes_of(&cameras_file)?)?.into_iter().enumerate() {
        let place = format!("camera {i}");
        let Some(uri) = uris.get(&camera.id) else {
            return Err(In(&list_file).field("", "cameras", &format!("a file for camera {}", camera.id), "none"));
        };
        let name = path_of(uri);
        let Some(image) = found.find(&name)? else { continue };
        let size = match sizes.get(&camera.sensor) {
            Some(size) => *size,
            None => found.size_for_camera(&name, &image).map(|(w, h)| (w.into(), h.into()))?,
        };
        let pose = world_to_camera(&cameras_file, &place, camera.axes, camera.center)?;
        let pinhole = pinhole(&cameras_file, &place, size, [camera.focal; 2], camera.principal, pose)?;
        let (intrinsics, lens) = (Intrinsics::Pixels(pinhole), camera.lens);
        photos.push(Photo { name, image, mask: None, intrinsics, lens, further: false });
    }
    let mut notes =
        vec![Note::understood("results are in the project's processing frame, before its shift to the ground")];
    found.finish(&mut notes)?;
    let files = [Some(file.to_path_buf()), Some(cameras_file), Some(list_file), input_file];
    Ok(Cameras::new(Format::Opf, photos, files.into_iter().flatten().collect(), notes))
}
