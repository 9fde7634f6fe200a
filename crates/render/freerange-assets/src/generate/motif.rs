//! Pictures on packaging: heaps of food, landscapes, animals, fruit; and the shapes behind brand names.

use std::f32::consts::TAU;

use glam::{Vec2, Vec3};
use rand::Rng;

use crate::generate::canvas::{Canvas, Ink, ellipse_distance, ink};
use crate::generate::palette::{self, Tone};

/// What the pictures of one product show.
#[derive(Clone, Debug)]
pub struct Motif {
    subject: Subject,
    colors: [Ink; 3],
    leaf: Ink,
}

#[derive(Clone, Copy, Debug)]
enum Subject {
    /// Many small shaded pieces: berries, noodles, rings, cubes.
    Heap(Piece),
    /// One to three large fruits with leaves.
    Fruit,
    /// Sky, hills, a sun, perhaps a spotted animal.
    Landscape,
    /// A bowl or plate with a heap in it.
    Dish(Piece),
    /// Soft blobs, as of liquid or cloth.
    Swirl,
}

#[derive(Clone, Copy, Debug)]
enum Piece {
    Ball,
    Crescent,
    Ring,
    Stick,
}

impl Motif {
    pub fn random(rng: &mut impl Rng, accent: Ink) -> Self {
        let piece = [Piece::Ball, Piece::Crescent, Piece::Ring, Piece::Stick][rng.random_range(0..4)];
        let subject = match rng.random_range(0..10) {
            0..3 => Subject::Heap(piece),
            3..5 => Subject::Fruit,
            5..7 => Subject::Landscape,
            7..9 => Subject::Dish(piece),
            _ => Subject::Swirl,
        };
        let hue = rng.random_range(-0.03..0.16f32);
        let food = palette::hsv(hue, rng.random_range(0.6..0.95), rng.random_range(0.6..1.0));
        let other = if rng.random_bool(0.5) { Tone::Saturated } else { Tone::Brown };
        let third = if rng.random_bool(0.4) { accent } else { ink(palette::color(rng, Tone::White)) };
        let leaf = ink(palette::hsv(rng.random_range(0.22..0.38), 0.75, rng.random_range(0.35..0.7)));
        Self { subject, colors: [ink(food), ink(palette::color(rng, other)), third], leaf }
    }

    /// Draws the subject within a box.
    pub fn picture(&self, c: &mut Canvas, rng: &mut impl Rng, lo: Vec2, hi: Vec2) {
        let (middle, half) = (0.5 * (lo + hi), 0.5 * (hi - lo));
        if half.min_element() < 3.0 {
            return;
        }
        match self.subject {
            Subject::Heap(piece) => {
                // An oval of pieces.
                let n = 14.0 + 20.0 * rng.random::<f32>();
                let size = 1.7 * (half.x * half.y / n).sqrt();
                for _ in 0..n as usize {
                    let (a, r) = (rng.random_range(0.0..TAU), rng.random::<f32>().sqrt() * 0.8);
                    self.piece(c, rng, piece, middle + half * r * Vec2::new(a.cos(), a.sin()), size * 0.6);
                }
            }
            Subject::Fruit => {
                for k in 0..rng.random_range(1..4) {
                    let side = [0.0, -0.5, 0.5][k];
                    let r = half.min_element() * rng.random_range(0.6..0.85);
                    let p = middle + Vec2::new(side * half.x, rng.random_range(0.0..0.25) * half.y);
                    self.ball(c, p, Vec2::new(r, r * rng.random_range(0.85..1.1)), self.colors[usize::from(k == 2)]);
                    for way in [-0.9f32, 0.9] {
                        let tip = p + Vec2::new(way * 0.6 * r, -1.05 * r);
                        let points = [p - Vec2::Y * 0.8 * r, p + Vec2::new(way * 0.3 * r, -1.05 * r), tip];
                        c.stroke(&points, 0.14 * r, 0.2, self.leaf);
                    }
                }
            }
            Subject::Landscape => self.landscape(c, rng, lo, hi),
            Subject::Dish(piece) => {
                let plate = Vec2::new(half.x, 0.62 * half.y);
                let p = middle + Vec2::Y * 0.3 * half.y;
                self.ball(c, p, plate, self.colors[2]);
                let n = 20;
                let size = 0.9 * (half.x * half.y / n as f32).sqrt();
                for _ in 0..n {
                    let (a, r) = (rng.random_range(0.0..TAU), rng.random::<f32>().sqrt());
                    let q = p + Vec2::new(0.7 * plate.x * r * a.cos(), 0.6 * plate.y * r * a.sin() - 0.3 * half.y);
                    self.piece(c, rng, piece, q, 0.8 * size);
                }
            }
            Subject::Swirl => {
                let (scale, phase) = (5.0 / half.x, rng.random_range(0.0..TAU));
                c.paint(lo, hi, |p| {
                    let q = p - middle;
                    let x = (scale * q.x + 1.5 * (scale * q.y + phase).sin()).sin()
                        + 0.8 * (0.7 * scale * (q.y - q.x)).cos();
                    let t = (0.5 + 0.28 * x).clamp(0.0, 1.0);
                    let color = if t < 0.5 {
                        self.colors[0].lerp(self.colors[1], 2.0 * t)
                    } else {
                        self.colors[1].lerp(self.colors[2], 2.0 * t - 1.0)
                    };
                    (color, 0.5 - ellipse_distance(q, half - 1.0))
                });
            }
        }
    }

    /// Fills a box with pieces.
    pub fn heap(&self, c: &mut Canvas, rng: &mut impl Rng, lo: Vec2, hi: Vec2) {
        let size = hi - lo;
        let piece = match self.subject {
            Subject::Heap(piece) | Subject::Dish(piece) => piece,
            _ => Piece::Ball,
        };
        c.rect(lo, hi, 0.55 * self.colors[0]);
        let n = 90;
        let radius = 0.75 * (size.x * size.y / n as f32).sqrt();
        for _ in 0..n {
            let p = lo + size * Vec2::new(rng.random(), rng.random());
            self.piece(c, rng, piece, p.clamp(lo + 0.6 * radius, hi), radius);
        }
    }

    /// An ellipse lit from the upper left.
    fn ball(&self, c: &mut Canvas, center: Vec2, half: Vec2, color: Ink) {
        c.paint(center - half - 1.0, center + half + 1.0, |p| {
            let q = (p - center) / half;
            let light = 1.08 - 0.45 * (q + Vec2::new(0.35, 0.4)).length_squared();
            let shine = (1.0 - 9.0 * (q + Vec2::new(0.38, 0.42)).length_squared()).max(0.0);
            (
                (color * light.max(0.35)).lerp(Vec3::splat(255.0), 0.7 * shine).min(Vec3::splat(255.0)),
                0.5 - ellipse_distance(p - center, half),
            )
        });
    }

    fn piece(&self, c: &mut Canvas, rng: &mut impl Rng, piece: Piece, p: Vec2, size: f32) {
        let color = self.colors[[0, 0, 0, 1, 2][rng.random_range(0..5)]] * rng.random_range(0.8..1.0f32);
        let angle = rng.random_range(0.0..TAU);
        let d = Vec2::new(angle.cos(), angle.sin());
        match piece {
            Piece::Ball => self.ball(c, p, Vec2::splat(0.8 * size), color),
            Piece::Stick => {
                c.stroke(&[p - size * d, p + size * d], 0.27 * size, 1.0, color * 0.6);
                c.stroke(&[p - size * d - 0.08 * size, p + size * d - 0.08 * size], 0.17 * size, 1.0, color);
            }
            Piece::Ring | Piece::Crescent => {
                let span = if matches!(piece, Piece::Ring) { TAU } else { 0.55 * TAU };
                let at = |k: usize| {
                    let a = angle + span * k as f32 / 8.0;
                    p + 0.65 * size * Vec2::new(a.cos(), a.sin())
                };
                let points: [Vec2; 9] = std::array::from_fn(at);
                c.stroke(&points, 0.3 * size, 1.0, color * 0.55);
                c.stroke(&points.map(|q| q - 0.07 * size), 0.18 * size, 1.0, color);
            }
        }
    }

    fn landscape(&self, c: &mut Canvas, rng: &mut impl Rng, lo: Vec2, hi: Vec2) {
        let size = hi - lo;
        let sky = Vec3::new(110.0, 175.0, 235.0);
        c.paint(lo, hi, |p| (sky.lerp(Vec3::splat(240.0), (p.y - lo.y) / size.y), 1.0));
        let sun = lo + size * Vec2::new(rng.random_range(0.15..0.85), 0.25);
        c.ellipse(sun, Vec2::splat(0.12 * size.min_element()), Vec3::new(255.0, 215.0, 90.0));
        for k in 0..3 {
            let (base, swing) = (0.45 + 0.16 * k as f32, rng.random_range(0.04..0.12));
            let (rate, phase) = (rng.random_range(3.0..8.0), rng.random_range(0.0..TAU));
            let color = self.leaf.lerp(sky, 0.35 - 0.15 * k as f32);
            c.fill(lo, hi, color, |p| {
                let q = (p - lo) / size;
                ((base + swing * (rate * q.x + phase).sin() - q.y) * size.y)
                    .max(lo.x - p.x)
                    .max(p.x - hi.x)
                    .max(p.y - hi.y)
            });
        }
        if rng.random_bool(0.7) {
            // A spotted animal: body, head, legs, spots.
            let (white, dark) = (Vec3::splat(243.0), Vec3::splat(28.0));
            let unit = 0.2 * size.min_element();
            let p = lo + size * Vec2::new(rng.random_range(0.35..0.65), 0.68);
            for leg in [-1.0, -0.6, 0.6, 1.0] {
                c.stroke(&[p + unit * Vec2::new(leg, 0.3), p + unit * Vec2::new(leg, 1.3)], 0.16 * unit, 1.0, white);
            }
            c.ellipse(p, unit * Vec2::new(1.3, 0.75), white);
            c.ellipse(p + unit * Vec2::new(1.45, -0.55), unit * Vec2::new(0.5, 0.42), white);
            for _ in 0..4 {
                let q = p + unit * Vec2::new(rng.random_range(-0.9..0.9), rng.random_range(-0.35..0.35));
                c.polar(q, 0.3 * unit, dark, |a| 1.0 + 0.25 * (3.0 * a).sin());
            }
            c.ellipse(p + unit * Vec2::new(1.75, -0.45), unit * Vec2::new(0.2, 0.25), dark);
        }
    }
}

/// The shape behind a brand name.
#[derive(Clone, Copy, Debug)]
pub enum Logo {
    Bare,
    Oval,
    Pill,
    Ribbon,
    Shield,
    Star(f32),
    Leaves,
    Rings,
}

impl Logo {
    pub fn random(rng: &mut impl Rng) -> Self {
        match rng.random_range(0..10) {
            0..2 => Self::Bare,
            2..4 => Self::Oval,
            4 => Self::Pill,
            5 => Self::Ribbon,
            6 => Self::Shield,
            7 => Self::Star(rng.random_range(5..13) as f32),
            8 => Self::Leaves,
            _ => Self::Rings,
        }
    }

    /// Draws the shape in a box; false if the name stands on the ground itself.
    pub fn draw(&self, c: &mut Canvas, lo: Vec2, hi: Vec2, color: Ink, edge: Ink) -> bool {
        let (middle, half) = (0.5 * (lo + hi), 0.5 * (hi - lo));
        let rim = 0.07 * half.min_element();
        match *self {
            Self::Bare => return false,
            Self::Oval => {
                c.ellipse(middle, half, edge);
                c.ellipse(middle, half - rim, color);
            }
            Self::Pill => c.rounded(lo, hi, 0.5 * half.y, color),
            Self::Ribbon => {
                let tail = Vec2::new(0.25 * half.x, 0.3 * half.y);
                for side in [-1.0, 1.0] {
                    let p = middle + Vec2::new(side * (half.x - 0.5 * tail.x), tail.y);
                    c.rect(p - Vec2::new(tail.x, 0.5 * half.y), p + Vec2::new(tail.x, 0.5 * half.y), color * 0.6);
                }
                c.rect(lo + Vec2::new(tail.x, 0.25 * half.y), hi - Vec2::new(tail.x, 0.25 * half.y), color);
            }
            Self::Shield => {
                let shape = |p: Vec2, r: f32| {
                    let q = (p - middle) / half;
                    let reach = if q.y < 0.0 { 1.0 } else { (1.0 - q.y * q.y).max(0.0).sqrt() };
                    (q.x.abs() - reach).max(q.y.abs() - 1.0) * half.min_element() + r
                };
                c.fill(lo, hi, edge, |p| shape(p, 0.0));
                c.fill(lo, hi, color, |p| shape(p, rim));
            }
            Self::Star(points) => {
                // Around the name, wide and low.
                c.paint(lo, hi, |p| {
                    let q = (p - middle) / half;
                    let reach = 0.88 + 0.12 * (points * 2.0 * q.y.atan2(q.x)).cos();
                    (color, 0.5 + (reach - q.length()) * half.min_element())
                });
            }
            Self::Leaves => {
                for side in [-1.0f32, 1.0] {
                    for k in 0..5 {
                        let a = 0.5 + 0.45 * k as f32;
                        let p = middle + half * Vec2::new(side * a.sin(), 0.9 * a.cos());
                        let q = middle + half * Vec2::new(side * 0.8 * (a + 0.4).sin(), 0.6 * (a + 0.4).cos());
                        c.stroke(&[q, 0.5 * (p + q), p], 0.11 * half.y, 0.4, color);
                    }
                }
                return false;
            }
            Self::Rings => {
                for (k, r) in [1.0, 0.93, 0.86, 0.8].into_iter().enumerate() {
                    c.ellipse(middle, half * r, if k % 2 == 0 { color } else { edge });
                }
                c.ellipse(middle, half * 0.74, color);
            }
        }
        true
    }
}
