//! Primitives of about unit size, and what bends them.

use std::f32::consts::{FRAC_PI_2, PI};

use glam::{EulerRot, Quat, Vec2, Vec3};
use rand::Rng;

use crate::generate::part::Part;
use crate::generate::shapes::{self, Span};
use crate::generate::style::Style;
use crate::mesh::noise;

/// A primitive of about unit half size, and its crease angle.
pub fn primitive(s: &mut Style, m: [u16; 2]) -> (Part, f32) {
    match s.count(0, 100) {
        0..16 => {
            let radius = if s.chance(0.5) { 0.0 } else { s.log(0.03, 0.5) };
            let six = if s.chance(0.5) { [m[0]; 6] } else { [m[0], m[0], m[1], m[1], m[0], m[1]] };
            (shapes::rounded_box(Vec3::ONE * 0.9, radius, six), 50.0)
        }
        16..28 => (shapes::superquadric(Vec3::ONE, 1.0, 1.0, s.count(14, 26), m[0]), 60.0),
        28..38 => {
            let (e1, e2) = (s.log(0.25, 1.7), s.log(0.25, 1.7));
            (shapes::superquadric(Vec3::ONE, e1, e2, s.count(18, 28), m[0]), 40.0)
        }
        38..52 => {
            // Cylinders, cones, frusta and prisms.
            let top = match s.count(0, 3) {
                0 => 1.0,
                1 => 0.02,
                _ => s.range(0.1, 1.6),
            };
            let profile = [Vec2::new(0.0, -1.0), Vec2::new(1.0, -1.0), Vec2::new(top, 1.0), Vec2::new(0.0, 1.0)];
            let points = if s.chance(0.5) { shapes::fillet(&profile, s.range(0.03, 0.4), 4) } else { profile.to_vec() };
            (lathe_two(s, points, m), 40.0)
        }
        52..60 => {
            let minor = s.range(0.12, 0.42);
            let exponent = if s.chance(0.6) { 2.0 } else { 6.0 };
            let flat = Vec2::new(minor, minor * s.log(0.4, 2.0));
            (shapes::torus(1.0 - minor, flat, exponent, [40, 18], m[0]), 45.0)
        }
        60..66 => {
            let r = s.range(0.3, 0.6);
            let mut points: Vec<Vec2> =
                (0..=8).map(|i| arc_point(r, -1.0 + r, -FRAC_PI_2 + i as f32 * PI / 16.0)).collect();
            points.extend((0..=8).map(|i| arc_point(r, 1.0 - r, i as f32 * PI / 16.0)));
            (lathe_two(s, points, m), 60.0)
        }
        66..80 => {
            // A turned body with a random smooth profile.
            let n = s.count(3, 7);
            let mut points = vec![Vec2::new(s.range(0.2, 0.9), -1.0)];
            for i in 1..n {
                points.push(Vec2::new(s.range(0.25, 1.0), -1.0 + 2.0 * i as f32 / (n - 1) as f32));
            }
            let mut points = shapes::smooth(&points, 5);
            points.insert(0, Vec2::new(0.0, -1.0));
            points.push(Vec2::new(0.0, 1.0));
            (lathe_two(s, points, m), 45.0)
        }
        80..88 => {
            let body = hollow(s, m);
            (body, 45.0)
        }
        88..94 => {
            let path = wiggle(s, 14);
            let r = s.range(0.08, 0.3);
            let taper = s.range(0.2, 1.0);
            let flat = s.log(0.5, 2.0);
            let half = move |t: f32| Vec2::new(r, r * flat) * (1.0 + (taper - 1.0) * t);
            (shapes::tube(&path, Vec3::Z, half, if s.chance(0.6) { 2.0 } else { 6.0 }, 16, m[0]), 50.0)
        }
        _ => (slab_with_holes(s, m), 40.0),
    }
}

fn arc_point(r: f32, z: f32, angle: f32) -> Vec2 {
    Vec2::new((r * angle.cos()).max(0.0), z + r * angle.sin())
}

/// Revolves a closed profile with the cross-section of a random family; materials change somewhere along it.
fn lathe_two(s: &mut Style, points: Vec<Vec2>, m: [u16; 2]) -> Part {
    let cut = s.count(1, points.len() - 1);
    let spans = if s.chance(0.6) {
        vec![Span { points, material: m[0] }]
    } else {
        vec![
            Span { points: points[..=cut].to_vec(), material: m[0] },
            Span { points: points[cut..].to_vec(), material: m[1] },
        ]
    };
    match s.count(0, 10) {
        0..6 => shapes::lathe(&spans, 36, &shapes::round, 0.25),
        6 => {
            let corners = s.count(3, 9);
            shapes::lathe(&spans, corners * (36 / corners), &shapes::polygon(corners), 0.25)
        }
        7 => {
            let lobes = s.count(3, 10);
            shapes::lathe(&spans, 48, &shapes::lobed(lobes, s.range(0.05, 0.3)), 0.25)
        }
        _ => {
            shapes::lathe(&spans, 40, &shapes::superellipse(Vec2::new(1.0, s.range(0.5, 1.0)), s.log(2.0, 10.0)), 0.25)
        }
    }
}

/// An open vessel with a wall.
fn hollow(s: &mut Style, m: [u16; 2]) -> Part {
    let (bottom, top, wall) = (s.range(0.4, 1.0), s.range(0.5, 1.0), s.range(0.03, 0.15));
    let outer = [Vec2::new(0.0, -1.0), Vec2::new(bottom, -1.0), Vec2::new(top, 1.0)];
    let inner = [
        Vec2::new(top, 1.0),
        Vec2::new(top - wall, 1.0),
        Vec2::new((bottom - wall).max(0.1), -1.0 + wall),
        Vec2::new(0.0, -1.0 + wall),
    ];
    let spans = [
        Span { points: shapes::fillet(&outer, s.range(0.01, 0.5), 4), material: m[0] },
        Span { points: shapes::fillet(&inner, s.range(0.01, 0.4), 3), material: m[1] },
    ];
    let section = shapes::superellipse(Vec2::new(1.0, s.range(0.6, 1.0)), s.log(2.0, 8.0));
    shapes::lathe(&spans, 40, &section, 0.25)
}

/// A smooth random curve.
fn wiggle(s: &mut Style, steps: usize) -> Vec<Vec3> {
    let (bend, twist) = (s.range(0.0, 4.5), s.range(0.0, 1.0));
    let (a, b) = (s.range(0.2, 0.7), s.range(0.2, 0.7));
    (0..=steps)
        .map(|i| {
            let t = i as f32 / steps as f32;
            Vec3::new(a * (bend * t).sin(), twist * b * (1.7 * bend * t).cos(), 2.0 * t - 1.0)
        })
        .collect()
}

/// A curved or flat plate with rectangular or ragged holes.
fn slab_with_holes(s: &mut Style, m: [u16; 2]) -> Part {
    let (nu, nv) = (s.count(8, 20), s.count(8, 20));
    let (period, ragged, seed) = (s.count(2, 5), s.chance(0.3), s.rng.random());
    let (curve, thick) = (s.range(-0.8, 0.8), s.range(0.05, 0.2));
    let surface = move |u: f32, v: f32, lift: f32| {
        let (x, y) = (2.0 * u - 1.0, 2.0 * v - 1.0);
        Vec3::new(x, y, curve * (x * x - 0.5) + lift)
    };
    let keep = move |i: usize, j: usize| {
        let border = i == 0 || j == 0 || i + 1 == nu || j + 1 == nv;
        let open = if ragged {
            noise::value(Vec3::new(i as f32, j as f32, 0.0) * 0.45, seed) > 0.6
        } else {
            !i.is_multiple_of(period) && !j.is_multiple_of(period)
        };
        border || !open
    };
    shapes::shell([nu, nv], false, |u, v| surface(u, v, thick), |u, v| surface(u, v, -thick), keep, m)
}

/// Bends, twists, tapers or roughens a part of unit size.
pub fn deform(s: &mut Style, part: &mut Part) {
    match s.count(0, 4) {
        0 => {
            let rate = s.range(-1.2, 1.2);
            part.map(|p| Quat::from_rotation_z(rate * p.z) * p);
        }
        1 => {
            let k = s.range(-0.6, 0.6);
            part.map(|p| Vec3::new(p.x * (1.0 + k * p.z), p.y * (1.0 + k * p.z), p.z));
        }
        2 => {
            let k = s.range(0.2, 0.9);
            part.map(|p| Quat::from_euler(EulerRot::XYZ, 0.0, k * p.z, 0.0) * p);
        }
        _ => {
            let (amplitude, scale, seed) = (s.range(0.03, 0.25), s.log(0.8, 5.0), s.rng.random());
            part.map(|p| p + amplitude / scale.max(1.0).sqrt() * noise::vector(p * scale, seed, 2));
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::generate::config::GeneratorConfig;

    #[test]
    fn primitives_are_closed() {
        let config = GeneratorConfig::default();
        for seed in 0..400 {
            let mut style = Style::new(ChaCha8Rng::seed_from_u64(seed), &config);
            let (mut part, _) = primitive(&mut style, [0, 1]);
            assert_eq!(part.open_edges(), 0, "seed {seed}, {} triangles", part.triangles.len());
            deform(&mut style, &mut part);
            assert_eq!(part.open_edges(), 0, "seed {seed}, deformed");
        }
    }
}
