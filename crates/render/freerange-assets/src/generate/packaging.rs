//! Printed packaging with hard walls: cans, cartons, open boxes, books.

use std::f32::consts::{PI, TAU};

use glam::{Affine3A, Quat, Vec2, Vec3};
use rand::Rng;

use crate::generate::caps::{CREASE, screw_cap};
use crate::generate::handles;
use crate::generate::label::{Face, Product, Scheme};
use crate::generate::palette::{self, Tone};
use crate::generate::part::{Assembly, Part};
use crate::generate::shapes::{self, Span};
use crate::generate::style::Style;
use crate::mesh::Material;
use crate::mesh::noise;

pub fn can(a: &mut Assembly, s: &mut Style) {
    let scheme = s.scheme();
    let product = s.product(&scheme);
    let (r, h) = (0.4, s.log(0.3, 1.6));
    let label = s.print(&product, Face::Wrap, Vec2::new(1.2, (1.2 * h / (TAU * r)).clamp(0.2, 0.9)));
    let metal = if s.chance(0.85) { s.metal() } else { s.plain(scheme.ground) };
    let lid = if s.chance(0.15) { s.plain(scheme.accent) } else { metal.clone() };
    let [label, metal, lid] = [label, metal, lid].map(|m| a.material(m));
    let (bead, inset) = (s.range(0.008, 0.025), s.range(0.015, 0.05));
    let (low, high) = (s.range(0.02, 0.08) * h + 0.03, h - s.range(0.02, 0.08) * h - 0.03);
    let bottom = vec![
        Vec2::new(0.0, inset),
        Vec2::new(r - 0.05, inset),
        Vec2::new(r - 0.02, 0.0),
        Vec2::new(r + bead, 0.0),
        Vec2::new(r + bead, 0.022),
        Vec2::new(r, 0.03),
        Vec2::new(r, low),
    ];
    let drink = s.chance(0.3);
    let top: Vec<Vec2> = if drink {
        let neck = r * s.range(0.75, 0.9);
        vec![
            Vec2::new(r, high),
            Vec2::new(0.5 * (r + neck) + 0.015, h - 0.01),
            Vec2::new(neck, h + 0.03),
            Vec2::new(neck, h + 0.05),
            Vec2::new(neck - 0.02, h + 0.05),
            Vec2::new(neck - 0.03, h + 0.01),
            Vec2::new(0.0, h + 0.01),
        ]
    } else {
        // Steps pressed into the lid.
        vec![
            Vec2::new(r, high),
            Vec2::new(r, h - 0.03),
            Vec2::new(r + bead, h - 0.022),
            Vec2::new(r + bead, h),
            Vec2::new(r - 0.02, h),
            Vec2::new(r - 0.03, h - inset),
            Vec2::new(0.8 * r, h - inset),
            Vec2::new(0.77 * r, h - inset + 0.012),
            Vec2::new(0.6 * r, h - inset + 0.012),
            Vec2::new(0.57 * r, h - inset),
            Vec2::new(0.0, h - inset),
        ]
    };
    let lid_z = top[top.len() - 1].y;
    let body = vec![bottom[bottom.len() - 1], top[0]];
    let ribs = if s.chance(0.4) { Some((s.range(16.0, 30.0), s.range(0.003, 0.007))) } else { None };
    let spans = [
        Span { points: bottom, material: metal },
        Span { points: body, material: label },
        Span { points: top, material: lid },
    ];
    let part = match ribs {
        Some((rate, depth)) => {
            let span = high - low;
            let (from, to) = (low + 0.2 * span, high - 0.2 * span);
            let mut fine = spans.to_vec();
            fine[1].points = shapes::subdivide(&spans[1].points, 0.025);
            shapes::lathe_with(&fine, 44, &shapes::round, 0.2, &move |i, _, p| {
                let fade = ((p.y - from) / 0.04).clamp(0.0, 1.0) * ((to - p.y) / 0.04).clamp(0.0, 1.0);
                if i == 1 { depth * fade * (TAU * rate * p.y).sin() } else { 0.0 }
            })
        }
        None => shapes::lathe(&spans, 44, &shapes::round, 0.14),
    };
    a.add(part, 40.0);
    if s.chance(0.6) {
        // A pull tab: a flat ring on a rivet.
        let size = s.range(0.07, 0.11);
        let ring = shapes::torus(size, Vec2::new(0.028, 0.008), 3.0, [20, 8], metal);
        let out = s.range(0.1, 0.4) * r;
        let flat = Affine3A::from_scale(Vec3::new(1.35, 0.9, 1.0));
        a.add(ring.transformed(flat).moved(Vec3::new(out, 0.0, lid_z + 0.014)), 50.0);
        let rivet = shapes::superquadric(Vec3::new(0.035, 0.035, 0.02), 0.7, 1.0, 8, metal);
        a.add(rivet.moved(Vec3::new(out - 1.45 * size, 0.0, lid_z + 0.006)), 50.0);
    }
}

/// Prints for the six sides of a box; opposite sides may share theirs. The box is `half`, at most about 0.8.
fn sides(s: &mut Style, scheme: &Scheme, half: Vec3) -> [Material; 6] {
    let product: Product = s.product(scheme);
    let scale = 0.5 / half.max_element();
    let [x, y, z] = (2.0 * scale * half).to_array();
    let front = s.print(&product, Face::Front, Vec2::new(x, z));
    let rear = if s.chance(0.5) { front.clone() } else { s.print(&product, Face::Back, Vec2::new(x, z)) };
    let left = s.print(&product, Face::Side, Vec2::new(y, z));
    let right = match s.count(0, 10) {
        0..4 => left.clone(),
        4..7 => s.print(&product, Face::Back, Vec2::new(y, z)),
        _ => s.print(&product, Face::Side, Vec2::new(y, z)),
    };
    let top = s.print(&product, Face::Side, Vec2::new(x, y));
    let below = match s.count(0, 3) {
        0 => s.plain(scheme.ground),
        1 => top.clone(),
        _ => s.print(&product, Face::Back, Vec2::new(x, y)),
    };
    // One sheet of card has one finish.
    let (specular, roughness) = (front.specular, front.roughness);
    [left, right, rear, front, top, below].map(|m| Material { specular, roughness, ..m })
}

pub fn carton(a: &mut Assembly, s: &mut Style) {
    let scheme = s.scheme();
    let half = Vec3::new(s.log(0.15, 0.6), s.log(0.08, 0.45), s.log(0.15, 0.8));
    let faces: [u16; 6] = if s.chance(0.88) {
        sides(s, &scheme, half).map(|m| a.material(m))
    } else {
        let m = s.material();
        [a.material(m); 6]
    };
    let gable = s.chance(0.22);
    let radius = if s.chance(0.75) { s.log(0.005, 0.02) } else { s.log(0.02, 0.1) };
    let mut part = shapes::rounded_box(half, radius, faces);
    if gable {
        // A milk carton: the top folds to a ridge, closed by an upright fin.
        let start = half.z * s.range(0.35, 0.7);
        part.map(|p| {
            let t = ((p.z - start) / (half.z - start)).clamp(0.0, 1.0);
            Vec3::new(p.x, p.y * (1.0 - 0.95 * t), p.z)
        });
        let tall = s.range(0.05, 0.1);
        let fin = shapes::rounded_box(Vec3::new(half.x * 0.995, 0.012, tall), 0.004, [faces[4]; 6]);
        a.add(fin.moved(Vec3::new(0.0, 0.0, half.z + 0.6 * tall)), 40.0);
        if s.chance(0.4) {
            let m = s.plain(scheme.accent);
            let m = a.material(m);
            let base = Assembly::default();
            let mut cap = base;
            let r = 0.3 * half.x.min(half.y);
            screw_cap(&mut cap, s, r, 0.0, 0.7 * r + 0.02, m);
            let slope = (half.y * 0.95).atan2(half.z - start);
            let tilt = Quat::from_rotation_x(0.5 * PI - slope);
            let middle = Vec3::new(0.0, -0.53 * half.y, 0.5 * (start + half.z));
            for part in cap.parts().cloned().collect::<Vec<Part>>() {
                a.add(part.transformed(Affine3A::from_rotation_translation(tilt, middle)), CREASE);
            }
        }
    } else if s.chance(0.3) {
        // A lid flap over the front, or tucked ends: thin sheets proud of the box.
        let lift = s.range(0.2, 0.9);
        let sheet = shapes::rounded_box(Vec3::new(half.x * 0.995, half.y, 0.004), 0.002, [faces[4]; 6]);
        let hinge = Affine3A::from_translation(Vec3::new(0.0, half.y, half.z))
            * Affine3A::from_rotation_x(-lift * 0.25)
            * Affine3A::from_translation(Vec3::new(0.0, -half.y, 0.004));
        a.add(sheet.transformed(hinge), 40.0);
    }
    if s.chance(0.35) {
        // Dented or bulging walls.
        let (amplitude, seed) = (s.range(0.004, 0.02), s.rng.random());
        part.map(|p| p + amplitude * noise::vector(p * 3.0, seed, 2));
    }
    a.add(part, 40.0);
}

/// A box without top, or with its flaps open, and perhaps something in it.
pub fn open_box(a: &mut Assembly, s: &mut Style) {
    let scheme = s.scheme();
    let half = Vec3::new(s.range(0.3, 0.6), s.range(0.2, 0.5), s.range(0.12, 0.5));
    let outside = if s.chance(0.6) {
        sides(s, &scheme, half)
    } else {
        let brown = palette::color(&mut s.rng, Tone::Brown);
        let m = if s.chance(0.5) { s.plain(brown) } else { s.material() };
        std::array::from_fn(|_| m.clone())
    };
    let kraft = palette::hsv(s.range(0.07, 0.1), s.range(0.2, 0.45), s.range(0.6, 0.85));
    let card = s.plain(kraft);
    let faces = outside.map(|m| a.material(m));
    let card = a.material(card);
    let t = s.range(0.008, 0.02);
    // Four walls and a floor, each a thin slab with its print outside.
    let slab = |h: Vec3, at: Vec3, face: usize| {
        let mut m = [card; 6];
        m[face] = faces[face];
        shapes::rounded_box(h, 0.4 * t, m).moved(at)
    };
    for (face, side) in [(0, 1.0), (1, -1.0)] {
        a.add(slab(Vec3::new(t, half.y, half.z), Vec3::new(side * (half.x - t), 0.0, 0.0), face), 40.0);
    }
    for (face, side) in [(2, 1.0), (3, -1.0)] {
        let h = Vec3::new(half.x - 2.0 * t + 0.001, t, half.z);
        a.add(slab(h, Vec3::new(0.0, side * (half.y - t), 0.0), face), 40.0);
    }
    let floor = Vec3::new(half.x - 2.0 * t + 0.001, half.y - 2.0 * t + 0.001, t);
    a.add(slab(floor, Vec3::new(0.0, 0.0, t - half.z), 5), 40.0);
    if s.chance(0.7) {
        // Flaps hinge at the upper edges; a chest has one lid.
        let lid = s.chance(0.5);
        for (k, turn) in [0.0, 0.5 * PI, PI, 1.5 * PI].into_iter().enumerate() {
            if lid && k != 1 {
                continue;
            }
            let (reach, width) = if k % 2 == 0 { (half.x, half.y) } else { (half.y, half.x) };
            let long = if lid { 2.0 * reach } else { reach.min(0.9 * half.y) };
            let open = s.range(0.2, 1.9);
            let flap = shapes::rounded_box(
                Vec3::new(0.5 * long, 0.985 * width, 0.6 * t),
                0.3 * t,
                [card, card, card, card, card, faces[4]],
            );
            let place = Affine3A::from_rotation_z(turn)
                * Affine3A::from_translation(Vec3::new(reach - 0.4 * t, 0.0, half.z))
                * Affine3A::from_rotation_y(-open)
                * Affine3A::from_translation(Vec3::new(0.5 * long, 0.0, 0.0));
            a.add(flap.transformed(place), 40.0);
        }
    }
    for _ in 0..s.count(0, 5) {
        // Contents: balls and blocks lying on the floor.
        let m = s.material();
        let m = a.material(m);
        let r = s.range(0.25, 0.45) * half.min_element();
        let (x, y) = (
            s.range(-1.0, 1.0) * (half.x - r - 3.0 * t).max(0.0),
            s.range(-1.0, 1.0) * (half.y - r - 3.0 * t).max(0.0),
        );
        let part = if s.chance(0.5) {
            shapes::superquadric(Vec3::splat(r), 1.0, 1.0, 14, m)
        } else {
            shapes::rounded_box(Vec3::new(0.7 * r, 0.6 * r, r), 0.1 * r, [m; 6])
        };
        a.add(
            part.rotated(Quat::from_rotation_z(s.range(0.0, TAU))).moved(Vec3::new(x, y, r - half.z + 1.5 * t)),
            45.0,
        );
    }
}

/// Books and stacks of them: printed cover, pages set back inside.
pub fn book(a: &mut Assembly, s: &mut Style) {
    let count = if s.chance(0.65) { 1 } else { s.count(2, 5) };
    let mut z = 0.0;
    for k in 0..count {
        let scheme = s.scheme();
        let product = s.product(&scheme);
        let half = Vec3::new(s.range(0.3, 0.45), s.range(0.4, 0.6), s.range(0.03, 0.12));
        let scale = if count > 1 { 0.3 } else { 0.45 } / half.y;
        let front = s.print(&product, Face::Front, 2.0 * scale * half.truncate());
        let rear = if s.chance(0.5) {
            s.print(&product, Face::Back, 2.0 * scale * half.truncate())
        } else {
            s.plain(scheme.ground)
        };
        let spine = s.print(&product, Face::Side, 2.0 * scale * Vec2::new(half.y, half.z.max(0.06)));
        let paper = palette::color(&mut s.rng, Tone::White);
        let lines = s.range(50.0, 110.0) * Vec3::Z;
        let pages = crate::mesh::Texture::Stripes {
            a: paper,
            b: 0.75 * paper,
            direction: lines,
            phase: 0.2,
            duty: 0.4,
            soft: 0.1,
        };
        let [front, rear, spine, pages] = [front, rear, spine, Material::matt(pages)].map(|m| a.material(m));
        let t = s.range(0.006, 0.015);
        let turn = if count > 1 { Quat::from_rotation_z(s.range(-0.5, 0.5)) } else { Quat::IDENTITY };
        let place = Affine3A::from_rotation_translation(turn, Vec3::new(0.0, 0.0, z + half.z + t));
        let board = |up: f32, face: u16| {
            let mut m = [front; 6];
            m[if up > 0.0 { 4 } else { 5 }] = face;
            shapes::rounded_box(Vec3::new(half.x, half.y, t), 0.5 * t, m).moved(Vec3::new(0.0, 0.0, up * half.z))
        };
        a.add(board(1.0, front).transformed(place), 40.0);
        a.add(board(-1.0, rear).transformed(place), 40.0);
        let block = shapes::rounded_box(Vec3::new(half.x - 0.02, half.y - 0.025, half.z), 0.002, [pages; 6]);
        a.add(block.transformed(place), 40.0);
        // The spine bulges; its print reads along it.
        let mut back = shapes::rounded_box(Vec3::new(t, 0.998 * half.y, half.z + 0.5 * t), 0.4 * t, [spine; 6]);
        let bulge = s.range(0.0, 0.5) * half.z;
        back.map(|p| Vec3::new(p.x - half.x - bulge * (1.0 - (p.z / (half.z + t)).powi(2)), p.y, p.z));
        a.add(back.transformed(place), 40.0);
        z += 2.0 * (half.z + t) + 0.001;
        if k == 0 && s.chance(0.1) {
            handles::wire(
                a,
                &[Vec3::new(0.1, -0.45, z), Vec3::new(0.1, -0.55, z), Vec3::new(0.1, -0.65, z - 0.05)],
                0.01,
                spine,
            );
        }
    }
}
