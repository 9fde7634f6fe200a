//! Vessels and packaging: mugs, bowls, cans, bottles, cartons, pans.

use std::f32::consts::{FRAC_PI_2, TAU};

use glam::{Quat, Vec2, Vec3};

use crate::label::Face;
use crate::palette::{self, Tone};
use crate::part::Assembly;
use crate::shapes::{self, Span};
use crate::style::Style;
use crate::texture::{Material, Texture};

/// Rounding of creases in turned bodies.
const CREASE: f32 = 42.0;

/// Ceramic: white, coloured, speckled or decorated; usually glazed.
fn ceramic(s: &mut Style) -> Material {
    let color = if s.chance(0.4) { palette::color(&mut s.rng, Tone::White) } else { s.color() };
    let texture = match s.count(0, 10) {
        0..5 => Texture::Flat(color),
        5 => s.speckle(color),
        _ => s.pattern(color),
    };
    s.finish(texture)
}

pub fn mug(a: &mut Assembly, s: &mut Style) {
    let outside = ceramic(s);
    let decorated = s.chance(0.3);
    let inside = match s.count(0, 3) {
        0 => outside.clone(),
        1 => {
            let white = palette::color(&mut s.rng, Tone::White);
            s.plain(white)
        }
        _ => ceramic(s),
    };
    let handle = if s.chance(0.8) { outside.clone() } else { inside.clone() };
    let [outside, inside, handle] = [outside, inside, handle].map(|m| a.material(m));
    let h = s.log(0.7, 1.8);
    let (bottom, top) = (s.range(0.32, 0.55), s.range(0.38, 0.58));
    let belly = s.range(-0.06, 0.1);
    let wall = s.range(0.02, 0.06);
    let foot = s.range(0.0, 0.03);
    let profile = [
        Vec2::new(bottom * 0.85, 0.0),
        Vec2::new(bottom, 0.06 * h),
        Vec2::new(0.5 * (bottom + top) + belly, 0.5 * h),
        Vec2::new(top, h),
    ];
    let radius = |t: f32| {
        let side = shapes::smooth(&profile, 8);
        side[((t * (side.len() - 1) as f32) as usize).min(side.len() - 1)]
    };
    let mut outer = vec![Vec2::new(0.0, foot), Vec2::new(bottom * 0.7, foot), Vec2::new(bottom * 0.8, 0.0)];
    outer.extend(shapes::smooth(&profile, 5));
    let mut inner = vec![Vec2::new(top - 0.15 * wall, h + 0.35 * wall), Vec2::new(top - 0.85 * wall, h + 0.35 * wall)];
    let floor = wall + foot;
    for i in (0..=8).rev() {
        let p = radius(0.25 + 0.75 * i as f32 / 8.0);
        inner.push(Vec2::new((p.x - wall).max(0.1), p.y.max(floor + 0.08 * h)));
    }
    inner.push(Vec2::new((bottom - 1.6 * wall).max(0.08), floor + 0.02 * h));
    inner.push(Vec2::new(0.0, floor));
    inner.insert(0, outer[outer.len() - 1]);
    let mut spans = vec![];
    if decorated {
        // A printed wrap between two heights.
        let (from, to) = (3 + s.count(3, 7), outer.len() - 1 - s.count(1, 5));
        let mut scheme = s.scheme();
        if s.chance(0.6) {
            scheme.ground = palette::color(&mut s.rng, Tone::White);
        }
        let wrap = s.print(&scheme, Face::Front, TAU * top / (0.7 * h));
        let wrap = a.material(wrap);
        spans.push(Span { points: outer[..=from].to_vec(), material: outside });
        spans.push(Span { points: outer[from..=to].to_vec(), material: wrap });
        spans.push(Span { points: outer[to..].to_vec(), material: outside });
    } else {
        spans.push(Span { points: outer, material: outside });
    }
    spans.push(Span { points: inner, material: inside });
    let body = if s.chance(0.85) {
        shapes::lathe(&spans, 40, &shapes::round, 0.14)
    } else {
        shapes::lathe(&spans, 40, &shapes::superellipse(Vec2::ONE, s.range(2.5, 5.0)), 0.14)
    };
    a.add(body, CREASE);
    if s.chance(0.85) {
        let (low, high) = (s.range(0.12, 0.3) * h, s.range(0.7, 0.92) * h);
        let reach = s.range(0.18, 0.42);
        ear(a, s, radius(low / h).x - 0.3 * wall, radius(high / h).x - 0.3 * wall, low, high, reach, handle, 0.0);
    }
}

/// A C-shaped handle in the xz plane, turned about z by `angle`.
fn ear(a: &mut Assembly, s: &mut Style, x0: f32, x1: f32, z0: f32, z1: f32, reach: f32, material: u16, angle: f32) {
    let square = s.range(0.55, 0.95);
    let n = 16;
    let path: Vec<Vec3> = (0..=n)
        .map(|i| {
            let t = i as f32 / n as f32;
            let c = -FRAC_PI_2 + std::f32::consts::PI * t;
            // A superellipse between a half circle and a square bracket.
            let (x, z) = (c.cos().max(0.0).powf(square), c.sin().signum() * c.sin().abs().powf(square));
            Vec3::new(x0 + (x1 - x0) * t + reach * x, 0.0, 0.5 * (z0 + z1) + 0.5 * (z1 - z0) * z)
        })
        .collect();
    let thick = s.range(0.022, 0.05);
    let wide = thick * s.log(0.9, 2.2);
    let exponent = if s.chance(0.6) { 2.0 } else { 5.0 };
    let part = shapes::tube(&path, Vec3::Y, |_| Vec2::new(thick, wide), exponent, 14, material);
    a.add(part.rotated(Quat::from_rotation_z(angle)), 50.0);
}

pub fn bowl(a: &mut Assembly, s: &mut Style) {
    let outside = ceramic(s);
    let same = s.chance(0.5);
    let inside = if same { outside.clone() } else { ceramic(s) };
    let rim = if s.chance(0.3) { s.material() } else { outside.clone() };
    let [outside, inside, rim] = [outside, inside, rim].map(|m| a.material(m));
    // From deep bowls over ramekins to flat plates.
    let h = s.log(0.1, 1.0);
    let foot = if h < 0.25 { s.range(0.45, 0.8) } else { s.range(0.3, 0.9) };
    let wall = s.range(0.015, 0.06).min(0.4 * h);
    let curve = s.log(0.5, 3.0);
    let lip = if h < 0.3 || s.chance(0.15) { s.range(0.0, 0.35) } else { 0.0 };
    let foot_height = s.range(0.0, 0.25) * h.min(0.3);
    let side = |t: f32, inset: f32| {
        let flat = 1.0 - lip;
        let (r, z) = if t < flat || lip == 0.0 {
            let q = t / flat;
            (foot + (1.0 - foot) * q.powf(1.0 / curve.max(1.0)) * flat, h * 0.85 * q.powf(curve))
        } else {
            let q = (t - flat) / lip;
            (foot + (1.0 - foot) * (flat + lip * q), h * (0.85 + 0.15 * q))
        };
        Vec2::new((r - inset).max(0.02), z + foot_height)
    };
    let n = 10;
    let mut outer = vec![Vec2::new(0.0, 0.4 * foot_height), Vec2::new(0.8 * foot, 0.4 * foot_height)];
    outer.extend([Vec2::new(0.85 * foot, 0.0), Vec2::new(0.95 * foot, 0.0)]);
    outer.extend((0..=n).map(|i| side(i as f32 / n as f32, 0.0)));
    let edge = outer[outer.len() - 1];
    let brim = vec![
        edge,
        edge + Vec2::new(0.1 * wall, 0.6 * wall),
        edge + Vec2::new(-0.4 * wall, wall),
        edge + Vec2::new(-wall, 0.8 * wall),
    ];
    let mut inner = vec![brim[3]];
    inner.extend((1..=n).rev().map(|i| side(i as f32 / n as f32, wall) + Vec2::new(0.0, 0.7 * wall)).skip(1));
    inner.push(Vec2::new((foot - 0.5 * wall).max(0.05), foot_height + wall));
    inner.push(Vec2::new(0.0, foot_height + wall));
    let spans = [
        Span { points: outer, material: outside },
        Span { points: brim, material: rim },
        Span { points: inner, material: inside },
    ];
    let part = match s.count(0, 10) {
        0 => shapes::lathe(&spans, 48, &shapes::lobed(s.count(5, 14), s.range(0.02, 0.08)), 0.14),
        1 => {
            shapes::lathe(&spans, 44, &shapes::superellipse(Vec2::new(1.0, s.range(0.5, 1.0)), s.range(2.0, 6.0)), 0.14)
        }
        _ => shapes::lathe(&spans, 44, &shapes::round, 0.14),
    };
    a.add(part, CREASE);
}

pub fn can(a: &mut Assembly, s: &mut Style) {
    let scheme = s.scheme();
    let (r, h) = (0.4, s.log(0.25, 1.8));
    let label = s.print(&scheme, Face::Front, TAU * r / h);
    let metal = if s.chance(0.8) { s.metal() } else { s.plain(scheme.ground) };
    let [label, metal] = [label, metal].map(|m| a.material(m));
    let bead = s.range(0.0, 0.025);
    let inset = s.range(0.01, 0.05);
    let (low, high) = (s.range(0.02, 0.12) * h, h - s.range(0.02, 0.12) * h);
    let bottom = vec![
        Vec2::new(0.0, inset),
        Vec2::new(r - 0.03, inset),
        Vec2::new(r - 0.02, 0.0),
        Vec2::new(r + bead, 0.0),
        Vec2::new(r + bead, 0.02),
        Vec2::new(r, 0.03),
        Vec2::new(r, low.max(0.035)),
    ];
    let top: Vec<Vec2> = if s.chance(0.5) {
        vec![
            Vec2::new(r, high),
            Vec2::new(r, h - 0.03),
            Vec2::new(r + bead, h - 0.02),
            Vec2::new(r + bead, h),
            Vec2::new(r - 0.02, h),
            Vec2::new(r - 0.03, h - inset),
            Vec2::new(0.0, h - inset),
        ]
    } else {
        // A drink can: the shoulder narrows.
        let neck = r * s.range(0.75, 0.9);
        vec![
            Vec2::new(r, high),
            Vec2::new(neck, h),
            Vec2::new(neck, h + 0.02),
            Vec2::new(neck - 0.02, h + 0.02),
            Vec2::new(neck - 0.03, h - 0.01),
            Vec2::new(0.0, h - 0.01),
        ]
    };
    let body = vec![bottom[bottom.len() - 1], top[0]];
    let spans = [
        Span { points: bottom, material: metal },
        Span { points: body, material: label },
        Span { points: top, material: metal },
    ];
    a.add(shapes::lathe(&spans, 44, &shapes::round, 0.12), 40.0);
}

pub fn bottle(a: &mut Assembly, s: &mut Style) {
    let scheme = s.scheme();
    let color = if s.chance(0.5) { scheme.ground } else { s.color() };
    let body = if s.chance(0.75) { s.plain(color) } else { s.material() };
    let cap = match s.count(0, 4) {
        0 => s.metal(),
        1 => s.dark_plastic(),
        2 => s.plain(scheme.accent),
        _ => s.material(),
    };
    let (r, h) = (s.range(0.2, 0.42), s.range(0.5, 1.0));
    let neck = r * s.range(0.25, 0.85);
    let shoulder = s.range(0.08, 0.4);
    let neck_height = s.range(0.02, 0.35);
    let waist = if s.chance(0.3) { s.range(0.75, 1.0) } else { 1.0 };
    let base = r * s.range(0.75, 1.0);
    let labelled = s.chance(0.7);
    let (low, high) = (s.range(0.1, 0.35) * h, s.range(0.6, 0.95) * h);
    let label = if labelled { s.print(&scheme, Face::Front, TAU * r / (high - low)) } else { body.clone() };
    let [body, cap, label] = [body, cap, label].map(|m| a.material(m));
    let bottom = vec![
        Vec2::new(0.0, 0.02),
        Vec2::new(base * 0.8, 0.0),
        Vec2::new(base * 0.95, 0.02),
        Vec2::new(base, 0.05),
        Vec2::new(r, low),
    ];
    let band = vec![Vec2::new(r, low), Vec2::new(r * waist, 0.5 * (low + high)), Vec2::new(r, high)];
    let mut top = if s.chance(0.5) {
        shapes::smooth(
            &[
                Vec2::new(r, high),
                Vec2::new(r * 0.98, h),
                Vec2::new(0.4 * r + 0.6 * neck, h + 0.6 * shoulder),
                Vec2::new(neck, h + shoulder),
            ],
            5,
        )
    } else {
        shapes::fillet(&[Vec2::new(r, high), Vec2::new(r, h), Vec2::new(neck, h + shoulder)], s.range(0.01, 0.12), 4)
    };
    let z = h + shoulder + neck_height;
    top.extend([Vec2::new(neck, z), Vec2::new(0.0, z)]);
    let spans = [
        Span { points: bottom, material: body },
        Span { points: if waist < 1.0 { shapes::smooth(&band, 4) } else { band }, material: label },
        Span { points: top, material: body },
    ];
    let square = s.count(0, 10);
    let oval = if s.chance(0.25) { s.range(0.5, 0.9) } else { 1.0 };
    let part = match square {
        0..7 => shapes::lathe(&spans, 40, &shapes::superellipse(Vec2::new(1.0, oval), 2.0), 0.13),
        7 => shapes::lathe(&spans, 40, &shapes::polygon([4, 5, 6, 8][s.count(0, 4)]), 0.13),
        _ => shapes::lathe(&spans, 44, &shapes::superellipse(Vec2::new(1.0, oval), s.range(3.0, 10.0)), 0.13),
    };
    a.add(part, CREASE);
    if s.chance(0.85) {
        // The cap sits over the neck.
        let (cr, ch) = (neck * s.range(1.05, 1.3), s.range(0.05, 0.25));
        let start = z - ch * s.range(0.2, 0.8);
        let taper = s.range(0.6, 1.0);
        let points = [
            Vec2::new(0.0, start),
            Vec2::new(cr, start),
            Vec2::new(cr * taper, start + ch),
            Vec2::new(0.0, start + ch),
        ];
        let span = [Span { points: shapes::fillet(&points, 0.03, 3), material: cap }];
        let part = if s.chance(0.4) {
            shapes::lathe(&span, 48, &shapes::lobed(16, 0.03), 0.1)
        } else {
            shapes::lathe(&span, 32, &shapes::superellipse(Vec2::new(1.0, oval), 2.0), 0.1)
        };
        a.add(part, CREASE);
    }
    if s.chance(0.15) {
        let (low, high) = (0.3 * h, 0.8 * h);
        ear(a, s, r * 0.97, r * 0.97, low, high, 0.2, body, FRAC_PI_2);
    }
}

pub fn carton(a: &mut Assembly, s: &mut Style) {
    let scheme = s.scheme();
    let half = Vec3::new(s.log(0.15, 0.6), s.log(0.08, 0.5), s.log(0.15, 0.8));
    let faces: [u16; 6] = if s.chance(0.8) {
        let (side, top) = (half.y / half.z, half.x / half.y);
        let front = half.x / half.z;
        let second_side = if s.chance(0.5) { Face::Side } else { Face::Back };
        let second_front = if s.chance(0.6) { Face::Front } else { Face::Back };
        let faces = [
            s.print(&scheme, Face::Side, side),
            s.print(&scheme, second_side, side),
            s.print(&scheme, second_front, front),
            s.print(&scheme, Face::Front, front),
            s.print(&scheme, Face::Side, top),
            if s.chance(0.5) { s.plain(scheme.ground) } else { s.print(&scheme, Face::Back, top) },
        ];
        // One sheet of card has one finish.
        let (specular, roughness) = (faces[0].specular, faces[0].roughness);
        faces.map(|m| a.material(Material { specular, roughness, ..m }))
    } else {
        let m = s.material();
        [a.material(m); 6]
    };
    let radius = if s.chance(0.5) { 0.004 } else { s.log(0.01, 0.12) };
    let mut part = shapes::rounded_box(half, radius, faces);
    if s.chance(0.3) {
        // A gable or a squeezed top, as milk cartons and bags have it.
        let (start, pinch) = (s.range(0.3, 0.8) * half.z, s.range(0.05, 0.6));
        part.map(|p| {
            let t = ((p.z - start) / (half.z - start)).clamp(0.0, 1.0);
            Vec3::new(p.x, p.y * (1.0 - t * (1.0 - pinch)), p.z)
        });
    }
    if s.chance(0.35) {
        // Dented or bulging walls.
        let (amplitude, seed) = (s.range(0.005, 0.05), rand::Rng::random(&mut s.rng));
        part.map(|p| p + amplitude * crate::noise::vector(p * 3.0, seed, 2));
    }
    a.add(part, 40.0);
    if s.chance(0.15) {
        let m = s.material();
        let m = a.material(m);
        let r = 0.35 * half.x.min(half.y);
        let points =
            [Vec2::new(0.0, 0.0), Vec2::new(r, 0.0), Vec2::new(r, 0.5 * r + 0.05), Vec2::new(0.0, 0.5 * r + 0.05)];
        let cap = shapes::lathe(&[Span { points: points.to_vec(), material: m }], 28, &shapes::round, 0.1);
        let x = s.range(-0.3, 0.3) * half.x;
        a.add(cap.moved(Vec3::new(x, 0.0, half.z * 0.99)), CREASE);
    }
}

pub fn pan(a: &mut Assembly, s: &mut Style) {
    let body = match s.count(0, 10) {
        0..5 => {
            let dark = palette::color(&mut s.rng, Tone::Dark);
            s.plain(dark)
        }
        5..8 => s.metal(),
        _ => s.material(),
    };
    let inside = if s.chance(0.6) { body.clone() } else { s.material() };
    let grip = match s.count(0, 4) {
        0 => body.clone(),
        1 => {
            let wood = s.wood();
            s.finish(wood)
        }
        2 => s.metal(),
        _ => s.dark_plastic(),
    };
    let rim = if s.chance(0.4) { s.metal() } else { body.clone() };
    let [body, inside, grip, rim] = [body, inside, grip, rim].map(|m| a.material(m));
    let r = 0.5;
    let h = if s.chance(0.6) { s.range(0.08, 0.22) } else { s.range(0.25, 0.7) };
    let base = r * s.range(0.65, 0.97);
    let wall = s.range(0.012, 0.03);
    let flare = s.range(0.04, 0.25).min(0.8 * h);
    let outer = shapes::fillet(&[Vec2::new(0.0, 0.0), Vec2::new(base, 0.0), Vec2::new(r, h)], flare, 5);
    let edge =
        vec![Vec2::new(r, h), Vec2::new(r + 0.3 * wall, h + 0.6 * wall), Vec2::new(r - 0.8 * wall, h + 0.6 * wall)];
    let inner = shapes::fillet(&[edge[2], Vec2::new(base - wall, wall), Vec2::new(0.0, wall)], flare, 5);
    let spans = [
        Span { points: outer, material: body },
        Span { points: edge, material: rim },
        Span { points: inner, material: inside },
    ];
    a.add(shapes::lathe(&spans, 44, &shapes::round, 0.11), CREASE);
    let start = h * s.range(0.55, 0.95);
    let root = base + (r - base) * start / h;
    if s.chance(0.7) {
        let (length, rise, sag) = (s.range(0.45, 1.1), s.range(-0.02, 0.3), s.range(-0.08, 0.08));
        let path: Vec<Vec3> = (0..=12)
            .map(|i| {
                let t = i as f32 / 12.0;
                Vec3::new(
                    root - 0.4 * wall + length * t,
                    0.0,
                    start + rise * t + sag * (std::f32::consts::PI * t).sin(),
                )
            })
            .collect();
        let (thick, wide) = (s.range(0.012, 0.035), s.range(0.025, 0.07));
        let swell = s.range(0.0, 0.6);
        let half = move |t: f32| Vec2::new(wide * (0.7 + swell * t * (1.6 - t)), thick * (1.0 + 0.3 * swell * t));
        let exponent = s.range(2.0, 5.0);
        a.add(shapes::tube(&path, Vec3::Z, half, exponent, 16, grip), 50.0);
    } else {
        for side in 0..2 {
            let angle = FRAC_PI_2 * (2 * side) as f32;
            let (width, reach) = (s.range(0.12, 0.2), s.range(0.1, 0.2));
            let path = shapes::arc(
                Vec3::new(root - 0.01, 0.0, start),
                Vec3::Y * width,
                Vec3::X * reach,
                0.0,
                std::f32::consts::PI,
                14,
            );
            let thick = s.range(0.015, 0.035);
            let part = shapes::tube(&path, Vec3::Z, |_| Vec2::splat(thick), 2.0, 12, grip);
            a.add(part.rotated(Quat::from_rotation_z(angle)), 50.0);
        }
        if s.chance(0.4) {
            // A lid with a knob.
            let z = h + 0.5 * wall;
            let dome = s.range(0.03, 0.2);
            let points =
                [Vec2::new(0.0, z), Vec2::new(r, z), Vec2::new(0.6 * r, z + 0.75 * dome), Vec2::new(0.0, z + dome)];
            let lid = [Span { points: shapes::fillet(&points, 0.1, 4), material: body }];
            a.add(shapes::lathe(&lid, 40, &shapes::round, 0.12), CREASE);
            let k = s.range(0.04, 0.09);
            let knob = shapes::superquadric(Vec3::new(k, k, 0.8 * k), 0.8, 1.0, 12, grip);
            a.add(knob.moved(Vec3::new(0.0, 0.0, z + dome + 0.5 * k)), CREASE);
        }
    }
}
