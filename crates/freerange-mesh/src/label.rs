//! Printed pictures: packaging faces, can labels, stickers. Rectangles, blobs, photographs of noise, and lines of text.

use glam::{Vec2, Vec3};
use rand::Rng;
use rand::seq::IndexedRandom;

use crate::noise;
use crate::palette::{self, Tone};
use crate::texture::Raster;

/// Letters of 3 x 5 pixels, one bit each, top row first.
const GLYPHS: [u16; 21] = [
    0b010_101_111_101_101, // A
    0b110_101_110_101_110, // B
    0b011_100_100_100_011, // C
    0b110_101_101_101_110, // D
    0b111_100_110_100_111, // E
    0b111_100_110_100_100, // F
    0b101_101_111_101_101, // H
    0b111_010_010_010_111, // I
    0b101_101_110_101_101, // K
    0b100_100_100_100_111, // L
    0b101_111_111_101_101, // M
    0b101_111_111_111_101, // N
    0b010_101_101_101_010, // O
    0b110_101_110_100_100, // P
    0b110_101_110_110_101, // R
    0b011_100_010_001_110, // S
    0b111_010_010_010_010, // T
    0b101_101_101_101_111, // U
    0b101_101_010_101_101, // X
    0b101_101_010_010_010, // Y
    0b111_001_010_100_111, // Z
];

/// The colours of one product, shared by all its faces.
#[derive(Clone, Debug)]
pub struct Scheme {
    pub ground: Vec3,
    pub second: Vec3,
    pub ink: Vec3,
    pub accent: Vec3,
    pub paper: Vec3,
}

impl Scheme {
    pub fn random(rng: &mut impl Rng, white_share: f32) -> Self {
        let tone = if rng.random::<f32>() < white_share {
            Tone::White
        } else {
            *[Tone::Saturated, Tone::Saturated, Tone::Saturated, Tone::Pastel, Tone::Dark, Tone::Brown]
                .choose(rng)
                .unwrap_or(&Tone::Saturated)
        };
        let ground = palette::color(rng, tone);
        Self {
            ground,
            second: palette::contrast(rng, ground),
            ink: palette::contrast(rng, ground),
            accent: palette::color(rng, Tone::Saturated),
            paper: palette::color(rng, Tone::White),
        }
    }
}

/// What a printed face shows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Face {
    /// Title, picture, badges.
    Front,
    /// Small print, a table, a bar code.
    Back,
    /// A title on the ground colour.
    Side,
}

/// Draws a face of `width` x `height` pixels.
pub fn draw(rng: &mut impl Rng, scheme: &Scheme, face: Face, width: usize, height: usize) -> Raster {
    let mut canvas = Canvas { raster: Raster::new(width, height, scheme.ground), w: width as f32, h: height as f32 };
    match face {
        Face::Front => front(&mut canvas, rng, scheme),
        Face::Back => back(&mut canvas, rng, scheme),
        Face::Side => side(&mut canvas, rng, scheme),
    }
    canvas.raster
}

fn front(c: &mut Canvas, rng: &mut impl Rng, s: &Scheme) {
    let (w, h) = (c.w, c.h);
    if rng.random_bool(0.35) {
        // Two-tone ground with a straight or wavy border.
        let (y, amplitude, phase) =
            (h * rng.random_range(0.35..0.75), h * rng.random_range(0.0..0.08), rng.random_range(0.0..6.3f32));
        let color = if rng.random_bool(0.5) { s.paper } else { s.second };
        c.fill(Vec2::ZERO, Vec2::new(w, h), |p| {
            (p.y > y + amplitude * (std::f32::consts::TAU * p.x / w + phase).sin()).then_some(color)
        });
    }
    for _ in 0..rng.random_range(1..3) {
        let center = Vec2::new(w * rng.random_range(0.25..0.75), h * rng.random_range(0.45..0.8));
        let size = Vec2::new(w * rng.random_range(0.12..0.4), h * rng.random_range(0.1..0.28));
        photo(c, rng, s, center, size);
    }
    if rng.random_bool(0.6) {
        let y = h * rng.random_range(0.04..0.35);
        let half = h * rng.random_range(0.08..0.17);
        let (inset, color) = (w * rng.random_range(0.0..0.15), if rng.random_bool(0.5) { s.accent } else { s.paper });
        if rng.random_bool(0.5) {
            c.rect(Vec2::new(inset, y), Vec2::new(w - inset, y + 2.0 * half), color);
        } else {
            c.ellipse(Vec2::new(0.5 * w, y + half), Vec2::new(0.5 * w - inset, half), color);
        }
        let ink = palette::contrast(rng, color);
        c.text(rng, Vec2::new(inset + 0.08 * w, y + 0.5 * half), Vec2::new(w - inset - 0.08 * w, y + 1.5 * half), ink);
    } else {
        let y = h * rng.random_range(0.05..0.25);
        let rows = rng.random_range(1..3);
        let size = h * rng.random_range(0.09..0.16);
        for row in 0..rows {
            let top = y + 1.3 * size * row as f32;
            let margin = w * rng.random_range(0.05..0.2);
            c.text(rng, Vec2::new(margin, top), Vec2::new(w - margin, top + size), s.ink);
        }
    }
    for _ in 0..rng.random_range(0..3) {
        let center = Vec2::new(w * rng.random_range(0.1..0.9), h * rng.random_range(0.1..0.95));
        let radius = w.min(h) * rng.random_range(0.04..0.12);
        let color = if rng.random_bool(0.5) { s.accent } else { s.second };
        c.ellipse(center, Vec2::splat(radius), color);
        let ink = palette::contrast(rng, color);
        c.text(rng, center - Vec2::new(0.7, 0.25) * radius, center + Vec2::new(0.7, 0.25) * radius, ink);
    }
    paragraph(c, rng, Vec2::new(w * 0.1, h * 0.88), Vec2::new(w * 0.9, h * 0.97), s.ink);
}

fn back(c: &mut Canvas, rng: &mut impl Rng, s: &Scheme) {
    let (w, h) = (c.w, c.h);
    if rng.random_bool(0.5) {
        c.rect(Vec2::new(0.05 * w, 0.05 * h), Vec2::new(0.95 * w, 0.95 * h), s.paper);
    }
    let split = rng.random_range(0.3..0.6);
    paragraph(c, rng, Vec2::new(w * 0.1, h * 0.1), Vec2::new(w * 0.9, h * split), Vec3::splat(0.02));
    // A table of black lines on white.
    let (lo, hi) = (Vec2::new(w * 0.1, h * (split + 0.05)), Vec2::new(w * 0.55, h * 0.92));
    c.rect(lo, hi, Vec3::splat(0.9));
    paragraph(c, rng, lo + 0.03 * w, hi - 0.03 * w, Vec3::splat(0.02));
    // A bar code.
    let (lo, hi) = (Vec2::new(w * 0.6, h * 0.7), Vec2::new(w * 0.92, h * 0.92));
    c.rect(lo, hi, Vec3::splat(0.92));
    let mut x = lo.x + 2.0;
    while x < hi.x - 3.0 {
        let bar = rng.random_range(1.0..3.0f32);
        c.rect(Vec2::new(x, lo.y + 2.0), Vec2::new(x + bar, hi.y - 3.0), Vec3::splat(0.02));
        x += bar + rng.random_range(1.0..3.0f32);
    }
}

fn side(c: &mut Canvas, rng: &mut impl Rng, s: &Scheme) {
    let (w, h) = (c.w, c.h);
    if rng.random_bool(0.5) {
        let (y, half) = (h * rng.random_range(0.2..0.8), h * rng.random_range(0.05..0.25));
        c.rect(Vec2::new(0.0, y - half), Vec2::new(w, y + half), if rng.random_bool(0.5) { s.second } else { s.paper });
    }
    let (y, size) = (h * rng.random_range(0.15..0.6), h * rng.random_range(0.1..0.3));
    c.text(rng, Vec2::new(0.1 * w, y), Vec2::new(0.9 * w, y + size), s.ink);
    if rng.random_bool(0.5) {
        paragraph(c, rng, Vec2::new(0.15 * w, y + 1.2 * size), Vec2::new(0.85 * w, 0.95 * h), s.ink);
    }
}

/// A picture of food, roughly: an ellipse or box of blotches in three colours.
fn photo(c: &mut Canvas, rng: &mut impl Rng, s: &Scheme, center: Vec2, half: Vec2) {
    let colors = [
        palette::color(rng, Tone::Brown),
        palette::color(rng, Tone::Saturated),
        if rng.random_bool(0.5) { s.accent } else { palette::color(rng, Tone::White) },
    ];
    let (seed, scale, round) = (rng.random(), rng.random_range(3.0..9.0) / c.w, rng.random_bool(0.6));
    c.fill(center - half, center + half, |p| {
        let q = (p - center) / half;
        if round && q.length_squared() > 1.0 {
            return None;
        }
        let n = noise::fbm((p * scale).extend(0.0), seed, 3);
        let i = ((n - 0.2) / 0.6 * 3.0).clamp(0.0, 2.0);
        Some(if i < 1.0 { colors[0].lerp(colors[1], i) } else { colors[1].lerp(colors[2], i - 1.0) })
    });
}

fn paragraph(c: &mut Canvas, rng: &mut impl Rng, lo: Vec2, hi: Vec2, ink: Vec3) {
    let size = rng.random_range(3.0..6.0f32);
    let mut y = lo.y;
    while y + size < hi.y {
        let end = lo.x + (hi.x - lo.x) * rng.random_range(0.5..1.0f32);
        if size < 4.5 {
            c.dashes(rng, Vec2::new(lo.x, y), Vec2::new(end, y + 0.6 * size), ink);
        } else {
            c.text(rng, Vec2::new(lo.x, y), Vec2::new(end, y + size), ink);
        }
        y += 1.6 * size;
    }
}

struct Canvas {
    raster: Raster,
    w: f32,
    h: f32,
}

impl Canvas {
    fn fill(&mut self, lo: Vec2, hi: Vec2, color: impl Fn(Vec2) -> Option<Vec3>) {
        let lo = lo.max(Vec2::ZERO).floor().as_ivec2();
        let hi = hi.min(Vec2::new(self.w, self.h)).ceil().as_ivec2();
        for y in lo.y..hi.y {
            for x in lo.x..hi.x {
                if let Some(color) = color(Vec2::new(x as f32 + 0.5, y as f32 + 0.5)) {
                    self.raster.set(x, y, color);
                }
            }
        }
    }

    fn rect(&mut self, lo: Vec2, hi: Vec2, color: Vec3) {
        self.fill(lo, hi, |_| Some(color));
    }

    fn ellipse(&mut self, center: Vec2, half: Vec2, color: Vec3) {
        self.fill(center - half, center + half, |p| (((p - center) / half).length_squared() <= 1.0).then_some(color));
    }

    /// One line of letters that fills the height, as far as the box reaches.
    fn text(&mut self, rng: &mut impl Rng, lo: Vec2, hi: Vec2, ink: Vec3) {
        let pixel = (hi.y - lo.y) / 5.0;
        let stretch = pixel * rng.random_range(0.8..1.2);
        let letters = (((hi.x - lo.x) / (4.0 * stretch)) as usize).clamp(1, 24);
        let mut gap = rng.random_range(2..9);
        // Centred.
        let start = lo.x + 0.5 * (hi.x - lo.x - letters as f32 * 4.0 * stretch).max(0.0);
        for i in 0..letters {
            if gap == 0 {
                gap = rng.random_range(2..9);
                continue;
            }
            gap -= 1;
            let glyph = GLYPHS[rng.random_range(0..GLYPHS.len())];
            let corner = Vec2::new(start + i as f32 * 4.0 * stretch, lo.y);
            let (size, cell) = (Vec2::new(3.0 * stretch, 5.0 * pixel), Vec2::new(stretch, pixel));
            self.fill(corner, corner + size, |p| {
                let q = ((p - corner) / cell).floor().as_ivec2();
                let bit = 14 - (3 * q.y.clamp(0, 4) + q.x.clamp(0, 2));
                (q.x >= 0 && q.x < 3 && glyph >> bit & 1 == 1).then_some(ink)
            });
        }
    }

    /// One line of small print: dashes of word length.
    fn dashes(&mut self, rng: &mut impl Rng, lo: Vec2, hi: Vec2, ink: Vec3) {
        let mut x = lo.x;
        while x < hi.x {
            let word = rng.random_range(3.0..14.0f32);
            self.rect(Vec2::new(x, lo.y), Vec2::new((x + word).min(hi.x), hi.y), ink);
            x += word + 2.5;
        }
    }
}
