//! Printed packaging: the faces of one product share its colors, brand, title and picture.

use std::f32::consts::TAU;

use glam::{Vec2, Vec3};
use rand::Rng;
use rand::seq::IndexedRandom;

use crate::generate::canvas::{Canvas, Ink, ink};
use crate::generate::glyph::{self, Case, Font, Setting, paragraph};
use crate::generate::motif::{Logo, Motif};
use crate::generate::palette::{self, Tone};
use crate::mesh::Raster;

/// The colors of one product, shared by all its faces; linear.
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
    /// Brand, title, picture, badges.
    Front,
    /// Small print, a table, a bar code.
    Back,
    /// A title on the ground color.
    Side,
    /// A label around a body: fronts and a back next to each other.
    Wrap,
    /// The body's color with one label on the front and one on the back.
    Sticker,
}

/// Colors encoded for drawing.
struct Inks {
    ground: Ink,
    second: Ink,
    ink: Ink,
    accent: Ink,
    paper: Ink,
    dark: Ink,
}

/// How the ground of a face is filled.
#[derive(Clone, Copy, Debug)]
enum Ground {
    Plain,
    /// Two colors with a border at this height, its wave and its phase.
    Split(f32, f32, f32),
    Slanted(f32),
    Gradient,
    Rays(f32),
    Stripes(f32),
    Gingham(f32),
    Heap,
}

/// One product: everything its faces have in common.
pub struct Product {
    inks: Inks,
    brand: String,
    title: Vec<String>,
    fonts: [Font; 2],
    outline: Option<(bool, f32)>,
    arch: f32,
    logo: Logo,
    motif: Motif,
    ground: Ground,
    /// Heights of brand, title and picture on the front, top to bottom, and whether the picture comes first.
    split: [f32; 2],
    picture_first: bool,
}

impl Product {
    pub fn random(rng: &mut impl Rng, scheme: &Scheme) -> Self {
        let inks = Inks {
            ground: ink(scheme.ground),
            second: ink(scheme.second),
            ink: ink(scheme.ink),
            accent: ink(scheme.accent),
            paper: ink(scheme.paper),
            dark: ink(Vec3::splat(0.02)),
        };
        let case = if rng.random_bool(0.65) { Case::Upper } else { Case::Title };
        let brand_case = if rng.random_bool(0.5) { Case::Title } else { Case::Upper };
        Self {
            brand: glyph::word(rng, brand_case),
            title: (0..rng.random_range(1..4)).map(|_| glyph::word(rng, case)).collect(),
            fonts: [Font::random(rng), Font::random(rng)],
            outline: rng.random_bool(0.45).then(|| (rng.random_bool(0.5), rng.random_range(0.04..0.1))),
            arch: if rng.random_bool(0.25) { rng.random_range(0.2..0.6) } else { 0.0 },
            logo: Logo::random(rng),
            motif: Motif::random(rng, inks.accent),
            ground: match rng.random_range(0..16) {
                0..4 => Ground::Plain,
                4..7 => {
                    Ground::Split(rng.random_range(0.3..0.75), rng.random_range(0.0..0.1), rng.random_range(0.0..TAU))
                }
                7 => Ground::Slanted(rng.random_range(-0.6..0.6)),
                8..10 => Ground::Gradient,
                10 => Ground::Rays(rng.random_range(8.0..20.0f32).round()),
                11 => Ground::Stripes(rng.random_range(3.0..16.0)),
                12 => Ground::Gingham(rng.random_range(6.0..16.0)),
                13 => Ground::Heap,
                _ => Ground::Split(rng.random_range(0.15..0.3), 0.0, 0.0),
            },
            split: [rng.random_range(0.14..0.26), rng.random_range(0.45..0.62)],
            picture_first: rng.random_bool(0.3),
            inks,
        }
    }

    /// Draws a face of `width` x `height` pixels.
    pub fn draw(&self, rng: &mut impl Rng, face: Face, width: usize, height: usize) -> Raster {
        let mut c = Canvas::new(width, height, self.inks.ground);
        let (lo, hi) = (Vec2::ZERO, c.size());
        match face {
            Face::Front => self.front(&mut c, rng, lo, hi),
            Face::Back => self.back(&mut c, rng, lo, hi),
            Face::Side => self.side(&mut c, rng, lo, hi),
            Face::Wrap => {
                // Front, back, front: the fronts face opposite ways.
                self.backdrop(&mut c, rng, lo, hi);
                let w = hi.x;
                let panel = (0.46 * w).min(1.4 * hi.y);
                for middle in [0.25, 0.75] {
                    let x = middle * w - 0.5 * panel;
                    self.front_items(&mut c, rng, Vec2::new(x, 0.0), Vec2::new(x + panel, hi.y));
                }
                let narrow = (0.5 * w - panel).max(0.16 * w) * 0.5;
                let (a, b) = (Vec2::new(0.5 * w - narrow, 0.0), Vec2::new(0.5 * w + narrow, hi.y));
                self.back(&mut c, rng, a, b);
            }
            Face::Sticker => {
                let (w, h) = (hi.x, hi.y);
                let round = rng.random_range(0.0..0.5f32);
                let half = Vec2::new((w * rng.random_range(0.14..0.21)).min(0.75 * h), h * rng.random_range(0.3..0.47));
                for (i, middle) in [0.25, 0.75].into_iter().enumerate() {
                    let center = Vec2::new(w * middle, 0.5 * h);
                    let corner = round * 2.0 * half.min_element();
                    let rim = 0.02 * h;
                    let (border, face) = (self.inks.accent, if i == 0 { self.inks.paper } else { self.inks.second });
                    c.rounded(center - half, center + half, corner, border);
                    c.rounded(center - half + rim, center + half - rim, corner - rim, face);
                    let inner = half * (1.0 - 0.3 * round) - 2.0 * rim;
                    if i == 0 {
                        self.front_items(&mut c, rng, center - inner, center + inner);
                    } else {
                        self.facts(&mut c, rng, center - inner, center + inner);
                    }
                }
            }
        }
        c.into_raster()
    }

    fn backdrop(&self, c: &mut Canvas, rng: &mut impl Rng, lo: Vec2, hi: Vec2) {
        let (i, size) = (&self.inks, hi - lo);
        let other = i.second.lerp(i.ground, 0.15);
        match self.ground {
            Ground::Plain => {}
            Ground::Split(at, wave, phase) => {
                let x_scale = 2.0 * TAU / size.x;
                c.fill(lo, hi, other, |p| lo.y + size.y * (at + wave * (x_scale * (p.x - lo.x) + phase).sin()) - p.y);
                if wave == 0.0 {
                    let y = lo.y + at * size.y;
                    c.rect(Vec2::new(lo.x, y - 0.012 * size.y), Vec2::new(hi.x, y + 0.012 * size.y), i.accent);
                }
            }
            Ground::Slanted(slope) => {
                let middle = 0.5 * (lo + hi);
                c.fill(lo, hi, other, |p| middle.y + slope * (p.x - middle.x) - p.y);
            }
            Ground::Gradient => {
                let end = i.ground.lerp(i.accent, 0.6);
                c.paint(lo, hi, |p| (i.ground.lerp(end, (p.y - lo.y) / size.y), 1.0));
            }
            Ground::Rays(count) => {
                let middle = lo + size * Vec2::new(0.5, 0.6);
                let pale = i.ground.lerp(i.paper, 0.35);
                c.paint(lo, hi, |p| {
                    let q = p - middle;
                    (pale, 0.5 + 0.15 * q.length() * (count * q.y.atan2(q.x)).sin())
                });
            }
            Ground::Stripes(count) => {
                let period = size.x / count.round();
                c.fill(lo, hi, other, |p| ((p.x - lo.x).rem_euclid(period) - 0.5 * period).abs() - 0.25 * period);
            }
            Ground::Gingham(count) => {
                let period = size.x / count.round();
                let pale = i.ground.lerp(i.paper, 0.5);
                c.paint(lo, hi, |p| {
                    let on = |x: f32| if x.rem_euclid(period) < 0.5 * period { 0.5 } else { 0.0 };
                    (pale, on(p.x - lo.x) + on(p.y - lo.y))
                });
            }
            Ground::Heap => {
                let band = Vec2::new(lo.x, lo.y + size.y * 0.5);
                self.motif.heap(c, rng, band, hi);
            }
        }
    }

    fn front(&self, c: &mut Canvas, rng: &mut impl Rng, lo: Vec2, hi: Vec2) {
        self.backdrop(c, rng, lo, hi);
        self.front_items(c, rng, lo, hi);
    }

    fn front_items(&self, c: &mut Canvas, rng: &mut impl Rng, lo: Vec2, hi: Vec2) {
        let size = hi - lo;
        let at = |x: f32, y: f32| lo + size * Vec2::new(x, y);
        if size.x > 2.2 * size.y {
            // Wide: picture at the left, words at the right.
            self.motif.picture(c, rng, at(0.02, 0.08), at(0.34, 0.92));
            self.logo(c, rng, at(0.38, 0.06), at(0.7, 0.36));
            self.title(c, at(0.38, 0.4), at(0.97, 0.85));
            return;
        }
        let [a, b] = self.split;
        self.logo(c, rng, at(0.2, 0.03), at(0.8, a));
        let (words, picture) = if self.picture_first {
            ([b + 0.08, 0.93], [a + 0.02, b + 0.06])
        } else {
            ([a + 0.02, b], [b + 0.02, 0.92])
        };
        self.motif.picture(c, rng, at(0.08, picture[0]), at(0.92, picture[1]));
        self.title(c, at(0.06, words[0]), at(0.94, words[1]));
        for _ in 0..rng.random_range(0..3) {
            let center = at(rng.random_range(0.12..0.88), rng.random_range(0.3..0.9));
            let radius = size.min_element() * rng.random_range(0.06..0.13);
            self.badge(c, rng, center, radius);
        }
        let set = Setting::plain(self.on(self.inks.ground));
        glyph::text(c, "NET WT 12 5", &self.fonts[1].light(), &set, at(0.1, 0.94), at(0.6, 0.985));
    }

    /// A color that reads on `ground`.
    fn on(&self, ground: Ink) -> Ink {
        let far = |c: Ink| (c - ground).length();
        [self.inks.ink, self.inks.paper, self.inks.dark]
            .into_iter()
            .reduce(|a, b| if far(a) > 130.0 || far(a) >= far(b) { a } else { b })
            .unwrap_or(self.inks.dark)
    }

    fn title(&self, c: &mut Canvas, lo: Vec2, hi: Vec2) {
        let rows = self.title.len() as f32;
        let (face, edge) = match self.outline {
            Some((true, width)) => (self.inks.paper, Some((self.inks.accent.lerp(self.inks.dark, 0.5), width))),
            Some((false, width)) => (self.inks.accent, Some((self.on(self.inks.accent), width))),
            None => (self.on(self.inks.ground), None),
        };
        for (k, word) in self.title.iter().enumerate() {
            let step = (hi.y - lo.y) / rows;
            let (top, bottom) = (lo.y + step * (k as f32 + 0.04), lo.y + step * (k as f32 + 0.96));
            let set = Setting { color: face, outline: edge, arch: if k == 0 { self.arch } else { 0.0 } };
            glyph::text(c, word, &self.fonts[0], &set, Vec2::new(lo.x, top), Vec2::new(hi.x, bottom));
        }
    }

    /// The brand on its shape.
    fn logo(&self, c: &mut Canvas, rng: &mut impl Rng, lo: Vec2, hi: Vec2) {
        let shape = if rng.random_bool(0.5) { self.inks.accent } else { self.inks.second };
        let field = self.logo.draw(c, lo, hi, shape, self.inks.paper);
        let set = Setting::plain(self.on(if field { shape } else { self.inks.ground }));
        let inset = (hi - lo) * Vec2::new(0.17, 0.27);
        glyph::text(c, &self.brand, &self.fonts[1], &set, lo + inset, hi - inset);
    }

    fn badge(&self, c: &mut Canvas, rng: &mut impl Rng, center: Vec2, radius: f32) {
        let color = if rng.random_bool(0.5) { self.inks.accent } else { self.inks.second };
        let points = rng.random_range(8..20) as f32;
        let depth = if rng.random_bool(0.5) { 0.12 } else { 0.0 };
        c.polar(center, radius, color, |angle| 1.0 + depth * (points * angle).sin());
        let word = ["NEW", "100%", "50%", "FRESH", "2 IN 1", "BIO"][rng.random_range(0..6)];
        let reach = radius * Vec2::new(0.75, 0.4);
        glyph::text(c, word, &self.fonts[1], &Setting::plain(self.on(color)), center - reach, center + reach);
    }

    fn side(&self, c: &mut Canvas, rng: &mut impl Rng, lo: Vec2, hi: Vec2) {
        if rng.random_bool(0.6) {
            self.backdrop(c, rng, lo, hi);
        }
        let size = hi - lo;
        let at = |x: f32, y: f32| lo + size * Vec2::new(x, y);
        if size.x > 1.6 * size.y {
            self.title(c, at(0.08, 0.14), at(0.92, 0.86));
            return;
        }
        match rng.random_range(0..3) {
            0 => {
                self.logo(c, rng, at(0.12, 0.08), at(0.88, 0.3));
                self.facts(c, rng, at(0.1, 0.36), at(0.9, 0.95));
            }
            1 => {
                self.title(c, at(0.06, 0.08), at(0.94, 0.45));
                self.motif.picture(c, rng, at(0.06, 0.5), at(0.94, 0.95));
            }
            _ => {
                self.title(c, at(0.06, 0.06), at(0.94, 0.3));
                let color = self.on(self.inks.ground);
                paragraph(
                    c,
                    rng,
                    &self.fonts[1].light(),
                    at(0.1, 0.36),
                    at(0.9, 0.92),
                    (0.035 * size.y).max(3.0),
                    color,
                );
            }
        }
    }

    fn back(&self, c: &mut Canvas, rng: &mut impl Rng, lo: Vec2, hi: Vec2) {
        let size = hi - lo;
        let at = |x: f32, y: f32| lo + size * Vec2::new(x, y);
        c.rect(lo, hi, self.inks.ground);
        let panel = if rng.random_bool(0.6) { self.inks.paper } else { self.inks.ground };
        c.rounded(at(0.04, 0.03), at(0.96, 0.97), 0.03 * size.min_element(), panel);
        let color = self.on(panel);
        self.title(c, at(0.1, 0.06), at(0.9, 0.2));
        let small = (0.016 * size.y).clamp(3.0, 9.0);
        paragraph(c, rng, &self.fonts[1].light(), at(0.1, 0.24), at(0.9, 0.44), small, color);
        if size.x > 0.5 * size.y {
            self.facts(c, rng, at(0.08, 0.48), at(0.52, 0.94));
            barcode(c, rng, at(0.58, 0.74), at(0.92, 0.94));
            self.motif.picture(c, rng, at(0.56, 0.47), at(0.94, 0.71));
        } else {
            self.facts(c, rng, at(0.1, 0.48), at(0.9, 0.78));
            barcode(c, rng, at(0.16, 0.82), at(0.84, 0.95));
        }
    }

    /// A table of numbers on white, ruled in black.
    fn facts(&self, c: &mut Canvas, rng: &mut impl Rng, lo: Vec2, hi: Vec2) {
        let (white, black, size) = (Vec3::splat(245.0), self.inks.dark, hi - lo);
        let line = (0.008 * size.y).max(0.8);
        c.rect(lo, hi, black);
        c.rect(lo + line, hi - line, white);
        let (left, right) = (lo.x + 0.06 * size.x, hi.x - 0.06 * size.x);
        let head = lo.y + 0.14 * size.y;
        let font = self.fonts[1];
        glyph::text(
            c,
            "FACTS",
            &font,
            &Setting::plain(black),
            Vec2::new(left, lo.y + 0.03 * size.y),
            Vec2::new(right, head),
        );
        c.rect(Vec2::new(left, head), Vec2::new(right, head + 2.5 * line), black);
        let rows = ((size.y * 0.8 / 9.0) as usize).clamp(3, 11);
        let step = (hi.y - head - 4.0 * line) / rows as f32;
        for row in 0..rows {
            let y = head + 4.0 * line + row as f32 * step;
            let tall = (0.55 * step).min(8.0);
            let reach = left + (right - left) * rng.random_range(0.3..0.65);
            paragraph(c, rng, &font.light(), Vec2::new(left, y), Vec2::new(reach, y + tall), tall.min(5.9), black);
            let number = right - 0.16 * size.x;
            paragraph(c, rng, &font.light(), Vec2::new(number, y), Vec2::new(right, y + tall), tall.min(5.9), black);
            let rule = y + 0.85 * step;
            c.rect(Vec2::new(left, rule), Vec2::new(right, rule + 0.5 * line), black);
        }
    }
}

fn barcode(c: &mut Canvas, rng: &mut impl Rng, lo: Vec2, hi: Vec2) {
    let (white, black) = (Vec3::splat(248.0), Vec3::splat(12.0));
    c.rect(lo, hi, white);
    let module = ((hi.x - lo.x) / 60.0).max(0.8);
    let foot = hi.y - 0.18 * (hi.y - lo.y);
    let mut x = lo.x + 4.0 * module;
    while x < hi.x - 5.0 * module {
        let bar = module * rng.random_range(1..4) as f32;
        c.rect(Vec2::new(x, lo.y + 2.0 * module), Vec2::new(x + bar, foot), black);
        x += bar + module * rng.random_range(1..4) as f32;
    }
    let mut font = Font::random(rng);
    font.half = 0.06;
    paragraph(
        c,
        rng,
        &font,
        Vec2::new(lo.x + 4.0 * module, foot + 1.0),
        Vec2::new(hi.x - 4.0 * module, hi.y),
        4.0,
        black,
    );
}
