//! What closes vessels: caps over necks, and lids.

use std::f32::consts::TAU;

use glam::Vec2;

use crate::generate::part::Assembly;
use crate::generate::shapes::{self, Span};
use crate::generate::style::Style;

/// Rounding of creases in turned bodies.
pub const CREASE: f32 = 42.0;

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

/// A domed lid with a knob, its rim at (radius, height).
pub fn lid(a: &mut Assembly, s: &mut Style, at: Vec2, [body, knob]: [u16; 2]) {
    let (r, z) = (at.x, at.y);
    let dome = s.range(0.1, 0.45) * r;
    let profile = [
        Vec2::new(0.0, z - 0.02),
        Vec2::new(0.9 * r, z - 0.02),
        Vec2::new(r, z),
        Vec2::new(r, z + 0.02),
        Vec2::new(0.6 * r, z + 0.75 * dome),
        Vec2::new(0.0, z + dome),
    ];
    let span = [Span { points: shapes::fillet(&profile, 0.08 * r, 4), material: body }];
    a.add(shapes::lathe(&span, 40, &shapes::round, 0.1), CREASE);
    let (k, tall) = (s.range(0.1, 0.2) * r, s.range(0.15, 0.3) * r);
    let top = z + dome - 0.06 * r;
    let profile = [
        Vec2::new(0.0, top),
        Vec2::new(0.6 * k, top),
        Vec2::new(0.45 * k, top + 0.5 * tall),
        Vec2::new(k, top + 0.75 * tall),
        Vec2::new(0.7 * k, top + tall),
        Vec2::new(0.0, top + tall),
    ];
    let span = [Span { points: shapes::fillet(&profile, 0.3 * k, 3), material: knob }];
    a.add(shapes::lathe(&span, 20, &shapes::round, 0.2), CREASE);
}
