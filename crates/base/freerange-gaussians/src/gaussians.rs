//! The cloud: N Gaussians of 14 channels each, in the raw (unconstrained) parametrisation.

use crate::SplatError;
use glam::{DMat3, DQuat, DVec3};
use rand::{Rng, seq::SliceRandom};

/// Where each parameter of a Gaussian lives among its [`COUNT`](channel::COUNT) channels.
pub mod channel {
    use std::ops::Range;

    /// Channels per Gaussian.
    pub const COUNT: usize = 14;
    /// Center, in world units.
    pub const MEAN: Range<usize> = 0..3;
    /// Natural logarithm of the standard deviation along each local axis, in world units.
    pub const LOG_SCALE: Range<usize> = 3..6;
    /// Rotation from the local to the world axes: quaternion `w x y z`, not necessarily of unit length.
    pub const ROTATION: Range<usize> = 6..10;
    /// Logit of the opacity.
    pub const LOGIT_OPACITY: usize = 10;
    /// Color, in sRGB-encoded units; 0..1 in ordinary clouds, but not clamped.
    pub const COLOR: Range<usize> = 11..14;
    /// What messages call the channels.
    pub const NAMES: [&str; COUNT] = [
        "mean x",
        "mean y",
        "mean z",
        "log-scale 0",
        "log-scale 1",
        "log-scale 2",
        "rotation w",
        "rotation x",
        "rotation y",
        "rotation z",
        "logit-opacity",
        "red",
        "green",
        "blue",
    ];
}

/// N Gaussians, row-major `[n, 14]`; see [`channel`] for the columns.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gaussians {
    data: Vec<f32>, // [n, 14]
}

/// One Gaussian's channels.
pub(crate) type Row = [f32; channel::COUNT];

impl Gaussians {
    /// Wraps `data`, row-major `[n, 14]`.
    ///
    /// # Panics
    /// If the length is no multiple of 14: a programming error, as files are checked when they are read.
    pub fn from_rows(data: Vec<f32>) -> Self {
        assert_eq!(data.len() % channel::COUNT, 0, "{} channels per Gaussian", channel::COUNT);
        Self { data }
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.data.len() / channel::COUNT
    }

    /// Whether there is no Gaussian.
    pub fn is_empty(&self) -> bool {
        self.data.is_empty()
    }

    /// All channels, row-major `[n, 14]`.
    pub fn rows(&self) -> &[f32] {
        &self.data
    }

    /// All channels, row-major `[n, 14]`, to change in place.
    pub fn rows_mut(&mut self) -> &mut [f32] {
        &mut self.data
    }

    /// The channels, giving up the cloud. `[n, 14]`
    pub fn into_rows(self) -> Vec<f32> {
        self.data
    }

    /// The 14 channels of Gaussian `i`.
    pub fn row(&self, i: usize) -> &[f32; channel::COUNT] {
        self.data.as_chunks::<{ channel::COUNT }>().0.get(i).expect("index of a Gaussian")
    }

    /// The Gaussians one after the other, 14 channels each.
    pub fn iter(&self) -> std::slice::Iter<'_, [f32; channel::COUNT]> {
        self.data.as_chunks().0.iter()
    }

    /// As [`iter`](Self::iter), to change in place.
    pub fn iter_mut(&mut self) -> std::slice::IterMut<'_, [f32; channel::COUNT]> {
        self.data.as_chunks_mut().0.iter_mut()
    }

    /// Adds a Gaussian at the end.
    pub fn push(&mut self, row: &[f32; channel::COUNT]) {
        self.data.extend_from_slice(row);
    }

    /// Center of Gaussian `i`, in world units.
    pub fn mean(&self, i: usize) -> DVec3 {
        mean(self.row(i))
    }

    /// Standard deviations of Gaussian `i` along its local axes, in world units.
    pub fn scale(&self, i: usize) -> DVec3 {
        scale(self.row(i))
    }

    /// Rotation of Gaussian `i` from its local to the world axes, of unit length; identity where the stored one is zero.
    pub fn rotation(&self, i: usize) -> DQuat {
        rotation(self.row(i))
    }

    /// Opacity of Gaussian `i`, 0..1.
    pub fn opacity(&self, i: usize) -> f64 {
        opacity(self.row(i))
    }

    /// Color of Gaussian `i`: red, green, blue, sRGB-encoded.
    pub fn color(&self, i: usize) -> DVec3 {
        color(self.row(i))
    }

    /// World-space covariance of Gaussian `i`: R S S^T R^T.
    pub fn covariance(&self, i: usize) -> DMat3 {
        covariance(DMat3::from_quat(self.rotation(i)), self.scale(i))
    }

    /// Smallest and largest center along each axis; `None` without Gaussians.
    pub fn bounds(&self) -> Option<(DVec3, DVec3)> {
        self.iter()
            .map(mean)
            .fold(None, |b, m| Some(b.map_or((m, m), |(lo, hi): (DVec3, DVec3)| (lo.min(m), hi.max(m)))))
    }

    /// The Gaussians at `indices`, in that order.
    ///
    /// # Panics
    /// If an index lies outside the cloud.
    pub fn select(&self, indices: impl IntoIterator<Item = usize>) -> Self {
        let mut out = Self::default();
        indices.into_iter().for_each(|i| out.push(self.row(i)));
        out
    }

    /// The same Gaussians in random order: neighboring rows then are unrelated ("random pairs" of the ablation).
    pub fn shuffled(&self, rng: &mut impl Rng) -> Self {
        let mut order: Vec<usize> = (0..self.len()).collect();
        order.shuffle(rng);
        self.select(order)
    }

    /// Checks that every channel is finite.
    ///
    /// # Errors
    /// [`SplatError::Value`] with the first one that is not.
    pub fn check_finite(&self) -> Result<(), SplatError> {
        match self.data.iter().position(|v| !v.is_finite()) {
            None => Ok(()),
            Some(at) => Err(SplatError::Value {
                row: at / channel::COUNT,
                channel: at % channel::COUNT,
                name: channel::NAMES[at % channel::COUNT],
                expected: "a finite number",
                found: self.data[at],
            }),
        }
    }

    /// Moves every Gaussian by the similarity `x -> scale * rotation * x + translation`: centers, log-scales and
    /// quaternions change; opacity and color do not.
    ///
    /// # Panics
    /// If `scale` is not positive and finite, or `rotation` zero or not finite.
    pub fn transform(&mut self, scale: f64, rotation: DQuat, translation: DVec3) {
        assert!(scale > 0.0 && scale.is_finite(), "a similarity has a positive scale, not {scale}");
        assert!(rotation.length_recip().is_normal(), "a similarity has a rotation, not {rotation}");
        let (turn, log_scale) = (rotation.normalize(), scale.ln());
        for row in self.iter_mut() {
            let moved = scale * (turn * mean(row)) + translation;
            let turned = turn * raw_rotation(row);
            row[channel::MEAN].copy_from_slice(&moved.as_vec3().to_array());
            row[channel::LOG_SCALE].iter_mut().for_each(|s| *s = (f64::from(*s) + log_scale) as f32);
            set_rotation(row, turned);
        }
    }

    /// Gives every quaternion unit length and w >= 0; a zero or non-finite one becomes the identity.
    /// Generated clouds need this after denormalization.
    pub fn canonicalize_rotations(&mut self) {
        for row in self.iter_mut() {
            let unit = canonical(rotation(row));
            set_rotation(row, unit);
        }
    }
}

impl<'a> IntoIterator for &'a Gaussians {
    type Item = &'a [f32; channel::COUNT];
    type IntoIter = std::slice::Iter<'a, [f32; channel::COUNT]>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

fn vec3(row: &Row, start: usize) -> DVec3 {
    DVec3::new(row[start].into(), row[start + 1].into(), row[start + 2].into())
}

pub(crate) fn mean(row: &Row) -> DVec3 {
    vec3(row, channel::MEAN.start)
}

pub(crate) fn scale(row: &Row) -> DVec3 {
    vec3(row, channel::LOG_SCALE.start).exp()
}

pub(crate) fn color(row: &Row) -> DVec3 {
    vec3(row, channel::COLOR.start)
}

pub(crate) fn opacity(row: &Row) -> f64 {
    1.0 / (1.0 + (-f64::from(row[channel::LOGIT_OPACITY])).exp())
}

fn raw_rotation(row: &Row) -> DQuat {
    let [w, x, y, z] = [0, 1, 2, 3].map(|k| f64::from(row[channel::ROTATION.start + k]));
    DQuat::from_xyzw(x, y, z, w)
}

pub(crate) fn rotation(row: &Row) -> DQuat {
    unit(raw_rotation(row))
}

/// `q` at unit length; the identity where it has none.
pub(crate) fn unit(q: DQuat) -> DQuat {
    // Phrased so that NaN and infinity, too, fail it.
    let length = q.length();
    if length > 0.0 && length.is_finite() { q / length } else { DQuat::IDENTITY }
}

pub(crate) fn set_rotation(row: &mut Row, q: DQuat) {
    row[channel::ROTATION].copy_from_slice(&[q.w, q.x, q.y, q.z].map(|v| v as f32));
}

/// Of the two quaternions of one rotation the one with w > 0 (at w = 0: with its first non-zero component positive).
pub(crate) fn canonical(q: DQuat) -> DQuat {
    let first = [q.w, q.x, q.y, q.z].into_iter().find(|v| *v != 0.0).unwrap_or(1.0);
    // Adding zero turns -0 into 0.
    if first < 0.0 { DQuat::from_xyzw(0.0 - q.x, 0.0 - q.y, 0.0 - q.z, 0.0 - q.w) } else { q }
}

pub(crate) fn covariance(axes: DMat3, scale: DVec3) -> DMat3 {
    let scaled = axes * DMat3::from_diagonal(scale);
    scaled * scaled.transpose()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

    fn example(n: usize, seed: u64) -> Gaussians {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        Gaussians::from_rows((0..n * channel::COUNT).map(|_| rng.random_range(-2.0..2.0)).collect())
    }

    #[test]
    fn similarity_moves_means_and_covariances() {
        let before = example(20, 1);
        let mut after = before.clone();
        let turn = DQuat::from_axis_angle(DVec3::new(1.0, -2.0, 0.5).normalize(), 0.8);
        let (scale, shift) = (2.5, DVec3::new(1.0, 2.0, -3.0));
        after.transform(scale, turn, shift);
        let r = DMat3::from_quat(turn);
        for i in 0..before.len() {
            assert!((after.mean(i) - (scale * (r * before.mean(i)) + shift)).length() < 1e-5);
            let expected = r * before.covariance(i) * r.transpose() * (scale * scale);
            let largest = expected.to_cols_array().into_iter().fold(0.0, |m: f64, v| m.max(v.abs()));
            assert!(expected.abs_diff_eq(after.covariance(i), 1e-5 * largest));
            assert_eq!(before.color(i), after.color(i));
            assert_eq!(before.opacity(i), after.opacity(i));
        }
    }

    #[test]
    fn rotations_become_canonical() {
        let mut cloud = example(50, 2);
        cloud.iter_mut().next().unwrap()[channel::ROTATION].fill(0.0);
        cloud.iter_mut().nth(1).unwrap()[channel::ROTATION].copy_from_slice(&[0.0, -3.0, 0.0, 4.0]);
        cloud.iter_mut().nth(2).unwrap()[channel::ROTATION].copy_from_slice(&[f32::NAN, 0.0, 0.0, 1.0]);
        let before = cloud.clone();
        cloud.canonicalize_rotations();
        assert_eq!(cloud.row(0)[channel::ROTATION], [1.0, 0.0, 0.0, 0.0]);
        assert_eq!(cloud.row(1)[channel::ROTATION], [0.0, 0.6, 0.0, -0.8]);
        assert_eq!(cloud.row(2)[channel::ROTATION], [1.0, 0.0, 0.0, 0.0]);
        for i in 3..cloud.len() {
            let q = &cloud.row(i)[channel::ROTATION];
            assert!(q[0] >= 0.0 && (q.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-6);
            assert!(cloud.covariance(i).abs_diff_eq(before.covariance(i), 1e-4));
        }
    }

    #[test]
    fn shuffling_permutes_reproducibly() {
        let cloud = example(100, 3);
        let shuffled = cloud.shuffled(&mut ChaCha8Rng::seed_from_u64(7));
        assert_eq!(shuffled, cloud.shuffled(&mut ChaCha8Rng::seed_from_u64(7)));
        assert_ne!(shuffled, cloud);
        let sorted = |c: &Gaussians| {
            let mut rows: Vec<_> = c.iter().map(|r| r.map(f32::to_bits)).collect();
            rows.sort_unstable();
            rows
        };
        assert_eq!(sorted(&shuffled), sorted(&cloud));
    }

    #[test]
    fn non_finite_values_are_named() {
        let mut cloud = example(3, 4);
        assert!(cloud.check_finite().is_ok());
        cloud.rows_mut()[2 * channel::COUNT + 10] = f32::NAN;
        let message = cloud.check_finite().unwrap_err().to_string();
        assert!(
            message.contains("Gaussian 2") && message.contains("logit-opacity") && message.contains("NaN"),
            "{message}"
        );
    }

    #[test]
    fn bounds_hold_the_centers() {
        let cloud = example(30, 5);
        let (lo, hi) = cloud.bounds().unwrap();
        assert!((0..30).all(|i| cloud.mean(i).cmpge(lo).all() && cloud.mean(i).cmple(hi).all()));
        assert!(Gaussians::default().bounds().is_none());
    }
}
