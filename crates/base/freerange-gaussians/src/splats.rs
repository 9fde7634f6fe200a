//! Gaussians with all that files keep of them.

use glam::{DMat3, DQuat, DVec3};

use crate::{Gaussians, Harmonics, channel};

/// How Gaussians were drawn when they were fitted, and are to be drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum RenderMode {
    /// As 3D Gaussian splatting: every Gaussian is blurred by 0.3 square pixels.
    #[default]
    Default,
    /// As Mip-Splatting ("antialiased"): blurred by 0.1 square pixels, and its opacity lowered in return.
    Mip,
    /// Flat Gaussians (2D Gaussian splatting): the third standard deviation is next to nothing.
    Flat,
}

/// Gaussians, their spherical harmonics, where they lie, and how they are to be drawn.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Splats {
    /// The 14 channels; positions are relative to `origin`.
    pub cloud: Gaussians,
    /// Color that depends on the viewing direction, of as many Gaussians, or of degree 0.
    pub harmonics: Harmonics,
    /// How they are to be drawn.
    pub mode: RenderMode,
    /// What positions are relative to: zero but for objects so far away that 32 bits cannot hold their shape.
    pub origin: DVec3,
}

impl From<Gaussians> for Splats {
    fn from(cloud: Gaussians) -> Self {
        Self { cloud, ..Self::default() }
    }
}

/// Positions this many times farther from the origin than they are spread lose visible precision in 32 bits.
const FAR: f64 = 2000.0;

impl Splats {
    /// The Gaussians at `indices`, in that order.
    ///
    /// # Panics
    /// If an index lies outside the cloud.
    pub fn select(&self, indices: &[usize]) -> Self {
        let indices = || indices.iter().copied();
        Self { cloud: self.cloud.select(indices()), harmonics: self.harmonics.select(indices()), ..*self }
    }

    /// Moves everything by the similarity `x -> scale * rotation * x + translation`, harmonics with it.
    ///
    /// # Panics
    /// As [`Gaussians::transform`].
    pub fn transform(&mut self, scale: f64, rotation: DQuat, translation: DVec3) {
        if self.origin == DVec3::ZERO {
            self.cloud.transform(scale, rotation, translation);
        } else {
            self.cloud.transform(scale, rotation, DVec3::ZERO);
            self.origin = scale * (rotation.normalize() * self.origin) + translation;
        }
        self.harmonics.turn(DMat3::from_quat(rotation.normalize()));
    }

    /// Mirrors everything at the origin: `x -> -x`.
    pub fn invert(&mut self) {
        self.cloud.iter_mut().flat_map(|row| &mut row[channel::MEAN]).for_each(|v| *v = -*v);
        self.origin = -self.origin;
        self.harmonics.turn(-DMat3::IDENTITY);
    }

    /// Sets positions, in the order of the Gaussians; where they lie far from the origin for their size, it moves near
    /// them.
    ///
    /// # Panics
    /// If there are not as many as Gaussians.
    pub fn place(&mut self, positions: &[DVec3]) {
        assert_eq!(positions.len(), self.cloud.len(), "a position for each Gaussian");
        self.origin = origin_for(positions);
        for (row, p) in self.cloud.iter_mut().zip(positions) {
            row[channel::MEAN].copy_from_slice(&(*p - self.origin).as_vec3().to_array());
        }
    }

    /// Position of Gaussian `i`, in world units.
    pub fn position(&self, i: usize) -> DVec3 {
        self.origin + self.cloud.mean(i)
    }

    /// The channels, with positions in world units, rounded to 32 bits.
    pub fn into_cloud(self) -> Gaussians {
        let positions: Vec<DVec3> = (0..self.cloud.len()).map(|i| self.position(i)).collect();
        let mut cloud = self.cloud;
        for (row, p) in cloud.iter_mut().zip(positions) {
            row[channel::MEAN].copy_from_slice(&p.as_vec3().to_array());
        }
        cloud
    }

    /// The Gaussians as seen from `eye` (in world units): colors are those of this direction, at least 0 where they
    /// depend on it.
    pub fn seen_from(&self, eye: DVec3) -> Gaussians {
        let mut cloud = self.cloud.clone();
        if self.harmonics.degree() > 0 {
            let eye = eye - self.origin;
            for (i, row) in cloud.iter_mut().enumerate() {
                let direction = (self.cloud.mean(i) - eye).normalize_or_zero();
                let color = (self.cloud.color(i) + self.harmonics.color(i, direction)).max(DVec3::ZERO);
                row[channel::COLOR].copy_from_slice(&color.as_vec3().to_array());
            }
        }
        cloud
    }

    /// These and then `other`, whose harmonics are cut or filled up to the higher degree of both.
    pub fn append(&mut self, other: &Self) {
        let (n, m) = (self.cloud.len(), other.cloud.len());
        let degree = self.harmonics.degree().max(other.harmonics.degree());
        let harmonics = [self.harmonics.with_degree(degree, n), other.harmonics.with_degree(degree, m)];
        let positions: Vec<DVec3> = (0..n).map(|i| self.position(i)).chain((0..m).map(|i| other.position(i))).collect();
        self.harmonics = Harmonics::from_rows(degree, harmonics.map(|h| h.rows().to_vec()).concat());
        other.cloud.iter().for_each(|row| self.cloud.push(row));
        if (self.origin, other.origin) != (DVec3::ZERO, DVec3::ZERO) {
            self.place(&positions);
        }
    }
}

/// Zero, or whole numbers near the middle of `positions`.
fn origin_for(positions: &[DVec3]) -> DVec3 {
    let median = |values: &mut Vec<f64>| {
        let middle = values.len() / 2;
        *values.select_nth_unstable_by(middle, f64::total_cmp).1
    };
    if positions.is_empty() {
        return DVec3::ZERO;
    }
    // Medians: a few stray Gaussians change nothing.
    let center = DVec3::from_array([0, 1, 2].map(|k| median(&mut positions.iter().map(|p| p[k]).collect())));
    let spread = median(&mut positions.iter().map(|p| p.distance(center)).collect());
    if center.is_finite() && center.length() > FAR * spread && center.length() > FAR {
        center.round()
    } else {
        DVec3::ZERO
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::harmonics::coefficients;

    fn example(n: usize) -> Splats {
        let wave = |n: usize| (0..n).map(|v| (v as f32 * 0.7).sin()).collect::<Vec<_>>();
        let harmonics = Harmonics::from_rows(2, wave(n * 3 * coefficients(2)));
        Splats { cloud: Gaussians::from_rows(wave(n * channel::COUNT)), harmonics, ..Splats::default() }
    }

    #[test]
    fn far_objects_keep_their_shape() {
        let near = example(30);
        let far = DVec3::new(-3_959_505.25, 3_699_979.5, 12.125);
        let mut splats = near.clone();
        splats.place(&(0..30).map(|i| near.position(i) + far).collect::<Vec<_>>());
        assert_eq!(splats.origin.fract(), DVec3::ZERO);
        assert!((0..30).all(|i| (splats.position(i) - far - near.position(i)).length() < 1e-6));
        let turn = DQuat::from_rotation_x(0.5);
        splats.transform(2.0, turn, DVec3::ONE);
        for i in 0..30 {
            let expected = 2.0 * (turn * (near.position(i) + far)) + DVec3::ONE;
            assert!((splats.position(i) - expected).length() < 1e-6);
        }
        let mut near_again = near.clone();
        near_again.place(&(0..30).map(|i| near.position(i) + DVec3::splat(50.0)).collect::<Vec<_>>());
        assert_eq!(near_again.origin, DVec3::ZERO);
    }

    #[test]
    fn turned_and_mirrored_splats_look_the_same_from_a_turned_or_mirrored_eye() {
        let before = example(20);
        let eye = DVec3::new(3.0, -4.0, 2.0);
        let turn = DQuat::from_axis_angle(DVec3::new(1.0, 1.0, 0.3).normalize(), 1.1);
        let (mut turned, mut mirrored) = (before.clone(), before.clone());
        turned.transform(1.5, turn, DVec3::X);
        mirrored.invert();
        let looks = before.seen_from(eye);
        let looks_turned = turned.seen_from(1.5 * (turn * eye) + DVec3::X);
        let looks_mirrored = mirrored.seen_from(-eye);
        for i in 0..20 {
            assert!(looks.color(i).abs_diff_eq(looks_turned.color(i), 1e-5));
            assert!(looks.color(i).abs_diff_eq(looks_mirrored.color(i), 1e-5));
            assert_eq!(mirrored.cloud.covariance(i), before.cloud.covariance(i));
            assert_eq!(mirrored.cloud.mean(i), -before.cloud.mean(i));
        }
    }

    #[test]
    fn appended_splats_have_the_higher_degree() {
        let (mut a, b) = (Splats::from(example(3).cloud), example(5));
        a.append(&b);
        assert_eq!((a.cloud.len(), a.harmonics.degree()), (8, 2));
        assert!(a.harmonics.row(2).iter().all(|v| *v == 0.0) && a.harmonics.row(3) == b.harmonics.row(0));
        assert_eq!(a.select(&[7]), b.select(&[4]));
    }
}
