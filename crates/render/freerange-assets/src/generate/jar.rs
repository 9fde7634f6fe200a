//! Jars and what stands in them: preserves, flowers, candles.

use std::f32::consts::TAU;

use glam::{Vec2, Vec3};

use crate::generate::caps::{CREASE, lid, screw_cap};
use crate::generate::handles;
use crate::generate::label::Face;
use crate::generate::palette::{self, Tone};
use crate::generate::part::Assembly;
use crate::generate::shapes::{self, Span};
use crate::generate::style::Style;
use crate::generate::turned::{Relief, plain_section, turned, walls};
use crate::mesh::Material;

/// Jars with lids, vases, planters, candle glasses.
pub fn jar(a: &mut Assembly, s: &mut Style) {
    let body = match s.count(0, 3) {
        0 => s.glass(),
        1 => s.ceramic(),
        _ => {
            let color = s.color();
            s.plain(color)
        }
    };
    let (r, h) = (s.range(0.3, 0.5), s.range(0.45, 1.2));
    let neck = r * s.range(0.65, 1.0);
    let shoulder = s.range(0.05, 0.2);
    let wall = s.range(0.015, 0.03);
    let corners = [
        Vec2::new(0.85 * r, 0.0),
        Vec2::new(r, 0.06),
        Vec2::new(r, h),
        Vec2::new(neck, h + shoulder),
        Vec2::new(neck, h + shoulder + 0.08),
    ];
    let side = shapes::fillet(&corners, 0.05, 4);
    let w = walls(&side, wall, 0.0);
    // The label sits on the straight part.
    let (low, high) = (s.range(0.12, 0.25) * h, s.range(0.75, 0.92) * h);
    let labeled = s.chance(0.65);
    let label = if labeled { jar_label(s, &body, 1.15 * (high - low) / (TAU * r)) } else { body.clone() };
    let cap = match s.count(0, 4) {
        0..2 => s.metal(),
        2 => {
            let wood = s.wood();
            s.finish(wood)
        }
        _ => {
            let color = s.color();
            s.plain(color)
        }
    };
    let fill = if s.chance(0.5) { body.clone() } else { s.material() };
    let [body, label, cap, fill] = [body, label, cap, fill].map(|m| a.material(m));
    let split = w.outer.iter().position(|p| p.y > high).unwrap_or(w.outer.len() - 1);
    let start = w.outer.iter().position(|p| p.y > low).unwrap_or(1).min(split);
    let mut bottom = w.outer[..start].to_vec();
    bottom.push(Vec2::new(r, low));
    let mut top = vec![Vec2::new(r, high)];
    top.extend(&w.outer[split..]);
    let band = vec![Vec2::new(r, low), Vec2::new(r, high)];
    let relief = (!labeled && s.chance(0.4)).then(|| (Relief::random(s), 1, [low, high], s.range(0.006, 0.015)));
    let spans = [
        Span { points: bottom, material: body },
        Span { points: band, material: label },
        Span { points: top, material: body },
        Span { points: w.rim, material: body },
        Span { points: w.inner, material: fill },
    ];
    let section = plain_section(s, 0.3);
    a.add(turned(&spans, &section, relief), CREASE);
    let z = h + shoulder + 0.08;
    match s.count(0, 5) {
        0 => candle(a, s, [r.min(neck) - wall - 0.004, h], &section),
        1 => {}
        2 => lid(a, s, Vec2::new(neck + 0.02, z), [cap, cap]),
        _ => screw_cap(a, s, neck * 1.06, z - 0.07, cap_height(neck), cap),
    }
    if s.chance(0.12) {
        let at = Vec2::new(neck, z - 0.02);
        handles::bail(a, s, at, cap);
    }
}

/// Height of a cap over a neck of this radius.
fn cap_height(neck: f32) -> f32 {
    0.1 + 0.18 * neck
}

/// A sticker or a wrap around, of this height.
fn jar_label(s: &mut Style, body: &Material, tall: f32) -> Material {
    let mut scheme = s.scheme();
    if s.chance(0.5) {
        scheme.ground = body.albedo(Vec3::ZERO, Vec2::splat(0.5));
    }
    let product = s.product(&scheme);
    let face = if s.chance(0.5) { Face::Sticker } else { Face::Wrap };
    s.print(&product, face, Vec2::new(1.15, tall))
}

/// A candle in a glass of this inner radius and height: wax below the rim, and a wick.
fn candle(a: &mut Assembly, s: &mut Style, [inner, h]: [f32; 2], section: shapes::Section) {
    let color = palette::color(&mut s.rng, Tone::Pastel);
    let (wax, wick) = (s.plain(color), s.dark_plastic());
    let [wax, wick] = [wax, wick].map(|m| a.material(m));
    let level = s.range(0.5, 0.95) * h;
    let points = [
        Vec2::new(0.0, 0.05),
        Vec2::new(inner - 0.03, 0.05),
        Vec2::new(inner, 0.1),
        Vec2::new(inner, level),
        Vec2::new(0.0, level),
    ];
    a.add(shapes::lathe(&[Span { points: points.to_vec(), material: wax }], 40, section, 0.2), CREASE);
    let path: Vec<Vec3> = (0..5).map(|i| Vec3::new(0.01 * i as f32, 0.0, level - 0.02 + 0.03 * i as f32)).collect();
    handles::wire(a, &path, 0.012, wick);
}
