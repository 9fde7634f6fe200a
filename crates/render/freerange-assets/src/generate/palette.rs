//! Colors of household things, in linear light.

use glam::Vec3;
use rand::Rng;

use crate::mesh::srgb_to_linear;

/// Families of colors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Tone {
    White,
    Saturated,
    Pastel,
    Dark,
    Gray,
    Brown,
    Any,
}

/// Linear color from sRGB-encoded hue (turns), saturation and value.
pub fn hsv(h: f32, s: f32, v: f32) -> Vec3 {
    let f = |n: f32| {
        let k = (n + 6.0 * h.rem_euclid(1.0)) % 6.0;
        srgb_to_linear((v - v * s * k.min(4.0 - k).clamp(0.0, 1.0)).clamp(0.0, 1.0))
    };
    Vec3::new(f(5.0), f(3.0), f(1.0))
}

pub fn color(rng: &mut impl Rng, tone: Tone) -> Vec3 {
    let r = &mut *rng;
    match tone {
        // Porcelain, paper, cream; the hue is warm more often than cold.
        Tone::White => {
            let hue = if r.random_bool(0.75) { r.random_range(0.05..0.17) } else { r.random_range(0.5..0.7) };
            let s = if r.random_bool(0.5) { r.random_range(0.0..0.04) } else { r.random_range(0.0..0.16) };
            hsv(hue, s, r.random_range(0.82..1.0))
        }
        Tone::Saturated => {
            // Reds, oranges and yellows, then blues and greens, as packaging has them.
            let hue = match r.random_range(0..20) {
                0..7 => r.random_range(-0.03..0.05),
                7..12 => r.random_range(0.06..0.17),
                12..16 => r.random_range(0.53..0.66),
                16..18 => r.random_range(0.2..0.45),
                _ => r.random::<f32>(),
            };
            hsv(hue, r.random_range(0.55..1.0), r.random_range(0.35..1.0))
        }
        Tone::Pastel => hsv(r.random(), r.random_range(0.12..0.45), r.random_range(0.75..0.98)),
        Tone::Dark => hsv(r.random(), r.random_range(0.0..0.4), r.random_range(0.06..0.3)),
        Tone::Gray => hsv(r.random(), r.random_range(0.0..0.08), r.random_range(0.25..0.8)),
        Tone::Brown => hsv(r.random_range(0.03..0.11), r.random_range(0.3..0.8), r.random_range(0.25..0.85)),
        Tone::Any => hsv(r.random(), r.random(), r.random_range(0.1..1.0)),
    }
}

/// A tone drawn by how often household things have it.
pub fn tone(rng: &mut impl Rng, white_share: f32) -> Tone {
    if rng.random::<f32>() < white_share {
        return Tone::White;
    }
    match rng.random_range(0..100) {
        0..42 => Tone::Saturated,
        42..56 => Tone::Pastel,
        56..70 => Tone::Dark,
        70..80 => Tone::Gray,
        80..94 => Tone::Brown,
        _ => Tone::Any,
    }
}

/// The same color a little lighter or darker, and slightly shifted.
pub fn shade(rng: &mut impl Rng, c: Vec3, amount: f32) -> Vec3 {
    let gain = (rng.random_range(-amount..amount)).exp();
    let tint = Vec3::from_fn(|| rng.random_range(-0.15 * amount..0.15 * amount));
    (c * gain * (Vec3::ONE + tint)).clamp(Vec3::splat(0.003), Vec3::splat(0.98))
}

/// A color that reads well on `ground`.
pub fn contrast(rng: &mut impl Rng, ground: Vec3) -> Vec3 {
    let tones = if luminance(ground) > 0.3 {
        [Tone::Saturated, Tone::Dark, Tone::Dark, Tone::Brown]
    } else {
        [Tone::White, Tone::White, Tone::Pastel, Tone::Saturated]
    };
    let tone = tones[rng.random_range(0..tones.len())];
    color(rng, tone)
}

pub fn luminance(c: Vec3) -> f32 {
    c.dot(Vec3::new(0.2126, 0.7152, 0.0722))
}

trait FromFn {
    fn from_fn(f: impl FnMut() -> f32) -> Vec3;
}

impl FromFn for Vec3 {
    fn from_fn(mut f: impl FnMut() -> f32) -> Vec3 {
        let (x, y, z) = (f(), f(), f());
        Vec3::new(x, y, z)
    }
}
