//! Where a scene puts Gaussians: similarities, since ellipsoids have perpendicular axes.

use glam::{DMat3, DMat4, DQuat, DVec3};

/// `x -> scale * rotation * x + translation`.
#[derive(Clone, Copy)]
pub struct Similarity {
    pub scale: f64,
    pub rotation: DQuat,
    pub translation: DVec3,
}

/// What messages call it.
pub const EXPECTED: &str =
    "rotation, translation and the same positive scale along all axes, since Gaussians have perpendicular axes";

impl Similarity {
    pub const NONE: Self = Self { scale: 1.0, rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// None of a matrix that stretches, shears or mirrors, or is not finite.
    pub fn from_matrix(matrix: DMat4) -> Option<Self> {
        let (axes, translation) = (DMat3::from_mat4(matrix), matrix.w_axis.truncate());
        let scale = axes.determinant().cbrt();
        let rotation = axes * scale.recip();
        let defect = (rotation.transpose() * rotation - DMat3::IDENTITY).to_cols_array();
        // Phrased so that what is not a number fails, too.
        let good = scale > 0.0 && defect.iter().all(|d| d.abs() < 1e-4) && translation.is_finite();
        good.then(|| Self { scale, rotation: DQuat::from_mat3(&rotation).normalize(), translation })
    }

    /// `inner`, and then this.
    pub fn after(&self, inner: &Self) -> Self {
        Self {
            scale: self.scale * inner.scale,
            rotation: self.rotation * inner.rotation,
            translation: self.apply(inner.translation),
        }
    }

    pub fn apply(&self, point: DVec3) -> DVec3 {
        self.scale * (self.rotation * point) + self.translation
    }
}
