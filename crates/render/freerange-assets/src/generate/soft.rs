//! Soft and moulded things: pouches and bags, tubes, cushions and towels.

use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};
use rand::Rng;

use crate::generate::caps::screw_cap;
use crate::generate::label::Face;
use crate::generate::palette;
use crate::generate::part::{Assembly, Part};
use crate::generate::shapes;
use crate::generate::style::Style;
use crate::mesh::Material;
use crate::mesh::noise;

/// A closed sheet pair: front and back meet along the border. `f(u, v, side)` gives both.
fn pillow([nu, nv]: [usize; 2], f: impl Fn(f32, f32, f32) -> Vec3, m: [u16; 2]) -> Part {
    let mut part = Part::default();
    for (side, material) in [(-1.0, m[0]), (1.0, m[1])] {
        let base = part.positions.len() as u32;
        for j in 0..=nv {
            for i in 0..=nu {
                let (u, v) = (i as f32 / nu as f32, j as f32 / nv as f32);
                // The border belongs to both sheets: the same point to the bit.
                let border = i == 0 || j == 0 || i == nu || j == nv;
                let x = if side > 0.0 { 1.0 - u } else { u };
                part.vertex(f(u, v, if border { 0.0 } else { side }), Vec2::new(x, v));
            }
        }
        let id = |i: usize, j: usize| base + (j * (nu + 1) + i) as u32;
        for j in 0..nv {
            for i in 0..nu {
                let ring = [id(i, j), id(i + 1, j), id(i + 1, j + 1), id(i, j + 1)];
                let ring = if side > 0.0 { [ring[3], ring[2], ring[1], ring[0]] } else { ring };
                part.quad(ring, material);
            }
        }
    }
    part
}

/// Crisp bags, stand-up pouches, sacks, sachets, cushions.
pub fn pouch(a: &mut Assembly, s: &mut Style) {
    let cushion = s.chance(0.2);
    let (w, h) = (s.range(0.3, 0.55), if cushion { s.range(0.35, 0.5) } else { s.range(0.35, 0.75) });
    let [front, rear] = if cushion {
        let color = s.color();
        let cloth = s.cloth(color);
        let m = s.finish(cloth);
        [m.clone(), m]
    } else {
        let scheme = s.scheme();
        let product = s.product(&scheme);
        let scale = 0.5 / w.max(h);
        let size = 2.0 * scale * Vec2::new(w, h);
        let front = s.print(&product, Face::Front, size);
        let rear = if s.chance(0.5) { s.print(&product, Face::Back, size) } else { front.clone() };
        let glossy = s.chance(0.6);
        [front, rear].map(|m| if glossy { Material { specular: 0.05, roughness: 0.22, ..m } } else { m })
    };
    let [front, rear] = [front, rear].map(|m| a.material(m));
    let (fat, seed) = (s.range(0.12, 0.3), s.rng.random());
    let seam = if cushion { 0.0 } else { s.range(0.03, 0.08) };
    let stands = !cushion && s.chance(0.45);
    let (crease, waves) = (s.range(0.01, 0.04), s.range(0.0, 0.02));
    let body = move |u: f32, v: f32, side: f32| {
        let (x, y) = (2.0 * u - 1.0, 2.0 * v - 1.0);
        // Flat seams above and below, full between; standing pouches are full at the foot.
        let inner = ((v - seam) / (1.0 - 2.0 * seam)).clamp(0.0, 1.0);
        let across = (1.0 - x * x).max(0.0).sqrt();
        let along = if stands {
            (1.0 - inner).powf(0.6) * (inner * 14.0).min(1.0)
        } else {
            (4.0 * inner * (1.0 - inner)).powf(0.55)
        };
        let d = fat * across * along;
        let wrinkle =
            crease * (across * along).sqrt() * (2.0 * noise::fbm(Vec3::new(4.0 * x, 5.0 * y, side), seed, 3) - 1.0);
        let pull = 1.0 - 0.22 * along * fat / 0.3 * across;
        let thick = if side == 0.0 { 0.0 } else { side * (d + 0.006 + wrinkle.max(-0.5 * d)) };
        let ripple = waves * (9.0 * x).sin() * (1.0 - along);
        Vec3::new(w * x * (pull.max(0.8) + 0.2 * y * y).min(1.0), thick + ripple, h * y)
    };
    a.add(pillow([30, 30], body, [front, rear]), 65.0);
    if stands && s.chance(0.4) {
        let color = s.color();
        let cap = s.plain(color);
        let cap = a.material(cap);
        screw_cap(a, s, 0.07, h - 0.03, 0.14, cap);
    }
}

/// Toothpaste, cream, glue: round at the cap, flat at the crimp.
pub fn tube(a: &mut Assembly, s: &mut Style) {
    let scheme = s.scheme();
    let product = s.product(&scheme);
    let (length, r) = (s.range(0.8, 1.6), s.range(0.12, 0.26));
    let label = s.print(&product, Face::Wrap, Vec2::new(0.8, 0.8 * length / (TAU * r).max(0.9)));
    let cap = if s.chance(0.5) { s.plain(scheme.accent) } else { s.material() };
    let [label, cap] = [label, cap].map(|m| a.material(m));
    let (squeeze, seed) = (s.range(0.0, 0.3), s.rng.random());
    let n = 24;
    let mut part = Part::default();
    // From the crimp to the shoulder; the ends close in a line and a disc.
    let ring = |v: f32, turn: f32| {
        let c = shapes::round(TAU * turn);
        let t = v.clamp(0.0, 1.0);
        let flat = 1.0 - t.powf(0.8);
        let wide = r * (1.0 + 0.5 * flat);
        let thin = r * (1.0 - flat).max(0.03);
        let dent = 1.0 - squeeze * (PI * t).sin() * noise::value(Vec3::new(2.0 * c.x, 3.0 * t, 1.0), seed);
        Vec3::new(wide * c.x, thin * c.y * dent, length * t)
    };
    part.grid([40, n + 2], [true, false], label, |u, v| {
        let j = (v * (n + 2) as f32).round() as usize;
        match j {
            0 => Vec3::ZERO,
            j if j == n + 2 => Vec3::new(0.0, 0.0, length),
            _ => ring((j - 1) as f32 / n as f32, u),
        }
    });
    a.add(part, 45.0);
    let (wide, tall) = (r * s.range(0.6, 1.02), s.range(0.1, 0.3));
    screw_cap(a, s, wide, length - 0.01, tall, cap);
    let crimp = shapes::rounded_box(Vec3::new(1.5 * r, 0.012, 0.05), 0.005, [label; 6]);
    a.add(crimp.moved(Vec3::new(0.0, 0.0, -0.03)), 40.0);
}

/// Rolled towels, toilet rolls, yarn, candles lying: cylinders and coils of cloth.
pub fn textile(a: &mut Assembly, s: &mut Style) {
    let color = if s.chance(0.35) { palette::color(&mut s.rng, palette::Tone::White) } else { s.color() };
    let cloth = s.cloth(color);
    let m = Material { roughness: 0.95, ..Material::matt(cloth) };
    let core_color = palette::shade(&mut s.rng, color, 0.5);
    let core = s.plain(core_color);
    let [m, core] = [m, core].map(|m| a.material(m));
    match s.count(0, 3) {
        0 => {
            // A roll with a hole or a spiral end.
            let (r, h, hole) = (s.range(0.25, 0.5), s.range(0.3, 0.9), s.range(0.06, 0.15));
            let ring =
                [Vec2::new(hole, 0.0), Vec2::new(r, 0.0), Vec2::new(r, h), Vec2::new(hole, h), Vec2::new(hole, 0.0)];
            let mut points = shapes::fillet(&ring, 0.03, 3);
            let last = points.len() - 1;
            points[last] = points[0];
            let spans = [shapes::Span { points, material: m }];
            let mut part = shapes::lathe(&spans, 44, &shapes::round, 0.08);
            let seed = s.rng.random();
            part.map(|p| p + 0.012 * noise::vector(p * 5.0, seed, 2));
            a.add(part, 50.0);
            let wall = [
                Vec2::new(hole - 0.015, -0.004),
                Vec2::new(hole + 0.01, -0.004),
                Vec2::new(hole + 0.01, h + 0.004),
                Vec2::new(hole - 0.015, h + 0.004),
                Vec2::new(hole - 0.015, -0.004),
            ];
            a.add(
                shapes::lathe(&[shapes::Span { points: wall.to_vec(), material: core }], 32, &shapes::round, 0.2),
                40.0,
            );
        }
        1 => {
            // A folded stack of towels.
            let (w, d, n) = (s.range(0.35, 0.5), s.range(0.25, 0.4), s.count(2, 6));
            let mut z = 0.0;
            for k in 0..n {
                let t = s.range(0.035, 0.07);
                let seed = s.rng.random();
                let mut fold =
                    shapes::rounded_box(Vec3::new(w, d, t), 0.95 * t, [if k % 2 == 0 { m } else { core }; 6]);
                fold.map(|p| p + 0.02 * noise::vector(p * 4.0, seed, 2));
                a.add(fold.moved(Vec3::new(s.range(-0.02, 0.02), s.range(-0.02, 0.02), z + t)), 60.0);
                z += 1.9 * t;
            }
        }
        _ => {
            // A hat or beanie: a dome with a brim, hollow.
            let (r, h, brim) = (0.4, s.range(0.25, 0.5), s.range(0.0, 0.35));
            let side = shapes::smooth(
                &[
                    Vec2::new(r + brim + 0.01, 0.0),
                    Vec2::new(r + 0.3 * brim, 0.03),
                    Vec2::new(r, 0.4 * h),
                    Vec2::new(0.8 * r, 0.85 * h),
                    Vec2::new(0.35 * r, h),
                ],
                5,
            );
            let wall = 0.025;
            let mut outer = side.clone();
            outer.push(Vec2::new(0.0, h + 0.005));
            let mut inner: Vec<Vec2> = vec![Vec2::new(0.0, h - wall)];
            inner.extend(side.iter().rev().map(|p| Vec2::new(p.x - wall, p.y - 0.5 * wall * p.y / h)).skip(1));
            inner.push(side[0]);
            let spans = [shapes::Span { points: outer, material: m }, shapes::Span { points: inner, material: core }];
            a.add(shapes::lathe(&spans, 44, &shapes::round, 0.1), 60.0);
            if s.chance(0.4) {
                let seed = s.rng.random();
                let mut ball = shapes::superquadric(Vec3::splat(0.12), 1.0, 1.0, 16, core);
                ball.map(|p| p * (1.0 + 0.25 * noise::fbm(p * 30.0, seed, 2)));
                a.add(ball.moved(Vec3::Z * (h + 0.07)), 60.0);
            }
        }
    }
}
