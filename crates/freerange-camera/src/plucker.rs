//! Plücker coordinates of rays: where each patch of an image looks from and to.

use crate::Camera;
use glam::{DMat3, DVec3};

/// Where the centres of a grid of patches lie in the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub enum PatchLayout {
    /// The grid covers the whole image: centres at `((j + 0.5) W / columns, (i + 0.5) H / rows)`.
    Scaled,
    /// Patches of so many pixels from the top left, as a convolution with that stride sees them: centres at
    /// `((j + 0.5) size, (i + 0.5) size)`. Equal to `Scaled` where the patches fill the image.
    Stride(u32),
}

/// `(o x d, d)` for each patch centre: `[rows, columns, 6]`; `o` is the camera centre and `d` the ray's unit
/// direction, both in the frame that the camera's extrinsics start from. `rows = height`, `columns = width` gives
/// one ray per pixel.
pub fn plucker(camera: &Camera, columns: usize, rows: usize, layout: PatchLayout) -> Vec<f32> {
    let (step_x, step_y) = match layout {
        PatchLayout::Scaled => (f64::from(camera.width) / columns as f64, f64::from(camera.height) / rows as f64),
        PatchLayout::Stride(size) => (f64::from(size), f64::from(size)),
    };
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
