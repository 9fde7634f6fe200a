//! Cameras far from the origin: an origin among them is subtracted while numbers still have 64 bits.

use super::Cameras;
use crate::estimate::Hints;
use freerange_util::Note;
use glam::{DMat3, DMat4, DVec3};

/// Distance of the cameras from the origin, in units of how far apart they are, from which another origin is taken. Numbers of 32 bits
/// resolve a hundred-thousandth of the scene there.
const FAR: f64 = 100.0;

impl Cameras {
    /// Subtracts an origin in the cameras' middle where they lie far from the frame's own.
    pub(super) fn settle_origin(&mut self) {
        let centers: Vec<DVec3> = self.photos.iter().map(|p| center(&p.intrinsics.world_to_camera())).collect();
        let middle = centers.iter().sum::<DVec3>() / centers.len().max(1) as f64;
        let spread = centers.iter().map(|c| c.distance(middle)).fold(0.0, f64::max);
        let far = spread > 0.0 && middle.length() > FAR * spread;
        if !far {
            return;
        }
        // In round numbers: a power of ten not above how far the cameras are apart.
        let step = 10f64.powf(spread.log10().floor());
        let origin = (middle / step).round() * step;
        self.subtract(origin);
        let [x, y, z] = origin.to_array();
        self.notes.push(Note::changed(format!(
            "the cameras lie far from the origin, where numbers of 32 bits do not resolve the object: results are relative to ({x}, {y}, {z})"
        )));
    }

    /// What is known beforehand, relative to the origin.
    pub fn local(&self, hints: Hints) -> Hints {
        Hints { center: hints.center.map(|c| c - self.origin), ..hints }
    }

    /// Makes all positions relative to `origin`, which is in the scene's frame, whatever they were relative to.
    pub fn subtract(&mut self, origin: DVec3) {
        let shift = origin - self.origin;
        for photo in &mut self.photos {
            let pose = photo.intrinsics.world_to_camera_mut();
            let moved = pose.w_axis.truncate() + DMat3::from_mat4(*pose) * shift;
            *pose = DMat4::from_cols(pose.x_axis, pose.y_axis, pose.z_axis, moved.extend(1.0));
        }
        self.origin = origin;
    }
}

fn center(world_to_camera: &DMat4) -> DVec3 {
    -(DMat3::from_mat4(*world_to_camera).transpose() * world_to_camera.w_axis.truncate())
}
