//! Patterns of made things: woven and knitted strands, plaid, brushed metal, terrazzo, glaze, crumb.

use std::f32::consts::TAU;

use glam::{IVec3, Vec2, Vec3};

use crate::mesh::noise;

/// Where the two coordinates of a flat pattern come from.
#[derive(Clone, Copy, Debug)]
pub enum Frame {
    /// Surface coordinates times the numbers of cells.
    Uv(Vec2),
    /// Projections of the rest position; the lengths are cells per unit.
    Solid([Vec3; 2]),
    /// The angle about z with this many cells per turn, and z with cells per unit.
    Around(f32, f32),
}

impl Frame {
    fn coordinates(&self, p: Vec3, uv: Vec2) -> Vec2 {
        match *self {
            Self::Uv(cells) => uv * cells,
            Self::Solid([a, b]) => Vec2::new(p.dot(a), p.dot(b)),
            Self::Around(turn, rows) => Vec2::new(p.y.atan2(p.x) / TAU * turn, p.z * rows),
        }
    }
}

/// What the pattern is. Colors are linear.
#[derive(Clone, Debug)]
#[allow(missing_docs, reason = "colors and sizes of what the line above each names")]
pub enum Form {
    /// Strands over and under each other: `float` strands are passed at a time (1 is plain weave, 2 twill).
    Weave { warp: Vec3, weft: Vec3, gap: Vec3, float: i32, thin: f32 },
    /// Columns of V-shaped stitches; rows of colors `a` and `b` as the hash says.
    Knit { a: Vec3, b: Vec3, share: f32 },
    /// Crossing bands of up to three colors with a twill hatch.
    Plaid { colors: [Vec3; 3], hatch: f32 },
    /// Zigzag rows.
    Chevron { a: Vec3, b: Vec3, steep: f32 },
    /// Fine streaks along the first coordinate.
    Brushed { a: Vec3, b: Vec3 },
    /// Rings about z, colored by turns, with thin lines between.
    Rings { colors: [Vec3; 3], stops: [f32; 3] },
    /// Chips of stone in a ground; cells per unit.
    Terrazzo { ground: Vec3, chips: [Vec3; 3], scale: f32 },
    /// Glaze over clay: runs down from the top to about `height`, pooled darker at its border, with specks.
    Glaze { glaze: Vec3, clay: Vec3, height: f32, run: f32 },
    /// Pores and brown patches of baked things; pores per unit.
    Crumb { crust: Vec3, crumb: Vec3, scale: f32 },
}

/// A flat or solid pattern over the surface.
#[derive(Clone, Debug)]
pub struct Pattern {
    /// Where its two coordinates come from.
    pub frame: Frame,
    /// What it is.
    pub form: Form,
    /// Noise seed.
    pub seed: u32,
}

fn hash(x: f32, y: f32, seed: u32) -> f32 {
    noise::unit(noise::hash3(IVec3::new(x as i32, y as i32, 7), seed))
}

/// Strands over and under each other at `q`.
fn weave(q: Vec2, [warp, weft, gap]: [Vec3; 3], float: i32, thin: f32, seed: u32) -> Vec3 {
    let (cell, f) = (q.floor(), q - q.floor() - 0.5);
    let period = (float + 1).max(2);
    let up = (cell.x as i32 - cell.y as i32 * float.max(1)).rem_euclid(period) < float;
    // The upper strand bulges across its width and dips where it goes under.
    let strand = |across: f32, along: f32, color: Vec3, id: f32| {
        let bulge = 1.0 - (2.0 * across / thin).powi(2);
        let dip = 1.0 - 0.5 * (2.0 * along.abs()).powi(3);
        let fibre = 0.9 + 0.2 * hash((across * 14.0).floor() + 31.0 * id, 0.0, seed);
        let tone = 0.85 + 0.3 * hash(id, 5.0, seed);
        (bulge > 0.0).then(|| color * ((0.45 + 0.55 * bulge.max(0.0).sqrt()) * dip * fibre * tone))
    };
    let over = if up { strand(f.x, f.y, warp, cell.x) } else { strand(f.y, f.x, weft, cell.y + 1000.0) };
    let under = || if up { strand(f.y, 0.45, weft, cell.y + 1000.0) } else { strand(f.x, 0.45, warp, cell.x) };
    over.or_else(|| under().map(|c| 0.7 * c)).unwrap_or(gap)
}

/// Crossing bands with a twill hatch at `q`.
fn plaid(q: Vec2, colors: [Vec3; 3], hatch: f32, seed: u32) -> Vec3 {
    let pick = |x: f32, salt: f32| {
        let (i, f) = (x.floor(), x - x.floor());
        // The same order of bands in every period of four cells.
        let h = hash(i.rem_euclid(4.0), salt, seed);
        if h > 0.75 && (f - 0.5).abs() < 0.12 {
            colors[2]
        } else if h > 0.45 {
            colors[1]
        } else {
            colors[0]
        }
    };
    let twill = ((q.x + q.y) * hatch).rem_euclid(1.0) < 0.5;
    let (a, b) = (pick(q.x, 1.0), pick(q.y, 1.0));
    if twill { a.lerp(b, 0.3) } else { a.lerp(b, 0.7) }
}

/// Glaze over clay at `p`.
fn glazed(p: Vec3, glaze: Vec3, clay: Vec3, height: f32, run: f32, seed: u32) -> Vec3 {
    let around = p.truncate().normalize_or_zero() * 5.0;
    let border = height - run * noise::fbm(around.extend(0.0), seed, 3).powi(2);
    let depth = p.z - border;
    let speck = noise::value(p * 70.0, seed ^ 3) > 0.83;
    if depth < 0.0 {
        let tone = 0.85 + 0.3 * noise::fbm(p * 12.0, seed ^ 9, 3);
        if speck { clay * 0.45 } else { clay * tone }
    } else {
        let pool = 1.0 - 0.35 * (1.0 - depth / 0.05).clamp(0.0, 1.0);
        let streak = 0.88 + 0.24 * noise::fbm(Vec3::new(p.x * 26.0, p.y * 26.0, p.z * 2.5), seed, 2);
        let speck = if speck { 0.7 } else { 1.0 };
        glaze * (pool * streak * speck)
    }
}

/// Chips of stone in a ground at `p`.
fn terrazzo(p: Vec3, ground: Vec3, chips: [Vec3; 3], scale: f32, seed: u32) -> Vec3 {
    let (d1, d2, id) = noise::worley(p * scale, seed);
    let size = 0.25 + 0.5 * noise::unit(id ^ 0x55aa);
    if d1 < size && d2 - d1 > 0.12 {
        chips[id as usize % 3] * (0.85 + 0.3 * noise::unit(id.wrapping_mul(31)))
    } else {
        ground * (0.94 + 0.12 * noise::value(p * 60.0, seed))
    }
}

impl Pattern {
    /// Linear color at rest position `p` and surface coordinates `uv`.
    pub fn color(&self, p: Vec3, uv: Vec2) -> Vec3 {
        let seed = self.seed;
        let q = self.frame.coordinates(p, uv);
        let color = match &self.form {
            Form::Weave { warp, weft, gap, float, thin } => weave(q, [*warp, *weft, *gap], *float, *thin, seed),
            Form::Knit { a, b, share } => {
                let x = q.x - q.x.floor() - 0.5;
                let y = q.y - 0.8 * x.abs();
                let (row, v) = (y.floor(), y - y.floor() - 0.5);
                let color = if hash(0.0, (row / 3.0).floor(), seed) < *share { *b } else { *a };
                // Two legs per stitch.
                let leg = Vec2::new((x.abs() - 0.25) * 3.2, v * 1.9).length();
                color * (1.08 - 0.6 * leg.min(1.2).powi(2)) * (0.94 + 0.12 * hash(q.x.floor(), row, seed))
            }
            Form::Plaid { colors, hatch } => plaid(q, *colors, *hatch, seed),
            Form::Chevron { a, b, steep } => {
                let x = (q.x - q.x.floor() - 0.5).abs();
                let y = (q.y + steep * x).rem_euclid(1.0);
                if y < 0.5 { *a } else { *b }
            }
            Form::Brushed { a, b } => {
                let fine = noise::value(Vec3::new(0.25 * q.x, 9.0 * q.y, 0.5), seed);
                let broad = noise::value(Vec3::new(0.1 * q.x, 1.3 * q.y, 3.5), seed ^ 77);
                a.lerp(*b, 0.65 * fine + 0.35 * broad)
            }
            Form::Rings { colors, stops } => {
                let r = p.truncate().length() + 0.004 * (noise::value(p * 9.0, seed) - 0.5);
                let i = stops.iter().filter(|&&s| r > s).count();
                let line = stops.iter().any(|&s| (r - s).abs() < 0.006);
                if line { colors[2] } else { colors[i % 2] }
            }
            Form::Terrazzo { ground, chips, scale } => terrazzo(p, *ground, *chips, *scale, seed),
            Form::Glaze { glaze, clay, height, run } => glazed(p, *glaze, *clay, *height, *run, seed),
            Form::Crumb { crust, crumb, scale } => {
                let brown = noise::fbm(p * 4.0, seed, 3);
                let base = crumb.lerp(*crust, ((brown - 0.35) * 2.2).clamp(0.0, 1.0));
                let pore =
                    noise::value(p * *scale, seed ^ 21) * 0.65 + noise::value(p * (2.6 * scale), seed ^ 22) * 0.35;
                base * (0.5 + 0.85 * ((pore - 0.2) * 1.6).clamp(0.0, 1.0))
            }
        };
        color.clamp(Vec3::ZERO, Vec3::ONE)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::texture::{Texture, Wear};

    fn samples(color: impl Fn(Vec3, Vec2) -> Vec3) -> Vec<Vec3> {
        (0..4000)
            .map(|i| {
                let h = noise::unit3(noise::hash3(IVec3::new(i, 2, 3), 9));
                color(h - 0.5, Vec2::new(h.x, h.y))
            })
            .collect()
    }

    fn check(name: &str, colors: &[Vec3]) {
        let mean = colors.iter().sum::<Vec3>() / colors.len() as f32;
        let spread = colors.iter().map(|c| (*c - mean).length_squared()).sum::<f32>() / colors.len() as f32;
        assert!(spread > 1e-4, "{name} is nearly constant: {spread}");
        assert!(colors.iter().all(|c| c.min_element() >= 0.0 && c.max_element() <= 1.0), "{name} leaves [0, 1]");
    }

    #[test]
    fn patterns_vary_and_stay_within_bounds() {
        let (a, b, c) = (Vec3::new(0.9, 0.5, 0.2), Vec3::new(0.1, 0.2, 0.5), Vec3::new(0.95, 0.95, 0.9));
        let forms = [
            Form::Weave { warp: a, weft: b, gap: Vec3::splat(0.02), float: 1, thin: 0.9 },
            Form::Weave { warp: a, weft: a, gap: Vec3::splat(0.02), float: 2, thin: 0.7 },
            Form::Knit { a, b, share: 0.4 },
            Form::Plaid { colors: [a, b, c], hatch: 8.0 },
            Form::Chevron { a, b, steep: 1.0 },
            Form::Brushed { a, b },
            Form::Rings { colors: [a, b, c], stops: [0.1, 0.25, 0.4] },
            Form::Terrazzo { ground: c, chips: [a, b, c], scale: 12.0 },
            Form::Glaze { glaze: b, clay: a, height: 0.1, run: 0.3 },
            Form::Crumb { crust: b, crumb: c, scale: 50.0 },
        ];
        let frames = [
            Frame::Uv(Vec2::new(20.0, 14.0)),
            Frame::Solid([Vec3::X * 15.0, Vec3::Z * 15.0]),
            Frame::Around(30.0, 12.0),
        ];
        for form in &forms {
            for frame in frames {
                let pattern = Pattern { frame, form: form.clone(), seed: 4 };
                check(&format!("{form:?} {frame:?}"), &samples(|p, uv| pattern.color(p, uv)));
            }
        }
        let wear =
            Wear { base: Texture::Flat(a), dirt: b * 0.2, amounts: Vec3::new(0.7, 0.7, 0.8), scale: 6.0, seed: 5 };
        check("wear", &samples(|p, uv| wear.color(p, uv)));
    }

    #[test]
    fn a_plain_weave_alternates_over_and_under() {
        let (warp, weft) = (Vec3::X, Vec3::Y);
        let form = Form::Weave { warp, weft, gap: Vec3::ZERO, float: 1, thin: 0.9 };
        let pattern = Pattern { frame: Frame::Uv(Vec2::splat(8.0)), form, seed: 1 };
        for i in 0..8 {
            for j in 0..8 {
                let c = pattern.color(Vec3::ZERO, (Vec2::new(i as f32, j as f32) + 0.5) / 8.0);
                let up = (i + j) % 2 == 0;
                assert!((c.x > 0.3) == up && (c.y > 0.3) != up, "cell {i} {j}: {c}");
            }
        }
    }
}
