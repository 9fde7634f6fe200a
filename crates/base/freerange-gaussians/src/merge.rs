//! One Gaussian in plain (linear) parameters; merging several into one and splitting one into two.

use crate::eigen::symmetric_eigen;
use crate::gaussians::{self, Row};
use crate::{Gaussians, SplatError, channel};
use glam::{DMat3, DQuat, DVec3};
use std::{cmp::Reverse, collections::BinaryHeap, f64::consts::FRAC_2_PI};

/// Opacities of the rows that a tree gives out are clamped to this range, so that their logit lies within +-6.91.
/// Merged opacities may exceed 1. The rasterizer draws neither less than 1/255 nor more than 0.99 of a Gaussian.
pub const OPACITY_RANGE: [f64; 2] = [0.001, 0.999];

/// Log-scales that can be merged: beyond it squares of squares leave the range of f64.
const LOG_SCALES: std::ops::RangeInclusive<f64> = -40.0..=40.0;

/// A Gaussian in linear parameters, f64.
#[derive(Clone, Debug, PartialEq)]
pub struct Gaussian {
    /// Center, in world units.
    pub mean: DVec3,
    /// World-space covariance.
    pub covariance: DMat3,
    /// Standard deviations along the local axes.
    pub scale: DVec3,
    /// The local axes in world coordinates, as columns: a proper rotation.
    pub axes: DMat3,
    /// Opacity; of a merged Gaussian it may exceed 1.
    pub opacity: f64,
    /// Color, sRGB-encoded.
    pub color: DVec3,
}

impl Gaussian {
    /// From its parameters; `rotation` need not have unit length, and stands for the identity where it is zero.
    pub fn new(mean: DVec3, scale: DVec3, rotation: DQuat, opacity: f64, color: DVec3) -> Self {
        let axes = DMat3::from_quat(gaussians::unit(rotation));
        Self { mean, covariance: gaussians::covariance(axes, scale), scale, axes, opacity, color }
    }

    /// From the 14 channels of a cloud's row.
    pub fn from_row(row: &[f32; channel::COUNT]) -> Self {
        let (mean, scale, color) = (gaussians::mean(row), gaussians::scale(row), gaussians::color(row));
        Self::new(mean, scale, gaussians::rotation(row), gaussians::opacity(row), color)
    }

    /// The 14 channels: quaternion of unit length with w >= 0, opacity clamped to [`OPACITY_RANGE`].
    pub fn to_row(&self) -> [f32; channel::COUNT] {
        let mut row = Row::default();
        let opacity = self.opacity.clamp(OPACITY_RANGE[0], OPACITY_RANGE[1]);
        row[channel::MEAN].copy_from_slice(&self.mean.as_vec3().to_array());
        row[channel::LOG_SCALE].copy_from_slice(&self.scale.to_array().map(|s| s.ln() as f32));
        gaussians::set_rotation(&mut row, gaussians::canonical(DQuat::from_mat3(&self.axes).normalize()));
        row[channel::LOGIT_OPACITY] = (opacity / (1.0 - opacity)).ln() as f32;
        row[channel::COLOR].copy_from_slice(&self.color.as_vec3().to_array());
        row
    }

    /// What the Gaussian weighs in a merge: opacity times the surface `s0 s1 + s0 s2 + s1 s2` (Kerbl et al. 2024).
    pub fn weight(&self) -> f64 {
        self.opacity * surface(self.scale)
    }

    /// The two halves on either side of the center, across the longest axis, each as the Gaussian of its moments
    /// (a half-normal: center `s sqrt(2 / pi)` away, variance `s^2 (1 - 2 / pi)`). Their merge gives the whole back.
    pub fn halves(&self) -> [Self; 2] {
        let longest = (1..3).fold(0, |best, k| if self.scale[k] > self.scale[best] { k } else { best });
        let mut scale = self.scale;
        scale[longest] *= (1.0 - FRAC_2_PI).sqrt();
        let shift = self.axes.col(longest) * (self.scale[longest] * FRAC_2_PI.sqrt());
        let opacity = self.weight() / (2.0 * surface(scale));
        [-shift, shift].map(|shift| Self {
            mean: self.mean + shift,
            covariance: gaussians::covariance(self.axes, scale),
            scale,
            opacity,
            ..self.clone()
        })
    }

    /// Checks that merging cannot overflow; `row` is for the message.
    pub(crate) fn check(&self, row: usize) -> Result<(), SplatError> {
        let at = |channel: usize, found: f64, expected| SplatError::Value {
            row,
            channel,
            name: channel::NAMES[channel],
            expected,
            found: found as f32,
        };
        for k in 0..3 {
            if !self.mean[k].is_finite() {
                return Err(at(channel::MEAN.start + k, self.mean[k], "a finite number"));
            }
            let log_scale = self.scale[k].ln();
            if !LOG_SCALES.contains(&log_scale) {
                return Err(at(channel::LOG_SCALE.start + k, log_scale, "a number within -40..40"));
            }
            if !self.color[k].is_finite() {
                return Err(at(channel::COLOR.start + k, self.color[k], "a finite number"));
            }
        }
        if !(self.opacity >= 0.0 && self.opacity.is_finite()) {
            return Err(at(channel::LOGIT_OPACITY, self.opacity, "an opacity of at least 0"));
        }
        Ok(())
    }
}

/// The Gaussians of `cloud`, checked to be fit for merging.
pub(crate) fn gaussians(cloud: &Gaussians) -> Result<Vec<Gaussian>, SplatError> {
    cloud.check_finite()?;
    cloud.iter().map(Gaussian::from_row).enumerate().map(|(i, g)| g.check(i).map(|()| g)).collect()
}

fn surface(s: DVec3) -> f64 {
    s.x * s.y + s.x * s.z + s.y * s.z
}

/// One Gaussian in the place of `parts` (Kerbl et al. 2024, "A Hierarchical 3D Gaussian Representation"): moments
/// matched with shares a = w / sum w of the [weights](Gaussian::weight), opacity such that the weight is conserved, and
/// therefore possibly above 1. Scales ascend. Where nothing has any weight, the shares are equal.
///
/// # Panics
/// If `parts` is empty.
pub fn merge(parts: &[&Gaussian]) -> Gaussian {
    assert!(!parts.is_empty(), "nothing to merge");
    let total: f64 = parts.iter().map(|g| g.weight()).sum();
    let share = |g: &Gaussian| if total > 0.0 { g.weight() / total } else { 1.0 / parts.len() as f64 };

    let (mut mean, mut color) = (DVec3::ZERO, DVec3::ZERO);
    for g in parts {
        mean += share(g) * g.mean;
        color += share(g) * g.color;
    }
    let (mut covariance, mut smallest) = (DMat3::ZERO, 0.0);
    for g in parts {
        let d = g.mean - mean;
        covariance += share(g) * (g.covariance + DMat3::from_cols(d * d.x, d * d.y, d * d.z));
        smallest += share(g) * g.scale.min_element().powi(2);
    }
    // The smallest eigenvalue of the sum is at least the sum of the smallest: only rounding can take it below.
    let (variances, axes) = symmetric_eigen(&covariance);
    let scale = variances.max(DVec3::splat(smallest)).map(f64::sqrt);
    Gaussian { mean, covariance, scale, axes, opacity: total / surface(scale), color }
}

/// Splits the Gaussian of the largest weight [into halves](Gaussian::halves), again and again, until there are `count`.
/// The first half takes the place of the whole, the second is put at the end.
pub(crate) fn split_largest(gaussians: &mut Vec<Gaussian>, count: usize) {
    // Weights are not negative, so that their bits are ordered as they are; of equals the first is taken.
    let entry = |(i, g): (usize, &Gaussian)| (g.weight().to_bits(), Reverse(i));
    let mut heap: BinaryHeap<_> = gaussians.iter().enumerate().map(entry).collect();
    while gaussians.len() < count {
        let Some((_, Reverse(i))) = heap.pop() else { return };
        let [first, second] = gaussians[i].halves();
        gaussians[i] = first;
        gaussians.push(second);
        for at in [i, gaussians.len() - 1] {
            heap.push(entry((at, &gaussians[at])));
        }
    }
}
