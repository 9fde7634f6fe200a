//! Plücker coordinates of rays: where each patch of an image looks from and to.

use crate::camera::Camera;
use glam::{DMat3, DVec3};

/// `(o x d, d)` for the center of each patch of a grid over the whole image: `[rows, columns, 6]`; `o` is the camera center and `d` the ray's unit
/// direction, both in the frame that the camera's extrinsics start from. `rows = height`, `columns = width` gives
/// one ray per pixel.
pub fn plucker(camera: &Camera, columns: usize, rows: usize) -> Vec<f32> {
    let (step_x, step_y) = (f64::from(camera.width) / columns as f64, f64::from(camera.height) / rows as f64);
    let world_from_camera = DMat3::from_mat4(camera.world_to_camera).transpose();
    let origin = camera.center();
    let mut out = Vec::with_capacity(rows * columns * 6);
    for i in 0..rows {
        let y = ((i as f64 + 0.5) * step_y - camera.cy) / camera.fy;
        for j in 0..columns {
            let x = ((j as f64 + 0.5) * step_x - camera.cx) / camera.fx;
            let d = (world_from_camera * DVec3::new(x, y, 1.0)).normalize();
            let moment = origin.cross(d);
            out.extend([moment, d].iter().flat_map(|v| v.to_array()).map(|v| v as f32));
        }
    }
    out
}
