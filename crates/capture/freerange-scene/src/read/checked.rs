//! Cameras of numbers that nobody has checked.

use crate::camera::{
    Camera,
    scene::{LARGEST_COORDINATE, nearest_rotation},
};
use crate::{SceneError, decode::LARGEST_SIDE, error::In};
use glam::{DMat3, DMat4, DVec3};
use std::path::Path;

/// A camera in pixels, its numbers checked. `size` is width and height, `focal` and `principal` x and y.
pub(crate) fn pinhole(
    file: &Path,
    place: &str,
    size: (u64, u64),
    focal: [f64; 2],
    principal: [f64; 2],
    world_to_camera: DMat4,
) -> Result<Camera, SceneError> {
    let side = |name: &str, v: u64| match v {
        1..=16384 => Ok(v as u32),
        _ => Err(In(file).field(place, name, &format!("a whole number from 1 to {LARGEST_SIDE}"), v)),
    };
    let (width, height) = (side("width", size.0)?, side("height", size.1)?);
    for (i, (name, side)) in [("focal length", width), ("focal length", height)].into_iter().enumerate() {
        let side = f64::from(side);
        if !(1e-2 * side..=1e3 * side).contains(&focal[i]) {
            let expected = format!("between 0.01 and 1000 times the image's {side} pixels");
            return Err(In(file).field(place, name, &expected, focal[i]));
        }
        if !(-side..=2.0 * side).contains(&principal[i]) {
            let expected = format!("a point near the image's {side} pixels");
            return Err(In(file).field(place, ["cx", "cy"][i], &expected, principal[i]));
        }
    }
    Ok(Camera { width, height, fx: focal[0], fy: focal[1], cx: principal[0], cy: principal[1], world_to_camera })
}

/// World to camera from the camera's axes (columns: right, down, forward, in world coordinates) and its center.
pub(crate) fn world_to_camera(file: &Path, place: &str, axes: DMat3, center: DVec3) -> Result<DMat4, SceneError> {
    let rotation = nearest_rotation(axes)
        .map_err(|found| In(file).field(place, "rotation", "a rotation matrix", found))?
        .transpose();
    rigid(file, place, rotation, -(rotation * center), center)
}

/// World to camera from its rotation and translation; `center` is the camera's.
pub(crate) fn rigid(
    file: &Path,
    place: &str,
    rotation: DMat3,
    translation: DVec3,
    center: DVec3,
) -> Result<DMat4, SceneError> {
    if !(center.abs().max_element() <= LARGEST_COORDINATE && translation.is_finite()) {
        let expected = format!("a camera within {LARGEST_COORDINATE} of the origin");
        return Err(In(file).field(place, "position", &expected, center));
    }
    Ok(DMat4::from_cols(
        rotation.x_axis.extend(0.0),
        rotation.y_axis.extend(0.0),
        rotation.z_axis.extend(0.0),
        translation.extend(1.0),
    ))
}

/// Distortion coefficients that a lens can have; those far beyond are errors of reading.
pub(crate) fn coefficients(file: &Path, place: &str, names: &[&str], values: &[f64]) -> Result<(), SceneError> {
    match names.iter().zip(values).find(|(_, v)| v.is_nan() || v.abs() > 100.0) {
        Some((name, v)) => Err(In(file).field(place, name, "a distortion coefficient between -100 and 100", v)),
        None => Ok(()),
    }
}
