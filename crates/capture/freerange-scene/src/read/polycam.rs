//! Polycam's raw export: `keyframes/images` and one JSON file for each in `keyframes/cameras`, or both with `corrected_` before.
//!
//! `t_00` to `t_23` are camera to world, three rows of four, with OpenGL's camera axes and ARKit's world (y up). The world becomes z up,
//! as nerfstudio makes it: x, y, z here are z, x, y there.

use super::{Cameras, Format, Intrinsics, Photo, Photos, bytes_of, entries, has_extension, pinhole, world_to_camera};
use crate::camera::{Camera, Lens};
use crate::{SceneError, error::In};
use freerange_util::Note;
use glam::{DMat3, DVec3};
use serde_json::{Map, Value};
use std::path::{Path, PathBuf};

/// The folder with `cameras`: the scene or its `keyframes`.
pub(super) fn look_for(scene: &Path) -> Option<PathBuf> {
    let holds = |folder: &PathBuf| ["corrected_cameras", "cameras"].iter().any(|n| folder.join(n).is_dir());
    [scene.join("keyframes"), scene.to_path_buf()].into_iter().find(holds)
}

/// The camera of one JSON file; `size`: of its image, where the file does not say it.
pub fn camera(file: &Path, bytes: &[u8], size: Option<(u32, u32)>) -> Result<Camera, SceneError> {
    let root = object(file, bytes)?;
    camera_of(file, &root, size.filter(|_| !has_size(&root)))
}

fn object(file: &Path, bytes: &[u8]) -> Result<Map<String, Value>, SceneError> {
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    match serde_json::from_slice(bytes).map_err(|e| In(file).malformed("", format!("not JSON: {e}")))? {
        Value::Object(root) => Ok(root),
        _ => Err(In(file).malformed("", "expected an object")),
    }
}

/// Whether a file says how large its image is.
fn has_size(root: &Map<String, Value>) -> bool {
    root.contains_key("width") || root.contains_key("height")
}

/// The camera of a file; `size`: of its image, none where the file says it.
fn camera_of(file: &Path, root: &Map<String, Value>, size: Option<(u32, u32)>) -> Result<Camera, SceneError> {
    let number = |name: &str| finite(file, root, name);
    let side = |name: &str| match number(name)? {
        v if v.fract() == 0.0 && v > 0.0 => Ok(v as u64),
        v => Err(In(file).field("", name, "a whole number of pixels", v)),
    };
    let row = |i: usize| -> Result<[f64; 4], SceneError> {
        let mut row = [0.0; 4];
        for (j, v) in row.iter_mut().enumerate() {
            *v = number(&format!("t_{i}{j}"))?;
        }
        Ok(row)
    };
    let rows = [row(2)?, row(0)?, row(1)?];
    let column = |j: usize| DVec3::new(rows[0][j], rows[1][j], rows[2][j]);
    let pose = world_to_camera(file, "", DMat3::from_cols(column(0), -column(1), -column(2)), column(3))?;
    let size = match size {
        Some((width, height)) => (width.into(), height.into()),
        None => (side("width")?, side("height")?),
    };
    pinhole(file, "", size, [number("fx")?, number("fy")?], [number("cx")?, number("cy")?], pose)
}

fn finite(file: &Path, root: &Map<String, Value>, name: &str) -> Result<f64, SceneError> {
    match root.get(name) {
        Some(v) => v.as_f64().filter(|v| v.is_finite()).ok_or_else(|| In(file).field("", name, "a number", v)),
        None => Err(In(file).field("", name, "a number", "nothing")),
    }
}

pub(super) fn read(folder: &Path, images_in: Option<&Path>) -> Result<Cameras, SceneError> {
    let corrected = folder.join("corrected_cameras").is_dir();
    let (cameras, images) = match corrected {
        true => (folder.join("corrected_cameras"), folder.join("corrected_images")),
        false => (folder.join("cameras"), folder.join("images")),
    };
    let images = images_in.map_or(images, Path::to_path_buf);
    let mut photos = Vec::new();
    let mut found = Photos::new(&cameras, vec![images]);
    for file in entries(&cameras)?.into_iter().filter(|f| has_extension(f, &["json"])) {
        let bytes = bytes_of(&file)?;
        let name = file.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let Some(image) = found.find(&name)? else { continue };
        let root = object(&file, &bytes)?;
        let size = if has_size(&root) { None } else { Some(found.size_for_camera(&name, &image)?) };
        let intrinsics = Intrinsics::Pixels(camera_of(&file, &root, size)?);
        photos.push(Photo { name, image, mask: None, intrinsics, lens: Lens::Ideal, further: false });
    }
    let mut notes = vec![Note::understood("Polycam's world is turned to z up: x, y, z are its z, x, y")];
    found.finish(&mut notes)?;
    if corrected && folder.join("cameras").is_dir() {
        notes.push(Note::dropped("Polycam's corrected cameras and images are read, not the original ones beside them"));
    }
    Ok(Cameras::new(Format::Polycam, photos, vec![cameras], notes))
}
