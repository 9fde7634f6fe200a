//! Writing `transforms*.json`.

use glam::{DMat4, DVec4};
use serde_json::{Value, json};

use crate::camera::Camera;

/// Frames as NeRF tools and [`Scene::load`](super::Scene::load) read them: each with its own size and intrinsics, in pixels, and a
/// camera-to-world matrix in OpenGL axes (x right, y up, z backward). `frames`: path of the image, relative to the
/// file's folder, and camera.
pub fn transforms_json(frames: &[(String, Camera)]) -> String {
    // From OpenCV's axes to OpenGL's: y and z turn round.
    let flip = DMat4::from_diagonal(DVec4::new(1.0, -1.0, -1.0, 1.0));
    let frames: Vec<Value> = frames
        .iter()
        .map(|(path, c)| {
            let rows = (c.world_to_camera.inverse() * flip).transpose().to_cols_array_2d();
            json!({
                "file_path": path, "w": c.width, "h": c.height,
                "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "transform_matrix": rows,
            })
        })
        .collect();
    format!("{:#}\n", json!({ "camera_model": "PINHOLE", "frames": frames }))
}
