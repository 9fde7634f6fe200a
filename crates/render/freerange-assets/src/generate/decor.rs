//! Painted decoration for ceramics and textiles: scrolls, flowers, bands, lattices, pictures.

use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};
use rand::Rng;

use crate::generate::canvas::{Canvas, Ink, ink};
use crate::generate::glyph::{self, Case, Font, Setting};
use crate::generate::motif::{Logo, Motif};
use crate::mesh::Raster;

/// A leaf from `base` towards `angle`: one stroke that swells and one that tapers.
fn leaf(c: &mut Canvas, base: Vec2, angle: f32, length: f32, color: Ink) {
    let d = Vec2::new(angle.cos(), angle.sin());
    let bend = d.perp() * 0.12 * length;
    let points = [base, base + 0.35 * length * d + bend, base + 0.7 * length * d + bend, base + length * d];
    c.stroke(&points[..2], 0.07 * length, 1.9, color);
    c.stroke(&points[1..], 0.133 * length, 0.15, color);
}

/// Painted decoration for ceramics and textiles on `ground`: scrolls, flowers, bands, lattices, one picture.
pub fn decor(rng: &mut impl Rng, ground: Vec3, colors: [Vec3; 2], width: usize, height: usize) -> Raster {
    let mut c = Canvas::new(width, height, ink(ground));
    let (size, inks) = (c.size(), colors.map(ink));
    let h = size.y;
    match rng.random_range(0..6) {
        0 => scrolls(&mut c, rng, inks),
        1 => {
            // Scattered flowers.
            let petals = rng.random_range(4..8) as f32;
            let unit = h / rng.random_range(2.5..5.0f32);
            let columns = (size.x / unit).floor().max(1.0);
            let step = size.x / columns;
            for i in 0..columns as usize {
                for j in 0..(h / unit).ceil() as usize {
                    let shift = if j % 2 == 0 { 0.25 } else { 0.75 };
                    let jitter = Vec2::new(rng.random_range(-0.1..0.1), rng.random_range(-0.1..0.1));
                    let center = Vec2::new((i as f32 + shift) * step, (j as f32 + 0.5) * unit) + jitter * unit;
                    let (r, turn) = (unit * rng.random_range(0.2..0.34), rng.random_range(0.0..TAU));
                    leaf(&mut c, center, turn, 1.7 * r, inks[1]);
                    c.polar(center, 0.75 * r, inks[0], |a| 0.8 + 0.35 * (petals * (a + turn)).cos());
                    c.ellipse(center, Vec2::splat(0.2 * r), inks[1]);
                }
            }
        }
        2 => bands(&mut c, rng, inks),
        3 => {
            // A lattice of diamonds with dots.
            let rows = rng.random_range(2..7) as f32;
            let columns = (rows * size.x / h).round().max(1.0);
            let (cell, half) = (Vec2::new(size.x / columns, h / rows), rng.random_range(0.04..0.12));
            c.paint(Vec2::ZERO, size, |p| {
                let q = (p / cell).fract() - 0.5;
                let diamond = (q.x.abs() + q.y.abs() - 0.5).abs() - half;
                let dot = q.length() - 0.14;
                let px = cell.min_element();
                if dot < diamond { (inks[1], 0.5 - dot * px) } else { (inks[0], 0.5 - diamond * px) }
            });
        }
        4 => {
            // Brush strokes or drops.
            for _ in 0..rng.random_range(12..50) {
                let p = Vec2::new(rng.random_range(0.0..size.x), rng.random_range(0.0..h));
                let (angle, length) = (rng.random_range(0.0..TAU), h * rng.random_range(0.05..0.3));
                leaf(&mut c, p, angle, length, inks[rng.random_range(0..2)]);
            }
        }
        _ => {
            // One picture and a word, twice around.
            let (motif, logo) = (Motif::random(rng, inks[0]), Logo::random(rng));
            let (font, word) = (Font::random(rng), glyph::word(rng, Case::Title));
            for middle in [0.25, 0.75] {
                let center = Vec2::new(middle * size.x, 0.5 * h);
                let half = Vec2::new((0.2 * size.x).min(0.4 * h), 0.38 * h);
                let (top, low) = (center - half, center + half);
                if rng.random_bool(0.5) {
                    motif.picture(&mut c, rng, top, Vec2::new(low.x, center.y + 0.3 * half.y));
                } else {
                    logo.draw(&mut c, top, Vec2::new(low.x, center.y + 0.3 * half.y), inks[0], inks[1]);
                }
                glyph::text(
                    &mut c,
                    &word,
                    &font,
                    &Setting::plain(inks[1]),
                    Vec2::new(top.x, center.y + 0.4 * half.y),
                    low,
                );
            }
        }
    }
    c.into_raster()
}

/// Spirals with leaves along them.
fn scrolls(c: &mut Canvas, rng: &mut impl Rng, inks: [Ink; 2]) {
    let size = c.size();
    let radius = 0.46 * size.y * rng.random_range(0.6..1.0f32);
    let count = (size.x / (2.1 * radius)).round().max(1.0);
    let (turns, half) = (rng.random_range(1.2..2.4f32), 0.025 * size.y);
    let outer = rng.random_range(0.2..0.34);
    for i in 0..count as usize {
        let center = Vec2::new(size.x * (i as f32 + 0.5) / count, 0.5 * size.y);
        let (way, start) = (if i % 2 == 0 { 1.0 } else { -1.0 }, rng.random_range(0.0..TAU));
        let at = |t: f32| {
            let a = start + way * TAU * turns * t;
            (center + radius * (0.08 + 0.68 * t) * Vec2::new(a.cos(), a.sin()), a)
        };
        let points: Vec<Vec2> = (0..=40).map(|k| at(k as f32 / 40.0).0).collect();
        c.stroke(&points, half, 1.0, inks[0]);
        for k in 3..24 {
            let t = k as f32 / 24.0;
            let (p, a) = at(t);
            leaf(c, p, a + way * 0.5, radius * outer * (0.5 + t), inks[usize::from(k % 5 == 4)]);
        }
    }
    for y in [0.02, 0.98] {
        let y = y * size.y;
        c.rect(Vec2::new(0.0, y - half), Vec2::new(size.x, y + half), inks[1]);
    }
}

/// Horizontal bands: lines, zigzags, dots, keys.
fn bands(c: &mut Canvas, rng: &mut impl Rng, inks: [Ink; 2]) {
    let size = c.size();
    let mut y = size.y * rng.random_range(0.0..0.2);
    while y < size.y {
        let tall = size.y * rng.random_range(0.04..0.2);
        let (color, kind) = (inks[rng.random_range(0..2)], rng.random_range(0..5));
        let count = (size.x / tall.max(4.0)).round().max(1.0);
        let period = size.x / count;
        let middle = y + 0.5 * tall;
        c.fill(Vec2::new(0.0, y), Vec2::new(size.x, y + tall), color, |p| {
            let x = p.x.rem_euclid(period) / period - 0.5;
            match kind {
                0 => (p.y - middle).abs() - 0.3 * tall,
                1 => (p.y - middle - (2.0 * x.abs() - 0.5) * 0.7 * tall).abs() - 0.12 * tall,
                2 => Vec2::new(x * period, p.y - middle).length() - 0.32 * tall,
                3 => (p.y - middle - 0.3 * tall * (TAU * x).sin()).abs() - 0.1 * tall,
                _ => (x.abs() - 0.3).max((p.y - middle).abs() / tall - 0.4) * tall,
            }
        });
        y += tall * rng.random_range(1.1..2.2);
    }
}

/// A circle divided like a pie, for plates: petals and rings about the center of a square raster.
pub fn rosette(rng: &mut impl Rng, ground: Vec3, colors: [Vec3; 2], side: usize) -> Raster {
    let mut c = Canvas::new(side, side, ink(ground));
    let (middle, r, inks) = (Vec2::splat(0.5 * side as f32), 0.5 * side as f32, colors.map(ink));
    for _ in 0..rng.random_range(1..4) {
        let (at, wide) = (rng.random_range(0.3..0.97) * r, rng.random_range(0.008..0.04) * r);
        let color = inks[rng.random_range(0..2)];
        c.fill(Vec2::ZERO, Vec2::splat(side as f32), color, |p| ((p - middle).length() - at).abs() - wide);
    }
    if rng.random_bool(0.6) {
        let (n, at) = (rng.random_range(6..22), rng.random_range(0.25..0.85) * r);
        let length = (TAU * at / n as f32).min(0.35 * r) * rng.random_range(0.6..1.1);
        let tilt = rng.random_range(0.0..PI);
        for k in 0..n {
            let a = TAU * k as f32 / n as f32;
            let p = middle + at * Vec2::new(a.cos(), a.sin());
            leaf(&mut c, p, a + tilt, length, inks[k % 2]);
        }
    }
    if rng.random_bool(0.3) {
        Motif::random(rng, inks[0]).picture(&mut c, rng, middle - 0.35 * r, middle + 0.35 * r);
    }
    c.into_raster()
}
