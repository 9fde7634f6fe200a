//! Which way is up.

use glam::{DQuat, DVec3};

/// A right-handed frame, known by how it is turned against the one with +y up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    y_up: DQuat, // from this frame
}

impl Frame {
    /// +z up, as Blender, NeRF datasets and this program have it; `(x, y, z)` there is `(x, z, -y)` with +y up.
    pub const Z_UP: Self = {
        let half = std::f64::consts::FRAC_1_SQRT_2;
        Self { y_up: DQuat::from_xyzw(-half, 0.0, 0.0, half) }
    };
    /// +y up, as in glTF.
    pub const Y_UP: Self = Self { y_up: DQuat::IDENTITY };
    /// -y up, as most programs that train 3D Gaussians on COLMAP's cameras have it: `(x, y, z)` there is `(x, -y, -z)` with +y up.
    pub const Y_DOWN: Self = Self { y_up: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0) };

    /// The frame in which `up` points up, turned the shortest way; none where `up` has no direction.
    pub fn with_up(up: DVec3) -> Option<Self> {
        let up = up.try_normalize()?;
        // Where it points straight down there is no shortest way.
        let opposite = (up + DVec3::Y).length_squared() < 1e-24;
        Some(if opposite { Self::Y_DOWN } else { Self { y_up: DQuat::from_rotation_arc(up, DVec3::Y) } })
    }

    /// The frame that `turn` takes to the one with +y up.
    pub(crate) fn turned_to_y_up(turn: DQuat) -> Self {
        Self { y_up: turn }
    }

    /// The direction of up.
    pub fn up(self) -> DVec3 {
        self.y_up.inverse() * DVec3::Y
    }

    /// The rotation from this frame to `other`.
    pub fn to(self, other: Self) -> DQuat {
        other.y_up.inverse() * self.y_up
    }
}

impl Default for Frame {
    fn default() -> Self {
        Self::Z_UP
    }
}

impl std::str::FromStr for Frame {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "z-up" => Ok(Self::Z_UP),
            "y-up" => Ok(Self::Y_UP),
            "y-down" => Ok(Self::Y_DOWN),
            _ => Err("expected z-up, y-up or y-down".into()),
        }
    }
}

/// From which frame to which files are turned when they are read.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Frames {
    /// The frame of the file's numbers, whatever the file or its format says of them; none: what they say.
    pub from: Option<Frame>,
    /// The frame that Gaussians are turned to. A file that fixes no frame and for which there is no `from` is in it
    /// already. None: that of such a file, else +z up.
    pub to: Option<Frame>,
}

impl Frames {
    /// The frame of the file, which fixes `fixed` or none, and the frame of the result.
    pub(crate) fn resolve(self, fixed: Option<Frame>) -> (Frame, Frame) {
        let to = self.to.unwrap_or_default();
        (self.from.or(fixed).unwrap_or(to), to)
    }
}

impl From<Frame> for Frames {
    fn from(to: Frame) -> Self {
        Self { from: None, to: Some(to) }
    }
}

impl std::str::FromStr for Frames {
    type Err = String;

    /// `FRAME` or `FROM:TO`.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text.split_once(':') {
            Some((from, to)) => Ok(Self { from: Some(from.parse()?), to: Some(to.parse()?) }),
            None => Ok(text.parse::<Frame>()?.into()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_go_where_the_documentation_says() {
        let v = DVec3::new(1.0, 2.0, 3.0);
        assert!((Frame::Z_UP.to(Frame::Y_UP) * v).abs_diff_eq(DVec3::new(1.0, 3.0, -2.0), 1e-15));
        assert!((Frame::Y_DOWN.to(Frame::Y_UP) * v).abs_diff_eq(DVec3::new(1.0, -2.0, -3.0), 1e-15));
        assert!((Frame::Y_UP.to(Frame::Z_UP) * v).abs_diff_eq(DVec3::new(1.0, -3.0, 2.0), 1e-15));
        assert!(Frame::Z_UP.up().abs_diff_eq(DVec3::Z, 1e-15) && Frame::Y_DOWN.up().abs_diff_eq(-DVec3::Y, 1e-15));
        for (up, frame) in [(DVec3::Z, Frame::Z_UP), (DVec3::Y, Frame::Y_UP), (-DVec3::Y, Frame::Y_DOWN)] {
            let found = Frame::with_up(7.0 * up).unwrap();
            assert!((found.to(frame) * v).abs_diff_eq(v, 1e-14));
        }
        let up = DVec3::new(0.2, -0.9, 0.4);
        assert!(Frame::with_up(up).unwrap().up().abs_diff_eq(up.normalize(), 1e-15));
        assert!(Frame::with_up(DVec3::ZERO).is_none() && Frame::with_up(DVec3::NAN).is_none());
    }
}
