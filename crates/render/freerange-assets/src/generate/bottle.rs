//! Bottles: a turned or squeezed body, a label, a cap, a pump or a trigger.

use std::f32::consts::TAU;

use glam::{Vec2, Vec3};

use crate::generate::caps::{CREASE, screw_cap};
use crate::generate::handles::{Mount, handle};
use crate::generate::label::{Face, Scheme};
use crate::generate::palette::{self, Tone};
use crate::generate::part::{Assembly, Part};
use crate::generate::shapes::{self, Span};
use crate::generate::style::Style;
use crate::mesh::Material;

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
    labeled: bool,
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
        let labeled = s.chance(0.75);
        let band = [s.range(0.1, 0.4) * h, s.range(0.65, 0.95) * h];
        Self { r, h, neck, shoulder, neck_height, waist, labeled, band }
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
    let label = if size.labeled { bottle_label(s, &scheme, &body, &size) } else { body.clone() };
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
