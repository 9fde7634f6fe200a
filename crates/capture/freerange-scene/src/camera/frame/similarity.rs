//! Similarity transforms: how one frame's lengths, axes and origin map to another's.

use crate::camera::Camera;
use glam::{DMat3, DMat4, DQuat, DVec3};

/// `x -> scale * rotation * x + translation`, `scale > 0`.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Similarity {
    /// Factor on all lengths.
    pub scale: f64,
    /// Unit quaternion.
    pub rotation: DQuat,
    /// Added last, in the target frame's lengths.
    pub translation: DVec3,
}

impl Similarity {
    /// The transform that changes nothing.
    pub const IDENTITY: Self = Self { scale: 1.0, rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// Maps a point.
    pub fn apply(&self, point: DVec3) -> DVec3 {
        self.scale * (self.rotation * point) + self.translation
    }

    /// The transform back.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        let scale = 1.0 / self.scale;
        Self { scale, rotation, translation: -scale * (rotation * self.translation) }
    }

    /// First `inner`, then `self`.
    pub fn after(&self, inner: &Self) -> Self {
        let rotation = (self.rotation * inner.rotation).normalize();
        Self { scale: self.scale * inner.scale, rotation, translation: self.apply(inner.translation) }
    }

    /// As a 4x4 matrix on homogeneous points.
    pub fn to_matrix(&self) -> DMat4 {
        DMat4::from_scale_rotation_translation(DVec3::splat(self.scale), self.rotation, self.translation)
    }
}

impl Camera {
    /// The same camera in another frame: it sees every mapped point at the same pixel, and depths are multiplied by
    /// `to_new.scale`. The world-to-camera transform stays rigid.
    pub fn transformed(&self, to_new: &Similarity) -> Self {
        let back = DMat3::from_quat(to_new.rotation.inverse());
        let rotation = DMat3::from_mat4(self.world_to_camera) * back;
        let old = self.world_to_camera.w_axis.truncate();
        let translation = to_new.scale * old - rotation * to_new.translation;
        let world_to_camera = DMat4::from_cols(
            rotation.x_axis.extend(0.0),
            rotation.y_axis.extend(0.0),
            rotation.z_axis.extend(0.0),
            translation.extend(1.0),
        );
        Self { world_to_camera, ..*self }
    }
}
