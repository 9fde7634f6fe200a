//! Hash-based value noise in three dimensions.

use glam::{IVec3, Vec3};

/// A well-mixed 32-bit hash of a lattice point.
pub fn hash3(p: IVec3, seed: u32) -> u32 {
    let mut h = seed
        ^ (p.x as u32).wrapping_mul(0x8da6_b343)
        ^ (p.y as u32).wrapping_mul(0xd816_3841)
        ^ (p.z as u32).wrapping_mul(0xcb1a_b31f);
    h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
    h ^ (h >> 15)
}

/// The upper bits of a hash as a number in [0, 1).
pub fn unit(h: u32) -> f32 {
    (h >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// Three independent numbers in [0, 1) from one hash.
pub fn unit3(h: u32) -> Vec3 {
    let (g, k) = (h.wrapping_mul(0x9e37_79b1), h.wrapping_mul(0x85eb_ca6b));
    Vec3::new(unit(h), unit(g ^ (g >> 15)), unit(k ^ (k >> 13)))
}

/// Smooth value noise in [0, 1], with features of unit size.
pub fn value(p: Vec3, seed: u32) -> f32 {
    let cell = p.floor();
    let f = p - cell;
    let w = f * f * (Vec3::splat(3.0) - 2.0 * f);
    let c = cell.as_ivec3();
    let at = |x, y, z| unit(hash3(c + IVec3::new(x, y, z), seed));
    let lerp = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let x00 = lerp(at(0, 0, 0), at(1, 0, 0), w.x);
    let x10 = lerp(at(0, 1, 0), at(1, 1, 0), w.x);
    let x01 = lerp(at(0, 0, 1), at(1, 0, 1), w.x);
    let x11 = lerp(at(0, 1, 1), at(1, 1, 1), w.x);
    lerp(lerp(x00, x10, w.y), lerp(x01, x11, w.y), w.z)
}

/// Sum of `octaves` of [`value`], each twice as fine and half as strong; in [0, 1], mean about 0.5.
pub fn fbm(mut p: Vec3, seed: u32, octaves: u32) -> f32 {
    let (mut sum, mut amplitude, mut total) = (0.0, 1.0, 0.0);
    for octave in 0..octaves {
        sum += amplitude * value(p, seed.wrapping_add(octave));
        total += amplitude;
        amplitude *= 0.5;
        // An odd offset keeps the lattices of the octaves from lining up.
        p = p * 2.03 + Vec3::new(17.3, -5.7, 9.1);
    }
    sum / total
}

/// Noise with three components in [-1, 1].
pub fn vector(p: Vec3, seed: u32, octaves: u32) -> Vec3 {
    let n = |k: u32| 2.0 * fbm(p, seed.wrapping_add(1013 * k), octaves) - 1.0;
    Vec3::new(n(1), n(2), n(3))
}

/// Distances to the nearest and second nearest jittered lattice point, and the hash of the nearest.
pub fn worley(p: Vec3, seed: u32) -> (f32, f32, u32) {
    let cell = p.floor();
    let (mut best, mut second, mut id) = (f32::MAX, f32::MAX, 0);
    for z in -1..=1 {
        for y in -1..=1 {
            for x in -1..=1 {
                let offset = IVec3::new(x, y, z);
                let h = hash3(cell.as_ivec3() + offset, seed);
                let d = (cell + offset.as_vec3() + unit3(h) - p).length_squared();
                if d < best {
                    second = best;
                    (best, id) = (d, h);
                } else if d < second {
                    second = d;
                }
            }
        }
    }
    (best.sqrt(), second.sqrt(), id)
}
