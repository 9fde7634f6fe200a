//! Letters as strokes, and words that read like words. One skeleton per letter; weight, width, slant, serifs and the
//! ends of strokes make the fonts.

use std::sync::LazyLock;

use glam::Vec2;
use rand::Rng;
use rand::seq::IndexedRandom;

use crate::generate::canvas::{Canvas, Ink, segment};

/// Skeletons: polylines of points (column digit, row letter), a = cap height, e = x-height, m = base line, q = below
/// it. A leading `~` rounds the corners.
const SKELETONS: [(char, &str); 57] = [
    ('A', "0m3a6m 1i5i"),
    ('B', "0a0m ~0a6a6g0g ~0g7g7m0m"),
    ('C', "~6c6a0a0m6m6k"),
    ('D', "0a0m ~0a6a6m0m"),
    ('E', "6a0a0m6m 0g5g"),
    ('F', "6a0a0m 0g5g"),
    ('G', "~6c6a0a0m6m6h 6h4h"),
    ('H', "0a0m 6a6m 0g6g"),
    ('I', "0a0m"),
    ('J', "~4a4m0m0j"),
    ('K', "0a0m 6a0h 2f6m"),
    ('L', "0a0m6m"),
    ('M', "0m0a4i8a8m"),
    ('N', "0m0a6m6a"),
    ('O', "~3a6a6m0m0a3a"),
    ('P', "0m0a ~0a6a6g0g"),
    ('Q', "~3a6a6m0m0a3a 4j6m"),
    ('R', "0m0a ~0a6a6g0g 2g6m"),
    ('S', "~6c6a0a0g6g6m0m0k"),
    ('T', "0a6a 3a3m"),
    ('U', "~0a0m6m6a"),
    ('V', "0a3m6a"),
    ('W', "0a2m4c6m8a"),
    ('X', "0a6m 6a0m"),
    ('Y', "0a3g6a 3g3m"),
    ('Z', "0a6a0m6m"),
    ('a', "5e5m ~5g5e0e0m5m5k"),
    ('b', "0a0m ~0g0e5e5m0m0k"),
    ('c', "~5f5e0e0m5m5l"),
    ('d', "5a5m ~5g5e0e0m5m5k"),
    ('e', "~0i5i5e0e0m5m5l"),
    ('f', "~4a2a2e2m 0e4e"),
    ('g', "~5g5e0e0m5m5k ~5e5q0q0p"),
    ('h', "0a0m ~0h0e5e5m"),
    ('i', "0e0m 0b0b"),
    ('k', "0a0m 4e0i 1h4m"),
    ('l', "0a0m"),
    ('m', "0e0m ~0g0e4e4m ~4g4e8e8m"),
    ('n', "0e0m ~0g0e5e5m"),
    ('o', "~2e5e5m0m0e2e"),
    ('p', "0e0q ~0g0e5e5m0m0k"),
    ('r', "0e0m ~0h0e4e4f"),
    ('s', "~4f4e0e0i4i4m0m0l"),
    ('t', "~2b2m4m 0e4e"),
    ('u', "~0e0m4m4j 4e4m"),
    ('v', "0e2m4e"),
    ('w', "0e2m4f6m8e"),
    ('y', "0e2m 5e1q"),
    ('z', "0e4e0m4m"),
    ('0', "~2a5a5m0m0a2a"),
    ('1', "0c2a2m"),
    ('2', "~0d0a5a5e5g0m 0m5m"),
    ('3', "~0a5a5g2g ~2g5g5m0m"),
    ('5', "5a0a0f ~0f5f5m0m"),
    ('7', "0a5a1m"),
    ('8', "~2a5a5g0g0a2a ~2g5g5m0m0g2g"),
    ('%', "6a0m 0a1b 5l6m"),
];

/// The polylines of one letter in units of the cap height, and its width.
struct Skeleton {
    strokes: Vec<Vec<Vec2>>,
    width: f32,
}

static LETTERS: LazyLock<Vec<(char, Skeleton)>> = LazyLock::new(|| {
    SKELETONS
        .iter()
        .map(|&(letter, code)| {
            let strokes: Vec<Vec<Vec2>> = code.split(' ').map(polyline).collect();
            let width = strokes.iter().flatten().map(|p| p.x).fold(0.0, f32::max);
            (letter, Skeleton { strokes, width })
        })
        .collect()
});

fn polyline(code: &str) -> Vec<Vec2> {
    let (round, code) = code.strip_prefix('~').map_or((false, code), |rest| (true, rest));
    let mut points: Vec<Vec2> = code
        .as_bytes()
        .chunks_exact(2)
        .map(|c| Vec2::new(f32::from(c[0] - b'0'), f32::from(c[1] - b'a')) / 12.0)
        .collect();
    if round {
        for _ in 0..2 {
            // Corner cutting: every inner corner becomes two points at 30 % of its edges.
            let mut cut = vec![points[0]];
            for w in points.windows(3) {
                cut.extend([w[1].lerp(w[0], 0.3), w[1].lerp(w[2], 0.3)]);
            }
            cut.push(points[points.len() - 1]);
            points = cut;
        }
    }
    points
}

/// How letters are drawn; lengths in units of the cap height.
#[derive(Clone, Copy, Debug)]
pub struct Font {
    /// Half the thickness of strokes.
    pub half: f32,
    /// Horizontal stretch.
    pub stretch: f32,
    /// Horizontal shift per height.
    pub slant: f32,
    /// Half length of the bars at the feet of stems; 0 without serifs.
    serif: f32,
    /// Flat instead of round ends.
    square: bool,
}

impl Font {
    pub fn random(rng: &mut impl Rng) -> Self {
        Self {
            half: rng.random_range(0.045..0.125),
            stretch: rng.random_range(0.75..1.3),
            slant: if rng.random_bool(0.25) { rng.random_range(0.1..0.35) } else { 0.0 },
            serif: if rng.random_bool(0.3) { rng.random_range(0.1..0.16) } else { 0.0 },
            square: rng.random_bool(0.55),
        }
    }

    /// A light variant for lines below the title.
    pub fn light(self) -> Self {
        Self { half: (0.6 * self.half).max(0.045), ..self }
    }

    /// Width of a word in cap heights.
    fn width(&self, word: &str) -> f32 {
        word.chars().map(|c| self.advance(c)).sum::<f32>() - self.gap()
    }

    fn gap(&self) -> f32 {
        2.0 * self.half + 0.11 + self.serif
    }

    fn advance(&self, c: char) -> f32 {
        letter(c).map_or(0.35, |l| l.width) * self.stretch + self.gap()
    }
}

fn letter(c: char) -> Option<&'static Skeleton> {
    LETTERS.iter().find(|(l, _)| *l == c).map(|(_, skeleton)| skeleton)
}

/// How a line of text is set.
#[derive(Clone, Copy, Debug)]
pub struct Setting {
    pub color: Ink,
    /// An outline of this color and width (in cap heights).
    pub outline: Option<(Ink, f32)>,
    /// How far the middle of the line rises above its ends, in cap heights.
    pub arch: f32,
}

impl Setting {
    pub fn plain(color: Ink) -> Self {
        Self { color, outline: None, arch: 0.0 }
    }
}

/// Draws one line centerd in a box, as large as fits. Returns the cap height in pixels.
pub fn text(canvas: &mut Canvas, word: &str, font: &Font, set: &Setting, lo: Vec2, hi: Vec2) -> f32 {
    let pad = font.half + set.outline.map_or(0.0, |o| o.1);
    let width = font.width(word) + 2.0 * pad + font.slant;
    // Descenders may hang out of the box.
    let tall = 1.0 + 2.0 * pad + set.arch.abs();
    let size = ((hi.x - lo.x) / width).min((hi.y - lo.y) / tall);
    if size < 4.0 {
        if size > 1.0 {
            small_print(canvas, word.len() as u32, lo, hi, set.color);
        }
        return size;
    }
    let center = 0.5 * (lo + hi);
    let (left, top) = (-0.5 * width + pad, -0.5 + 0.5 * set.arch);
    let mut x = 0.0;
    let mut segments = Vec::new();
    for c in word.chars() {
        if let Some(skeleton) = letter(c) {
            let place = |p: Vec2| {
                let q = Vec2::new(x + p.x * font.stretch + font.slant * (1.0 - p.y), p.y);
                let across = 2.0 * q.x / width.max(1e-3) - 1.0;
                center + size * Vec2::new(left + q.x, top + q.y - set.arch * (1.0 - across * across))
            };
            for stroke in &skeleton.strokes {
                let dot = [stroke[0], stroke[0] + 1e-4];
                let points = if stroke.len() > 1 && stroke[0] != stroke[1] { &stroke[..] } else { &dot[..] };
                segments.extend(points.windows(2).map(|w| [place(w[0]), place(w[1])]));
                for end in [points[0], points[points.len() - 1]] {
                    if font.serif > 0.0 && (end.y == 0.0 || end.y == 1.0) {
                        segments.push([-1.0, 1.0].map(|k| place(end + Vec2::X * k * font.serif / font.stretch)));
                    }
                }
            }
        }
        x += font.advance(c);
    }
    strokes(canvas, &segments, size * font.half, font.square, set, size);
    size
}

/// Draws segments as one shape: the least distance per pixel first, then outline and face.
fn strokes(canvas: &mut Canvas, segments: &[[Vec2; 2]], half: f32, square: bool, set: &Setting, size: f32) {
    let half = half.max(0.55);
    let outline = set.outline.map_or(0.0, |o| o.1 * size);
    let reach = half + outline + 1.0;
    let (mut lo, mut hi) = (Vec2::MAX, Vec2::MIN);
    for p in segments.iter().flatten() {
        (lo, hi) = (lo.min(*p), hi.max(*p));
    }
    let lo = (lo - reach).floor().max(Vec2::ZERO);
    let hi = (hi + reach).ceil().min(canvas.size());
    if lo.x >= hi.x || lo.y >= hi.y {
        return;
    }
    let [w, h] = [(hi.x - lo.x) as usize, (hi.y - lo.y) as usize];
    let mut field = vec![f32::MAX; w * h];
    for &[a, b] in segments {
        let (a, b) = (a - lo, b - lo);
        let (from, to) = ((a.min(b) - reach).max(Vec2::ZERO), a.max(b) + reach);
        let [x1, y1] = [(to.x as usize + 1).min(w), (to.y as usize + 1).min(h)];
        let direction = (b - a).normalize_or(Vec2::X);
        let length = (b - a).length();
        for y in from.y as usize..y1 {
            for x in from.x as usize..x1 {
                let p = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
                let d = if square {
                    let q = p - a;
                    let (along, across) = (q.dot(direction), q.perp_dot(direction).abs());
                    // Half a stroke beyond the ends closes corners.
                    across.max(along - length).max(-along)
                } else {
                    segment(p, a, b).0
                };
                let best = &mut field[y * w + x];
                *best = best.min(d);
            }
        }
    }
    let edge = set.outline.map(|o| o.0);
    canvas.paint(lo, hi, |p| {
        let q = p - lo;
        let d = field[(q.y as usize).min(h - 1) * w + (q.x as usize).min(w - 1)];
        let face = (0.5 + half - d).clamp(0.0, 1.0);
        match edge {
            Some(edge) => (edge.lerp(set.color, face), 0.5 + half + outline - d),
            None => (set.color, face),
        }
    });
}

/// One line too small to read: letters as random bars.
fn small_print(canvas: &mut Canvas, seed: u32, lo: Vec2, hi: Vec2, color: Ink) {
    let (step, tall) = (((hi.y - lo.y) * 0.55).max(1.5), hi.y - lo.y);
    let mut state = seed.wrapping_mul(0x9e37_79b9) ^ (lo.x as u32).wrapping_mul(31) ^ (lo.y as u32).wrapping_mul(7919);
    let mut x = lo.x;
    while x + step < hi.x {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let bits = state >> 24;
        if bits & 7 != 0 {
            let top = lo.y + if bits & 8 == 0 { 0.3 * tall } else { 0.0 };
            canvas.rect(Vec2::new(x, top), Vec2::new(x + 0.45 * step, hi.y), color);
            let bar = if bits & 16 == 0 { top } else { 0.5 * (top + hi.y) };
            canvas.rect(Vec2::new(x, bar), Vec2::new(x + 0.8 * step, bar + 0.22 * tall), color);
        }
        x += step;
    }
}

/// Lines of text that fill a box; below six pixels of cap height they become small print.
pub fn paragraph(c: &mut Canvas, rng: &mut impl Rng, font: &Font, lo: Vec2, hi: Vec2, size: f32, color: Ink) {
    let mut y = lo.y;
    while y + size <= hi.y {
        let last = y + 2.7 * size > hi.y;
        let end = lo.x + (hi.x - lo.x) * if last { rng.random_range(0.3..0.9) } else { rng.random_range(0.9..1.0) };
        if size < 6.0 {
            small_print(c, rng.random(), Vec2::new(lo.x, y), Vec2::new(end, y + size), color);
        } else {
            let mut x = lo.x;
            while x < end {
                let word = word(rng, Case::Lower);
                let wide = font.width(&word) * size;
                if x + wide > end {
                    break;
                }
                let set = Setting::plain(color);
                text(c, &word, font, &set, Vec2::new(x, y - 0.2 * size), Vec2::new(x + 1.2 * wide, y + size));
                x += wide + 0.7 * size;
            }
        }
        y += 1.65 * size;
    }
}

/// Which letters are capitals.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Case {
    Upper,
    Title,
    Lower,
}

/// A made-up word of two to three syllables.
pub fn word(rng: &mut impl Rng, case: Case) -> String {
    const STARTS: [&str; 20] =
        ["b", "c", "d", "f", "g", "h", "k", "l", "m", "n", "p", "r", "s", "t", "v", "w", "br", "cr", "st", "pl"];
    const MIDDLES: [&str; 8] = ["a", "e", "i", "o", "u", "ea", "oo", "ai"];
    const ENDS: [&str; 10] = ["", "", "n", "r", "s", "t", "l", "m", "nt", "ck"];
    let mut word = String::new();
    for _ in 0..rng.random_range(1..4) {
        for piece in [&STARTS[..], &MIDDLES[..], &ENDS[..]] {
            word.push_str(piece.choose(rng).copied().unwrap_or("o"));
        }
        if word.len() > 5 {
            break;
        }
    }
    match case {
        Case::Lower => word,
        Case::Upper => word.to_uppercase(),
        Case::Title => word[..1].to_uppercase() + &word[1..],
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn every_letter_of_every_word_can_be_drawn() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for case in [Case::Upper, Case::Title, Case::Lower] {
            for _ in 0..300 {
                let word = word(&mut rng, case);
                assert!(word.len() >= 2 && word.chars().all(|c| letter(c).is_some()), "{word}");
            }
        }
    }

    #[test]
    fn letters_stay_in_their_box_and_leave_ink() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        for _ in 0..40 {
            let (font, word) = (Font::random(&mut rng), word(&mut rng, Case::Upper));
            let mut c = Canvas::new(200, 100, Vec3::ZERO);
            let (lo, hi) = (Vec2::new(20.0, 30.0), Vec2::new(180.0, 70.0));
            let size = text(&mut c, &word, &font, &Setting::plain(Vec3::splat(255.0)), lo, hi);
            let raster = c.into_raster();
            let (mut inside, mut outside) = (0.0, 0.0);
            for y in 0..100 {
                for x in 0..200 {
                    let v = raster.sample(Vec2::new((x as f32 + 0.5) / 200.0, 1.0 - (y as f32 + 0.5) / 100.0)).x;
                    // Serifs and slanted feet may stick out a little.
                    let p = Vec2::new(x as f32, y as f32);
                    let within = p.cmpge(lo - 0.25 * size - 2.0).all() && p.cmple(hi + 0.25 * size + 2.0).all();
                    *(if within { &mut inside } else { &mut outside }) += v;
                }
            }
            assert!(inside > 30.0 && outside == 0.0, "{word}: {inside} inside, {outside} outside, size {size}");
        }
    }
}
