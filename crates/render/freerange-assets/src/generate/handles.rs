//! Handles: ears, D shapes, rings, straps, tapering loops, lugs and bails.

use std::f32::consts::{FRAC_PI_2, PI, TAU};

use glam::{Quat, Vec2, Vec3};

use crate::generate::part::Assembly;
use crate::generate::shapes;
use crate::generate::style::Style;

/// Where a handle meets the body, in the xz plane: radii and heights of its feet.
#[derive(Clone, Copy, Debug)]
pub struct Mount {
    pub low: Vec2,
    pub high: Vec2,
    /// How far it stands out.
    pub reach: f32,
    pub material: u16,
    /// Turn about z.
    pub angle: f32,
}

/// A handle of any kind on the side of a vessel.
pub fn handle(a: &mut Assembly, s: &mut Style, m: Mount) {
    let kind = s.count(0, 6);
    let thick = s.range(0.022, 0.05);
    let wide = match kind {
        // A strap is broad and thin.
        3 => thick * s.range(2.0, 3.5),
        _ => thick * s.log(0.9, 2.0),
    };
    let section = [2.0, 2.0, 3.0, 6.0][s.count(0, 4)];
    let middle = 0.5 * (m.low + m.high);
    let tall = 0.5 * (m.high.y - m.low.y);
    let point = |r: f32, z: f32| Vec3::new(r, 0.0, z);
    let path: Vec<Vec3> = match kind {
        // A ring below the rim.
        0 => {
            let r = (0.8 * tall).min(m.reach);
            let center = m.high - Vec2::new(0.0, r);
            let from = point(center.x + 0.75 * r, center.y);
            shapes::arc(from, Vec3::X * r, Vec3::Z * r, -0.78 * PI, 0.78 * PI, 20)
        }
        // A D: straight outside with round corners.
        1 => {
            let corners =
                [m.low, Vec2::new(m.low.x + m.reach, m.low.y), Vec2::new(m.high.x + m.reach, m.high.y), m.high];
            shapes::subdivide(&shapes::fillet(&corners, 0.7 * m.reach, 6), 0.12)
                .iter()
                .map(|p| point(p.x, p.y))
                .collect()
        }
        // A loop that swings up and tapers down to its lower foot.
        2 => {
            let corners = [
                m.high - Vec2::new(0.0, 0.25 * tall),
                m.high + Vec2::new(0.55 * m.reach, 0.25 * tall),
                Vec2::new(m.high.x + m.reach, middle.y + 0.5 * tall),
                Vec2::new(m.low.x + 0.7 * m.reach, m.low.y + 0.4 * tall),
                m.low,
            ];
            shapes::smooth(&corners, 5).iter().map(|p| point(p.x, p.y)).collect()
        }
        // An ear: a superellipse between a half circle and a square bracket.
        _ => {
            let square = s.range(0.55, 0.95);
            (0..=18)
                .map(|i| {
                    let t = i as f32 / 18.0;
                    let c = -FRAC_PI_2 + PI * t;
                    let (x, z) = (c.cos().max(0.0).powf(square), c.sin().signum() * c.sin().abs().powf(square));
                    point(m.low.x + (m.high.x - m.low.x) * t + m.reach * x, middle.y + tall * z)
                })
                .collect()
        }
    };
    let taper = if kind == 2 { s.range(0.4, 0.9) } else { 1.0 };
    let half = move |t: f32| Vec2::new(thick, wide) * (1.0 + (taper - 1.0) * t);
    let part = shapes::tube(&path, Vec3::Y, half, section, 14, m.material);
    a.add(part.rotated(Quat::from_rotation_z(m.angle)), 50.0);
    if s.chance(0.1) && kind != 0 {
        // A thumb rest.
        let k = 1.3 * thick;
        let rest = shapes::superquadric(Vec3::new(k, 1.2 * wide, 0.8 * k), 0.9, 1.0, 8, m.material);
        let p = point(m.high.x + 0.6 * m.reach, m.high.y);
        a.add(rest.moved(p).rotated(Quat::from_rotation_z(m.angle)), 50.0);
    }
}

/// A horizontal loop, as pots have two of.
pub fn lug(a: &mut Assembly, s: &mut Style, at: Vec2, material: u16, angle: f32) {
    let (width, reach) = (s.range(0.1, 0.19), s.range(0.08, 0.17));
    let (square, lift) = (s.range(0.5, 1.0), s.range(-0.03, 0.1));
    let path: Vec<Vec3> = (0..=16)
        .map(|i| {
            let c = PI * i as f32 / 16.0;
            let x = c.cos().signum() * c.cos().abs().powf(square);
            let y = c.sin().max(0.0).powf(square);
            Vec3::new(at.x - 0.012 + reach * y, width * x, at.y + lift * y)
        })
        .collect();
    let thick = s.range(0.012, 0.03);
    let flat = s.range(0.8, 1.8);
    let part = shapes::tube(&path, Vec3::Z, |_| Vec2::new(thick * flat, thick), 3.0, 12, material);
    a.add(part.rotated(Quat::from_rotation_z(angle)), 50.0);
}

/// A bail over the top, between two points at +-y.
pub fn bail(a: &mut Assembly, s: &mut Style, at: Vec2, material: u16) {
    let (lift, lean, r) = (s.range(0.25, 0.8), s.range(-0.5, 0.5), s.range(0.01, 0.03));
    let up = Vec3::new(lean, 0.0, 1.0).normalize() * lift;
    let path = shapes::arc(Vec3::Z * at.y, Vec3::Y * at.x, up, 0.0, PI, 24);
    a.add(shapes::tube(&path, Vec3::X, |_| Vec2::splat(r), 2.0, 8, material), 50.0);
    if s.chance(0.4) {
        // A grip around its middle.
        let grip = shapes::arc(Vec3::Z * at.y, Vec3::Y * at.x, up, 0.4 * PI, 0.6 * PI, 8);
        a.add(shapes::tube(&grip, Vec3::X, |_| Vec2::splat(2.2 * r), 2.0, 12, material), 50.0);
    }
}

/// The long handle of a pan: a strip that swells, with a hole near its end or not.
pub fn stick(a: &mut Assembly, s: &mut Style, root: Vec2, material: u16) {
    let (length, rise, sag) = (s.range(0.5, 1.05), s.range(-0.02, 0.3), s.range(-0.06, 0.1));
    let (thick, wide) = (s.range(0.014, 0.03), s.range(0.03, 0.062));
    let neck = s.range(0.4, 0.85);
    let holed = s.chance(0.6);
    // Cells along it; the hole takes the middle cells near the end.
    let (nu, nv) = (9, 30);
    let at = move |u: f32, v: f32, lift: f32| {
        let x = 2.0 * u - 1.0;
        let body = neck + (1.0 - neck) * (2.2 * v).min(1.0).powi(2);
        let end = (1.0 - ((v - 0.9) / 0.1).max(0.0).powi(2)).max(0.0).sqrt().max(0.25);
        let crown = (1.0 - 0.75 * x * x).sqrt();
        Vec3::new(
            root.x - 0.015 + length * v,
            wide * body * end * x,
            root.y + rise * v + sag * (PI * v).sin() + lift * thick * crown,
        )
    };
    let keep = move |i: usize, j: usize| !(holed && (3..6).contains(&i) && (25..28).contains(&j));
    let part = shapes::shell([nu, nv], false, |u, v| at(u, v, -1.0), |u, v| at(u, v, 1.0), keep, [material; 2]);
    a.add(part, 55.0);
}

/// A wire along `path`.
pub fn wire(a: &mut Assembly, path: &[Vec3], r: f32, material: u16) {
    a.add(shapes::tube(path, Vec3::new(0.31, 0.22, 0.93), |_| Vec2::splat(r), 2.0, 7, material), 50.0);
}

/// A hoop of wire about z at a height, with the cross-section `at(angle)`.
pub fn hoop(a: &mut Assembly, at: &dyn Fn(f32) -> Vec2, z: f32, r: f32, material: u16) {
    let mut part = crate::generate::part::Part::default();
    part.grid([40, 7], [true, true], material, |u, v| {
        let (p, q) = (at(TAU * u), TAU * v);
        let out = p.normalize_or(Vec2::X);
        (p + out * r * q.cos()).extend(z + r * q.sin())
    });
    a.add(part, 60.0);
}
