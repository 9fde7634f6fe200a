//! Food, thin-walled and barred things, tools, stacked pieces.

use std::f32::consts::{PI, TAU};

use glam::{Affine3A, Quat, Vec2, Vec3};
use rand::Rng;

use crate::generate::label::Face;
use crate::generate::palette::{self, Tone};
use crate::generate::part::Assembly;
use crate::generate::primitive::{deform, primitive};
use crate::generate::shapes::{self, Span};
use crate::generate::style::Style;
use crate::mesh::Texture;
use crate::mesh::noise;

/// The skin of fruit: two related hues with spots or streaks.
fn skin(s: &mut Style) -> Texture {
    let hue = match s.count(0, 8) {
        0..2 => s.range(-0.02, 0.03),
        2..4 => s.range(0.05, 0.11),
        4..6 => s.range(0.12, 0.17),
        6 => s.range(0.18, 0.3),
        _ => s.range(-0.05, 0.2),
    };
    let a = palette::hsv(hue, s.range(0.55, 0.95), s.range(0.5, 0.98));
    let b = palette::hsv(hue + s.range(-0.06, 0.06), s.range(0.4, 0.9), s.range(0.35, 0.95));
    let seed = s.rng.random();
    match s.count(0, 5) {
        0 => Texture::Gradient { a, b, direction: Vec3::Z, range: [s.range(-0.5, -0.1), s.range(0.1, 0.5)] },
        1 => Texture::Dots { a, b, scale: s.log(12.0, 40.0), radius: s.range(0.12, 0.3), seed },
        _ => {
            let along = s.log(0.15, 1.0);
            let scale = s.log(2.0, 30.0) * Vec3::new(1.0, 1.0, along);
            Texture::Noise { a, b, scale, octaves: 4, contrast: s.range(1.0, 3.0), seed }
        }
    }
}

pub fn fruit(a: &mut Assembly, s: &mut Style) {
    let texture = skin(s);
    let body = s.finish(texture);
    let stem = palette::color(&mut s.rng, Tone::Brown);
    let stem = s.plain(stem);
    let [body, stem] = [body, stem].map(|m| a.material(m));
    let seed = s.rng.random();
    let mut end = Vec3::Z;
    match s.count(0, 4) {
        0 => {
            // Long and bent: banana, cucumber, carrot.
            let (bend, r) = (s.range(0.0, 1.6), s.range(0.12, 0.28));
            let path: Vec<Vec3> = (0..=24)
                .map(|i| {
                    let t = i as f32 / 12.0 - 1.0;
                    Vec3::new(bend * 0.4 * (t * t - 0.5), 0.0, t)
                })
                .collect();
            let (taper, sharp) = (s.range(0.0, 0.6), s.range(2.0, 6.0));
            let corners = s.chance(0.4);
            let profile = move |t: f32| {
                let x = 2.0 * t - 1.0;
                Vec2::splat(r * (1.0 - x.abs().powf(sharp)).max(0.02).sqrt() * (1.0 - taper * t))
            };
            let mut part = shapes::tube(&path, Vec3::X, profile, 2.0, 20, body);
            if corners {
                part.map(|p| p + 0.06 * r * noise::vector(p * 3.0, seed, 1));
            }
            end = path[24];
            a.add(part, 60.0);
        }
        1 => {
            // Pear, aubergine, squash: a turned profile.
            let (top, waist) = (s.range(0.15, 0.6), s.range(0.25, 0.8));
            let points = [
                Vec2::new(0.0, -0.95),
                Vec2::new(0.5, -0.85),
                Vec2::new(0.8, -0.35),
                Vec2::new(waist, 0.35),
                Vec2::new(top, 0.8),
                Vec2::new(0.0, 0.97),
            ];
            let points: Vec<Vec2> =
                shapes::smooth(&points, 4).into_iter().map(|p| p.max(Vec2::new(0.0, -2.0))).collect();
            let span = [Span { points, material: body }];
            let lobes = s.count(3, 10);
            let section = shapes::lobed(lobes, if s.chance(0.4) { s.range(0.02, 0.12) } else { 0.0 });
            let mut part = shapes::lathe(&span, 40, &section, 0.2);
            part.map(|p| p + 0.05 * noise::vector(p * 1.5, seed, 2));
            a.add(part, 60.0);
        }
        _ => {
            // Round: apple, orange, lemon, potato, tomato.
            let half = Vec3::new(1.0, s.range(0.8, 1.0), s.range(0.65, 1.5));
            let (dimple, tip, bump) = (s.range(0.0, 0.35), s.range(-0.1, 0.3), s.range(0.0, 0.12));
            let mut part = shapes::superquadric(half, s.range(0.8, 1.1), s.range(0.9, 1.1), 28, body);
            part.map(|p| {
                let pole = (1.0 - Vec2::new(p.x, p.y).length() / 0.6).max(0.0);
                let z = p.z - p.z.signum() * pole * pole * (dimple - tip.max(0.0) * 0.8);
                Vec3::new(p.x, p.y, z) + bump * noise::vector(p * 1.8, seed, 2)
            });
            end = Vec3::Z * (half.z - dimple + tip.max(0.0) * 0.8);
            a.add(part, 60.0);
        }
    }
    if s.chance(0.5) {
        let length = s.range(0.1, 0.35);
        let lean = Vec3::new(s.range(-0.1, 0.1), s.range(-0.1, 0.1), length);
        let path: Vec<Vec3> = (0..=5).map(|i| end - 0.1 * Vec3::Z + lean * i as f32 / 5.0 * 1.4).collect();
        let r = s.range(0.02, 0.06);
        a.add(shapes::tube(&path, Vec3::X, |t| Vec2::splat(r * (0.7 + 0.5 * t)), 2.0, 10, stem), 50.0);
    }
}

pub fn loaf(a: &mut Assembly, s: &mut Style) {
    let crust = palette::hsv(s.range(0.04, 0.1), s.range(0.5, 0.85), s.range(0.35, 0.8));
    let crumb = palette::hsv(s.range(0.08, 0.14), s.range(0.2, 0.55), s.range(0.75, 0.98));
    let inner = palette::shade(&mut s.rng, crumb, 0.3);
    let [crust, crumb] = [s.crumb(crust, 0.5 * (crust + crumb)), s.crumb(inner, crumb)].map(|m| a.material(m));
    let seed = s.rng.random();
    let half = Vec3::new(s.log(0.3, 1.0), s.log(0.25, 0.6), s.log(0.2, 0.6));
    let mut part = if s.chance(0.6) {
        let ends = if s.chance(0.5) { crumb } else { crust };
        shapes::rounded_box(half, s.range(0.02, 0.3), [ends, ends, crust, crust, crust, crust])
    } else {
        shapes::superquadric(half, s.range(0.5, 1.0), s.range(0.5, 1.0), 26, crust)
    };
    let (swell, sag, bumps, frequency) = (s.range(0.0, 0.5), s.range(0.0, 0.3), s.range(0.01, 0.06), s.log(2.0, 7.0));
    let slashes = if s.chance(0.4) { s.range(6.0, 16.0) } else { 0.0 };
    part.map(|p| {
        let up = (p.z / half.z * 0.5 + 0.5).clamp(0.0, 1.0);
        let round = 1.0 - (p.y / half.y).powi(2) * sag * up;
        let slash = if slashes > 0.0 { 0.04 * up * (slashes * (p.x + 0.4 * p.y)).sin() } else { 0.0 };
        let q = Vec3::new(p.x, p.y * (1.0 + swell * up * up), p.z * round + slash);
        q + bumps * noise::vector(p * frequency, seed, 3)
    });
    a.add(part, 50.0);
    if s.chance(0.2) {
        // A slice next to it.
        let slice = shapes::rounded_box(
            Vec3::new(0.06, half.y * 0.95, half.z * 0.9),
            0.03,
            [crumb, crumb, crust, crust, crust, crust],
        );
        let tilt = Quat::from_rotation_y(s.range(-0.5, 0.5));
        let x = half.x + s.range(0.05, 0.3);
        a.add(slice.transformed(Affine3A::from_rotation_translation(tilt, Vec3::new(x, 0.0, 0.0))), 50.0);
    }
}

pub fn basket(a: &mut Assembly, s: &mut Style) {
    let m = s.material();
    let inside = if s.chance(0.7) { m.clone() } else { s.material() };
    let m = [a.material(m), a.material(inside)];
    let (h, wall) = (s.range(0.25, 1.0), s.range(0.02, 0.05));
    let top = Vec2::new(s.range(0.4, 0.8), s.range(0.35, 0.6));
    let taper = s.range(0.65, 1.0);
    let exponent = if s.chance(0.35) { 2.0 } else { s.range(4.0, 14.0) };
    let section = shapes::superellipse(Vec2::ONE, exponent);
    // Rows: floor, then the wall. The wall's holes repeat along both directions.
    let (nu, floor_rows, rows) = (48, 4, s.count(8, 14));
    let nv = floor_rows + rows;
    let body = |u: f32, v: f32, inset: f32| {
        let j = v * nv as f32;
        let c = section(TAU * u);
        let bottom = top * taper;
        if j < floor_rows as f32 + 0.5 {
            let reach = (j / floor_rows as f32).min(1.0);
            (c * (bottom - inset) * reach).extend(inset)
        } else {
            let t = (j - floor_rows as f32) / rows as f32;
            (c * (bottom.lerp(top, t) - inset)).extend((h * t).max(inset))
        }
    };
    let style = s.count(0, 4);
    let (pu, pv) = (s.count(2, 6), s.count(2, 5));
    let grip = (s.count(2, 5), rows.saturating_sub(s.count(2, 4)));
    let keep = move |i: usize, j: usize| {
        if j < floor_rows {
            return true;
        }
        let row = j - floor_rows;
        match style {
            // Plain walls.
            0 => true,
            // Two grip holes.
            1 => !((i + grip.0) % (nu / 2) < 2 * grip.0 && row == grip.1),
            // Slots all around.
            2 => row == 0 || row + 2 >= rows || i.is_multiple_of(pu),
            // A lattice.
            _ => row == 0 || row + 1 >= rows || i.is_multiple_of(pu) || row.is_multiple_of(pv),
        }
    };
    a.add(shapes::shell([nu, nv], true, |u, v| body(u, v, 0.0), |u, v| body(u, v, wall), keep, m), 40.0);
    if s.chance(0.35) {
        let half = Vec3::new(0.5 * wall, top.y * taper * 0.96, 0.45 * h);
        let wall = shapes::rounded_box(half, 0.01, [m[1]; 6]);
        a.add(wall.moved(Vec3::new(s.range(-0.3, 0.3) * top.x, 0.0, 0.5 * h)), 40.0);
    }
    if s.chance(0.3) {
        let grip = s.material();
        let grip = a.material(grip);
        let lift = s.range(0.3, 0.8);
        let path = shapes::arc(Vec3::Z * h * 0.95, Vec3::Y * (top.y - 0.5 * wall), Vec3::Z * lift, 0.0, PI, 20);
        let r = s.range(0.015, 0.035);
        a.add(shapes::tube(&path, Vec3::X, |_| Vec2::splat(r), 2.0, 10, grip), 50.0);
    }
}

pub fn rack(a: &mut Assembly, s: &mut Style) {
    let bars = if s.chance(0.5) { s.metal() } else { s.material() };
    let frame = if s.chance(0.6) { bars.clone() } else { s.material() };
    let [bars, frame] = [bars, frame].map(|m| a.material(m));
    let half = Vec3::new(s.range(0.35, 0.8), s.range(0.25, 0.6), s.range(0.1, 0.45));
    let r = s.range(0.012, 0.035);
    let exponent = if s.chance(0.6) { 2.0 } else { 8.0 };
    let bar = |from: Vec3, to: Vec3, m: u16, r: f32| {
        let path: Vec<Vec3> = (0..=4).map(|i| from.lerp(to, i as f32 / 4.0)).collect();
        let up = if (to - from).normalize_or_zero().z.abs() > 0.9 { Vec3::X } else { Vec3::Z };
        shapes::tube(&path, up, |_| Vec2::splat(r), exponent, 8, m)
    };
    let corner = |x: f32, y: f32, z: f32| Vec3::new(x * half.x, y * half.y, z * half.z);
    let levels: &[f32] = if s.chance(0.5) { &[-1.0, 1.0] } else { &[0.0] };
    let thick = r * s.range(1.0, 1.8);
    for &z in levels {
        for side in [-1.0, 1.0] {
            a.add(bar(corner(-1.0, side, z), corner(1.0, side, z), frame, thick), 50.0);
            a.add(bar(corner(side, -1.0, z), corner(side, 1.0, z), frame, thick), 50.0);
        }
    }
    for (x, y) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
        a.add(bar(corner(x, y, -1.0), corner(x, y, 1.0), frame, thick), 50.0);
    }
    let n = s.count(4, 13);
    let upright = s.chance(0.4);
    for i in 0..n {
        let x = 1.8 * (i as f32 + 0.5) / n as f32 - 0.9;
        a.add(bar(corner(x, -1.0, levels[0]), corner(x, 1.0, levels[0]), bars, r), 50.0);
        if upright {
            for y in [-0.5, 0.5] {
                a.add(bar(corner(x, y, levels[0]), corner(x, y, 1.0), bars, r), 50.0);
            }
        }
    }
    if s.chance(0.3) {
        let board = s.material();
        let board = a.material(board);
        let plate = shapes::rounded_box(Vec3::new(half.x, half.y, 0.02), 0.01, [board; 6]);
        a.add(plate.moved(Vec3::new(0.0, 0.0, -half.z)), 40.0);
    }
}

pub fn utensil(a: &mut Assembly, s: &mut Style) {
    let grip = match s.count(0, 3) {
        0 => {
            let wood = s.wood();
            s.finish(wood)
        }
        1 => s.dark_plastic(),
        _ => s.material(),
    };
    let head = match s.count(0, 3) {
        0 => grip.clone(),
        1 => s.metal(),
        _ => s.material(),
    };
    let m = [a.material(grip), a.material(head)];
    let (length, r) = (s.range(0.7, 1.4), s.range(0.03, 0.1));
    let (flat, swell, bend) = (s.log(0.4, 1.0), s.range(-0.4, 0.6), s.range(-0.15, 0.15));
    let path: Vec<Vec3> = (0..=16)
        .map(|i| {
            let t = i as f32 / 16.0;
            Vec3::new(0.0, bend * (PI * t).sin(), length * (t - 1.0))
        })
        .collect();
    let half = move |t: f32| Vec2::new(r, r * flat) * (1.0 + swell * (2.0 * PI * t).cos() * 0.5);
    let exponent = if s.chance(0.6) { 2.0 } else { 4.0 };
    a.add(shapes::tube(&path, Vec3::Y, half, exponent, 16, m[0]), 50.0);
    match s.count(0, 4) {
        0 => {
            // A spoon or ladle: a thin dish.
            let (w, l, deep) = (s.range(0.12, 0.3), s.range(0.18, 0.4), s.range(0.02, 0.2));
            let dish = move |u: f32, v: f32, lift: f32| {
                let (x, z) = (2.0 * u - 1.0, 2.0 * v - 1.0);
                // A square mapped to a disc.
                let (dx, dz) = (x * (1.0 - 0.5 * z * z).sqrt(), z * (1.0 - 0.5 * x * x).sqrt());
                Vec3::new(w * dx, deep * (dx * dx + dz * dz - 0.6) + lift, l * (dz + 0.95))
            };
            let t = s.range(0.01, 0.02);
            a.add(
                shapes::shell([18, 18], false, |u, v| dish(u, v, -t), |u, v| dish(u, v, t), |_, _| true, [m[1]; 2]),
                50.0,
            );
        }
        1 => {
            // A blade, turner or paddle, perhaps slotted.
            let (w, l, t) = (s.range(0.08, 0.35), s.range(0.3, 0.8), s.range(0.008, 0.03));
            let (slots, curve, point) = (s.chance(0.4), s.range(-0.1, 0.1), s.range(0.0, 0.9));
            let plate = move |u: f32, v: f32, lift: f32| {
                let x = (2.0 * u - 1.0) * w * (1.0 - point * v * v);
                Vec3::new(x, curve * v * v + lift * (1.0 - 0.6 * (2.0 * u - 1.0).abs()), l * v - 0.03)
            };
            let keep = move |i: usize, j: usize| !slots || i % 3 != 1 || !(2..8).contains(&j);
            a.add(shapes::shell([10, 10], false, |u, v| plate(u, v, -t), |u, v| plate(u, v, t), keep, [m[1]; 2]), 40.0);
        }
        2 => {
            // A hammer or brush: a block across.
            let half = Vec3::new(s.range(0.1, 0.45), s.range(0.06, 0.15), s.range(0.05, 0.15));
            let part = shapes::rounded_box(half, s.range(0.005, 0.05), [m[1]; 6]);
            a.add(part.moved(Vec3::new(s.range(-0.1, 0.1), 0.0, half.z * 0.5)), 45.0);
        }
        _ => {
            let (part, crease) = primitive(s, [m[1], m[0]]);
            let size = Vec3::new(s.log(0.08, 0.35), s.log(0.05, 0.3), s.log(0.08, 0.4));
            a.add(
                part.transformed(Affine3A::from_scale_rotation_translation(
                    size,
                    Quat::IDENTITY,
                    Vec3::Z * size.z * 0.8,
                )),
                crease,
            );
        }
    }
}

/// Pieces on one axis, from large to small or not: toys, lamps, figures, furniture.
pub fn stack(a: &mut Assembly, s: &mut Style) {
    let scheme = s.scheme();
    let mut palette = [s.material(), s.material(), s.material()];
    if s.chance(0.3) {
        let product = s.product(&scheme);
        palette[0] = s.print(&product, Face::Wrap, Vec2::new(0.6, 0.3));
    }
    let m = palette.map(|m| a.material(m));
    let (mut z, mut width, mut on_legs) = (0.0f32, 0.25f32, false);
    let pieces = s.count(2, 6);
    for _ in 0..pieces {
        let size = Vec3::new(s.log(0.12, 0.6), s.log(0.12, 0.6), s.log(0.06, 0.5));
        let size = if s.chance(0.6) { Vec3::new(size.x, size.x, size.z) } else { size };
        let size = if on_legs { size.max(Vec3::new(width, width, 0.0)) } else { size };
        let pick = s.count(0, 3);
        let (mut part, crease) = primitive(s, [m[pick], m[(pick + 1) % 3]]);
        if s.chance(0.15) {
            deform(s, &mut part);
        }
        // What the piece really occupies of its unit cube decides where it stands.
        let (low, high) = part.bounds();
        let shift = Vec3::new(s.range(-0.05, 0.05), s.range(-0.05, 0.05), z - low.z * size.z);
        // Legs, wheels, arms: copies around the axis, within the reach of the pieces above and below.
        let copies = if s.chance(0.2) { s.count(2, 5) } else { 1 };
        for c in 0..copies {
            if a.triangle_count() > 6500 {
                break;
            }
            let around = Quat::from_rotation_z(TAU * c as f32 / copies as f32);
            let (out, slim) = if copies > 1 { (around * Vec3::X * 0.65 * width, 0.4) } else { (Vec3::ZERO, 1.0) };
            let scale = Vec3::new(size.x * slim, size.y * slim, size.z);
            a.add(
                part.clone().transformed(Affine3A::from_scale_rotation_translation(scale, around, shift + out)),
                crease,
            );
        }
        on_legs = copies > 1;
        if !on_legs {
            width = size.x.min(size.y);
        }
        z += (high.z - low.z) * size.z * s.range(0.75, 0.98);
    }
}
