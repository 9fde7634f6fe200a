//! Printed packaging with hard walls: cans, bottles, cartons, open boxes, books.

use std::f32::consts::{PI, TAU};

use glam::{Affine3A, Quat, Vec2, Vec3};
use rand::Rng;

use crate::generate::handles::{self, Mount, handle};
use crate::generate::label::{Face, Product, Scheme};
use crate::generate::palette::{self, Tone};
use crate::generate::part::{Assembly, Part};
use crate::generate::shapes::{self, Span};
use crate::generate::style::Style;
use crate::mesh::Material;
use crate::mesh::noise;

const CREASE: f32 = 42.0;

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

/// A cap over a neck: ridged, smooth, stepped or with a flip top. `r` is its radius, from `z` over `tall`.
pub fn screw_cap(a: &mut Assembly, s: &mut Style, r: f32, z: f32, tall: f32, material: u16) {
    let taper = s.range(0.85, 1.0);
    let mut points = vec![
        Vec2::new(0.0, z),
        Vec2::new(r, z),
        Vec2::new(r, z + 0.12 * tall),
        Vec2::new(0.96 * r, z + 0.16 * tall),
        Vec2::new(0.96 * taper * r, z + tall),
        Vec2::new(0.0, z + tall),
    ];
    if s.chance(0.25) {
        // A nozzle or a flip top.
        points.pop();
        let (w, up) = (s.range(0.25, 0.6) * r, s.range(0.2, 0.9) * tall);
        points.extend([Vec2::new(1.1 * w, z + tall), Vec2::new(w, z + tall + up), Vec2::new(0.0, z + tall + up)]);
    }
    let span = [Span { points: shapes::fillet(&points, 0.06 * r.min(tall), 3), material }];
    let ridges = if s.chance(0.6) { s.range(20.0, 32.0).round() } else { 0.0 };
    let (low, high) = (z + 0.22 * tall, z + 0.92 * tall);
    let part = if ridges > 0.0 {
        shapes::lathe_with(&span, (3.0 * ridges) as usize, &shapes::round, 0.2, &move |_, turn, p| {
            let on = p.y > low && p.y < high && p.x > 0.6 * r;
            if on { 0.025 * r * (TAU * ridges * turn).cos() } else { 0.0 }
        })
    } else {
        shapes::lathe(&span, 36, &shapes::round, 0.15)
    };
    a.add(part, CREASE);
}

/// Sizes of a bottle.
struct BottleSize {
    r: f32,
    /// Height up to the shoulder.
    h: f32,
    /// Radius of the neck.
    neck: f32,
    /// Height of the shoulder.
    shoulder: f32,
    neck_height: f32,
    /// Radius halfway up the band, as a share of `r`.
    waist: f32,
    labelled: bool,
    /// Heights between which a label lies, on the belly or at the shoulder.
    band: [f32; 2],
}

impl BottleSize {
    fn draw(s: &mut Style) -> Self {
        let (r, h) = (s.range(0.2, 0.4), s.range(0.5, 1.05));
        let neck = r * s.range(0.25, 0.7);
        let shoulder = s.range(0.08, 0.4);
        let neck_height = s.range(0.03, 0.3);
        let waist = if s.chance(0.35) { s.range(0.78, 0.97) } else { 1.0 };
        let labelled = s.chance(0.75);
        let band = [s.range(0.1, 0.4) * h, s.range(0.65, 0.95) * h];
        Self { r, h, neck, shoulder, neck_height, waist, labelled, band }
    }

    /// Height of the mouth.
    fn mouth(&self) -> f32 {
        self.h + self.shoulder + self.neck_height
    }
}

pub fn bottle(a: &mut Assembly, s: &mut Style) {
    let scheme = s.scheme();
    let [body, cap] = bottle_materials(s, &scheme);
    let size = BottleSize::draw(s);
    let label = if size.labelled { bottle_label(s, &scheme, &body, &size) } else { body.clone() };
    let [body, cap, label] = [body, cap, label].map(|m| a.material(m));
    let spans = bottle_outline(s, &size, body, label);
    let (part, oval) = bottle_body(s, &size, &spans);
    a.add(part, CREASE);
    bottle_cap(a, s, &size, cap);
    if s.chance(0.18) {
        let reach = s.range(0.14, 0.25);
        let (x, y) = (oval * size.r * 0.95, 0.97 * size.r);
        let side = if oval < 1.0 { y } else { x };
        let mount = Mount {
            low: Vec2::new(side, 0.3 * size.h),
            high: Vec2::new(side * 0.93, 0.95 * size.h),
            reach,
            material: body,
            angle: 0.0,
        };
        handle(a, s, mount);
    }
}

/// What body and cap are made of.
fn bottle_materials(s: &mut Style, scheme: &Scheme) -> [Material; 2] {
    let color = if s.chance(0.6) { scheme.ground } else { s.color() };
    let body = match s.count(0, 8) {
        0..5 => s.plain(color),
        5..7 => s.glass(),
        _ => s.material(),
    };
    let cap = match s.count(0, 5) {
        0 => s.metal(),
        1 => s.dark_plastic(),
        2 => {
            let white = palette::color(&mut s.rng, Tone::White);
            s.plain(white)
        }
        _ => s.plain(scheme.accent),
    };
    [body, cap]
}

fn bottle_label(s: &mut Style, scheme: &Scheme, body: &Material, size: &BottleSize) -> Material {
    let print = Scheme { ground: body.albedo(Vec3::ZERO, Vec2::splat(0.5)), ..scheme.clone() };
    let face = if s.chance(0.6) { Face::Sticker } else { Face::Wrap };
    let product = s.product(if face == Face::Sticker { &print } else { scheme });
    let [low, high] = size.band;
    let mut label = s.print(&product, face, Vec2::new(1.1, (1.1 * (high - low) / (TAU * size.r)).clamp(0.2, 0.9)));
    if face == Face::Sticker {
        (label.specular, label.roughness) = (body.specular, body.roughness);
    }
    label
}

/// The profile: foot, band (which a label may cover), shoulder and neck.
fn bottle_outline(s: &mut Style, size: &BottleSize, body: u16, label: u16) -> [Span; 3] {
    let &BottleSize { r, h, neck, shoulder, neck_height, waist, band: [low, high], .. } = size;
    let base = r * s.range(0.85, 1.0);
    let bottom = vec![
        Vec2::new(0.0, 0.03),
        Vec2::new(base * 0.7, 0.015),
        Vec2::new(base * 0.85, 0.0),
        Vec2::new(base * 0.96, 0.015),
        Vec2::new(base, 0.05),
        Vec2::new(r, low),
    ];
    let mut band = vec![Vec2::new(r, low), Vec2::new(r, high)];
    if waist < 1.0 {
        band.insert(1, Vec2::new(r * waist, 0.5 * (low + high)));
        band = shapes::smooth(&band, 6);
    }
    let mut top = match s.count(0, 3) {
        0 => shapes::smooth(
            &[
                Vec2::new(r, high),
                Vec2::new(r * 0.97, h),
                Vec2::new(0.45 * r + 0.55 * neck, h + 0.55 * shoulder),
                Vec2::new(neck, h + shoulder),
            ],
            5,
        ),
        1 => shapes::fillet(&[Vec2::new(r, high), Vec2::new(r, h), Vec2::new(neck, h + shoulder)], 0.1, 5),
        // Dressing bottles: the body itself narrows over its whole height.
        _ => shapes::smooth(
            &[
                Vec2::new(r, high),
                Vec2::new(0.8 * r + 0.2 * neck, 0.5 * (high + h + shoulder)),
                Vec2::new(neck, h + shoulder),
            ],
            7,
        ),
    };
    let z = size.mouth();
    top.extend([
        Vec2::new(neck, z - 0.6 * neck_height),
        Vec2::new(1.12 * neck, z - 0.55 * neck_height),
        Vec2::new(1.12 * neck, z - 0.4 * neck_height),
        Vec2::new(neck, z - 0.35 * neck_height),
        Vec2::new(neck, z),
        Vec2::new(0.0, z),
    ]);
    [
        Span { points: bottom, material: body },
        Span { points: band, material: label },
        Span { points: top, material: body },
    ]
}

/// The profile turned about z, and how much thinner than wide that is.
fn bottle_body(s: &mut Style, size: &BottleSize, spans: &[Span; 3]) -> (Part, f32) {
    let [low, high] = size.band;
    // Grips: hoops pressed into the band.
    let grips = if s.chance(0.25) { (s.range(8.0, 16.0), s.range(0.006, 0.014)) } else { (0.0, 0.0) };
    let relief = move |i: usize, _: f32, p: Vec2| {
        let fade = ((p.y - low) / 0.05).clamp(0.0, 1.0) * ((high - p.y) / 0.05).clamp(0.0, 1.0);
        if i == 1 { -grips.1 * fade * (0.5 + 0.5 * (TAU * grips.0 * p.y).sin()) } else { 0.0 }
    };
    let step = if grips.1 > 0.0 { 0.02 } else { 0.13 };
    let mut fine = spans.to_vec();
    fine[1].points = shapes::subdivide(&spans[1].points, step);
    let oval = if s.chance(0.35) { s.range(0.5, 0.9) } else { 1.0 };
    let part = match s.count(0, 10) {
        0..7 => shapes::lathe_with(&fine, 44, &shapes::superellipse(Vec2::new(1.0, oval), 2.0), 0.13, &relief),
        7 => shapes::lathe_with(&fine, 40, &shapes::polygon([4, 5, 8, 10][s.count(0, 4)]), 0.13, &relief),
        _ => {
            let section = shapes::superellipse(Vec2::new(1.0, oval), s.range(3.0, 8.0));
            shapes::lathe_with(&fine, 44, &section, 0.13, &relief)
        }
    };
    (part, oval)
}

/// None, a pump, or a screw cap.
fn bottle_cap(a: &mut Assembly, s: &mut Style, size: &BottleSize, cap: u16) {
    let &BottleSize { r, h, neck, shoulder, neck_height, .. } = size;
    let z = size.mouth();
    let cover = s.range(0.3, 1.0) * neck_height;
    let tall = cover + s.range(0.03, 0.14);
    match s.count(0, 8) {
        0 => {}
        1 => {
            // A pump: collar, stem, spout.
            screw_cap(a, s, 1.2 * neck, z - cover, cover + 0.06, cap);
            let up = s.range(0.12, 0.3);
            let points: Vec<Vec3> = [
                Vec3::new(0.0, 0.0, z),
                Vec3::new(0.0, 0.0, z + 0.5 * up),
                Vec3::new(0.0, 0.0, z + up),
                Vec3::new(0.06, 0.0, z + up + 0.03),
                Vec3::new(0.2, 0.0, z + up + 0.02),
                Vec3::new(0.3, 0.0, z + up - 0.03),
            ]
            .to_vec();
            a.add(shapes::tube(&points, Vec3::Y, |_| Vec2::splat(0.035), 2.0, 12, cap), 50.0);
        }
        // An inverted bottle stands on a cap as wide as its shoulder.
        2 => screw_cap(a, s, (1.6 * neck).min(0.95 * r), h + 0.8 * shoulder, neck_height + 0.2 * shoulder + 0.1, cap),
        _ => screw_cap(a, s, 1.2 * neck, z - cover, tall, cap),
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
