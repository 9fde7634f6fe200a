//! COLMAP's sparse model out: views and colored points, binary, as COLMAP, nerfstudio, gsplat and others read them.

use crate::SceneError;
use crate::camera::View;
use freerange_util::{IoError, write_atomically};
use glam::{DMat3, DQuat, DVec3};
use std::{io::Write, path::Path};

/// COLMAP's number of the camera model PINHOLE.
const PINHOLE: u32 = 1;

/// Writes `sparse/0/cameras.bin`, `images.bin`, `points3D.bin` and `images/NAME.png` into `folder`: each view with a pinhole of its own, and
/// `points` (place, color) that belong to no photo. `origin` is added to all positions, which are written in 64 bits.
pub fn write_colmap(
    folder: &Path,
    views: &[View],
    origin: DVec3,
    points: &[(DVec3, [u8; 3])],
) -> Result<(), SceneError> {
    let model = folder.join("sparse/0");
    let made = |path: &Path| std::fs::create_dir_all(path).map_err(|e| SceneError::Write(IoError::at(path)(e)));
    made(&model)?;
    let mut cameras = (views.len() as u64).to_le_bytes().to_vec();
    let mut images = cameras.clone();
    for (id, view) in (1u32..).zip(views) {
        let c = &view.camera;
        cameras.extend([id, PINHOLE].iter().flat_map(|v| v.to_le_bytes()));
        cameras.extend([u64::from(c.width), u64::from(c.height)].iter().flat_map(|v| v.to_le_bytes()));
        cameras.extend([c.fx, c.fy, c.cx, c.cy].iter().flat_map(|v| v.to_le_bytes()));
        let name = format!("{}.png", view.name);
        let rotation = DMat3::from_mat4(c.world_to_camera);
        let q = DQuat::from_mat3(&rotation).normalize();
        let t = c.world_to_camera.w_axis.truncate() - rotation * origin;
        images.extend(id.to_le_bytes());
        images.extend([q.w, q.x, q.y, q.z, t.x, t.y, t.z].iter().flat_map(|v| v.to_le_bytes()));
        images.extend(id.to_le_bytes());
        images.extend(name.as_bytes());
        images.push(0);
        // No keypoints.
        images.extend(0u64.to_le_bytes());
        let path = folder.join("images").join(&name);
        made(path.parent().unwrap_or(folder))?;
        let file = std::fs::File::create(&path).map_err(|e| SceneError::Write(IoError::at(&path)(e)))?;
        view.image
            .write_to(&mut std::io::BufWriter::new(file), image::ImageFormat::Png)
            .map_err(|e| SceneError::Write(IoError::at(&path)(std::io::Error::other(e))))?;
    }
    let mut bytes = (points.len() as u64).to_le_bytes().to_vec();
    for (id, (place, color)) in (1u64..).zip(points) {
        bytes.extend(id.to_le_bytes());
        bytes.extend((*place + origin).to_array().iter().flat_map(|v| v.to_le_bytes()));
        bytes.extend(color);
        // No reprojection error.
        bytes.extend(0f64.to_le_bytes());
        // No track.
        bytes.extend(0u64.to_le_bytes());
    }
    for (name, bytes) in [("cameras.bin", cameras), ("images.bin", images), ("points3D.bin", bytes)] {
        let path = model.join(name);
        write_atomically(&path, |w| w.write_all(&bytes)).map_err(|e| SceneError::Write(IoError::at(&path)(e)))?;
    }
    Ok(())
}
