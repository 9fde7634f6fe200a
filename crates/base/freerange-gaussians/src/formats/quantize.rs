//! Numbers in few bits, as several formats have them.

use crate::{SCALE_OF_NONE, channel};
use glam::DQuat;

/// The constant real spherical harmonic, 1 / (2 sqrt(pi)).
pub const SH_C0: f64 = 0.282_094_791_773_878_14;

/// One Gaussian's channels.
pub type Row = [f32; channel::COUNT];

/// 0..1 in a byte, rounded.
pub fn unorm8(value: f64) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

/// `value` rounded into a byte.
pub fn byte(value: f64) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

/// The logit of an opacity that a byte holds. The first and last byte stand for half a step: their logit is that of its
/// middle.
pub fn logit_of_byte(value: u8) -> f32 {
    logit((f64::from(value) / 255.0).clamp(0.25 / 255.0, 254.75 / 255.0))
}

/// The logit of an opacity 0..=1, at most that of the number of 32 bits next to 0 or 1.
pub fn logit(opacity: f64) -> f32 {
    let p = opacity.clamp(1e-7, 1.0 - 1e-7);
    (p / (1.0 - p)).ln() as f32
}

/// Smallest standard deviation; zero has no logarithm.
const MIN_SCALE: f64 = 4.3e-18; // ln is -40

/// The logarithm of a standard deviation that is not negative; what is not finite stays so.
pub fn log_scale(scale: f64) -> f32 {
    if scale < MIN_SCALE { SCALE_OF_NONE } else { scale.ln() as f32 }
}

/// Color as the coefficient of the constant spherical harmonic.
pub fn sh_of_color(color: f32) -> f64 {
    (f64::from(color) - 0.5) / SH_C0
}

/// Color of the coefficient of the constant spherical harmonic.
pub fn color_of_sh(coefficient: f64) -> f32 {
    (coefficient * SH_C0 + 0.5) as f32
}

/// sRGB's curve, taken back.
pub fn linear(encoded: f64) -> f64 {
    if encoded <= 0.04045 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) }
}

/// sRGB's curve.
pub fn encoded(linear: f64) -> f64 {
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

/// The largest of four by magnitude and its number, the first of equals; then the others in order, with the sign that
/// makes the largest positive.
pub fn smallest_three(q: [f64; 4]) -> (usize, [f64; 3]) {
    let largest = (1..4).fold(0, |best, i| if q[i].abs() > q[best].abs() { i } else { best });
    let sign = if q[largest] < 0.0 { -1.0 } else { 1.0 };
    let others = [0, 1, 2].map(|k| sign * q[if k < largest { k } else { k + 1 }]);
    (largest, others)
}

/// The reverse of [`smallest_three`]: a unit quaternion in the same order.
pub fn from_smallest_three(largest: usize, others: [f64; 3]) -> [f64; 4] {
    let rest = (1.0 - others.iter().map(|v| v * v).sum::<f64>()).max(0.0).sqrt();
    std::array::from_fn(|i| match i.cmp(&largest) {
        std::cmp::Ordering::Less => others[i],
        std::cmp::Ordering::Equal => rest,
        std::cmp::Ordering::Greater => others[i - 1],
    })
}

/// Sets the rotation `w x y z` to unit length; one of no length is none at all.
pub fn set_rotation(row: &mut Row, wxyz: [f64; 4]) {
    let q = DQuat::from_xyzw(wxyz[1], wxyz[2], wxyz[3], wxyz[0]);
    let length = q.length();
    let q = if length > 0.0 && length.is_finite() { q / length } else { DQuat::IDENTITY };
    row[channel::ROTATION].copy_from_slice(&[q.w, q.x, q.y, q.z].map(|v| v as f32));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_and_their_values_are_each_others_reverse() {
        for v in 0..=255u8 {
            let p = 1.0 / (1.0 + (-f64::from(logit_of_byte(v))).exp());
            assert_eq!(unorm8(p), v);
        }
        for c in [0.0, 0.3, 1.2] {
            assert!((color_of_sh(sh_of_color(c)) - c).abs() < 1e-7);
        }
    }

    #[test]
    fn three_of_four_are_enough() {
        for q in [[0.1, -0.7, 0.3, 0.64], [-0.9, 0.1, 0.2, 0.3], [0.0, 0.0, 0.0, -1.0], [0.5, 0.5, -0.5, -0.5]] {
            let length = q.iter().map(|v| v * v).sum::<f64>().sqrt();
            let q = q.map(|v| v / length);
            let (largest, others) = smallest_three(q);
            let back = from_smallest_three(largest, others);
            let dot: f64 = q.iter().zip(back).map(|(a, b)| a * b).sum();
            assert!((dot.abs() - 1.0).abs() < 1e-12 && back[largest] > 0.0, "{q:?} {back:?}");
        }
    }
}
