//! Turned vessels: walls from a profile, and relief on them.

use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};
use rand::Rng;

use crate::generate::part::Part;
use crate::generate::shapes::{self, Span};
use crate::generate::style::Style;
use crate::mesh::noise;

/// The profiles of a vessel: outside from the axis below to the rim, the rim, and the inside back to the axis.
pub struct Walls {
    pub outer: Vec<Vec2>,
    pub rim: Vec<Vec2>,
    pub inner: Vec<Vec2>,
    /// How many points of `outer` belong to the foot.
    pub foot: usize,
}

/// A vessel around the profile `side` (radius, height), bottom to top, of that wall thickness, on a foot ring of the
/// given height (0 for a flat bottom).
pub fn walls(side: &[Vec2], wall: f32, foot: f32) -> Walls {
    let lift = Vec2::new(0.0, foot);
    let side: Vec<Vec2> = side.iter().map(|p| *p + lift).collect();
    let r = side[0].x;
    let mut outer = if foot > 0.0 {
        let ring = r.min(wall.max(0.12 * r));
        vec![
            Vec2::new(0.0, 0.5 * foot),
            Vec2::new(r - 1.3 * ring, 0.5 * foot),
            Vec2::new(r - ring, 0.0),
            Vec2::new(r - 0.25 * ring, 0.0),
            Vec2::new(r - 0.1 * ring, 0.7 * foot),
        ]
    } else {
        vec![Vec2::ZERO, Vec2::new(0.8 * r, 0.0)]
    };
    let foot_points = outer.len();
    outer.extend(&side);
    let n = side.len();
    let inward = |i: usize| {
        let t = (side[(i + 1).min(n - 1)] - side[i.saturating_sub(1)]).normalize_or(Vec2::Y);
        side[i] + wall * t.perp()
    };
    let (edge, lip) = (side[n - 1], inward(n - 1));
    let up = (edge - side[n - 2]).normalize_or(Vec2::Y);
    let rim = vec![edge, edge.lerp(lip, 0.15) + 0.35 * wall * up, edge.lerp(lip, 0.85) + 0.35 * wall * up, lip];
    let floor = side[0].y + wall;
    let mut inner = vec![lip];
    for i in (0..n - 1).rev() {
        let p = inward(i);
        let last = inner[inner.len() - 1];
        if p.x > 0.03 && p.y > floor + 0.2 * wall && p.distance(last) > 0.3 * wall {
            inner.push(p);
        }
    }
    let last = inner[inner.len() - 1];
    inner.extend([Vec2::new(0.85 * last.x.min(r), floor), Vec2::new(0.0, floor)]);
    Walls { outer, rim, inner, foot: foot_points }
}

/// Relief on the outside of a turned body.
#[derive(Clone, Copy, Debug)]
pub enum Relief {
    Flutes(f32),
    Hobnails(f32, f32),
    Diamonds(f32, f32),
    Hoops(f32),
    Weave(f32, f32),
    Hammered(u32),
}

impl Relief {
    pub fn random(s: &mut Style) -> Self {
        match s.count(0, 7) {
            0..2 => Self::Flutes(s.range(12.0, 30.0).round()),
            2 => Self::Hobnails(s.range(12.0, 20.0).round(), s.range(8.0, 12.0)),
            3 => Self::Diamonds(s.range(8.0, 14.0).round(), s.range(6.0, 10.0)),
            4 => Self::Hoops(s.range(4.0, 10.0)),
            5 => Self::Weave(2.0 * s.range(7.0, 11.0).round(), s.range(7.0, 11.0)),
            _ => Self::Hammered(s.rng.random()),
        }
    }

    /// Vertices around and the step along the profile that show it.
    pub fn resolution(&self) -> (usize, f32) {
        match *self {
            Self::Flutes(n) => (4 * n as usize, 0.2),
            Self::Hobnails(n, rows) | Self::Diamonds(n, rows) => (4 * n as usize, 0.25 / rows),
            Self::Weave(n, rows) => (4 * n as usize, 0.25 / rows),
            Self::Hoops(n) => (44, 0.14 / n),
            Self::Hammered(_) => (64, 0.05),
        }
    }

    /// Height in [-1, 1] at a turn in [0, 1) and a height z.
    pub fn height(&self, turn: f32, z: f32) -> f32 {
        let bump = |x: f32, y: f32| {
            let (x, y) = (2.0 * (x - x.floor()) - 1.0, 2.0 * (y - y.floor()) - 1.0);
            (1.0 - x * x - y * y).max(0.0).sqrt()
        };
        match *self {
            Self::Flutes(n) => (TAU * n * turn).cos().abs() * 2.0 - 1.0,
            Self::Hobnails(n, rows) => {
                let y = z * rows;
                bump(n * turn + 0.5 * (y.floor() as i32 & 1) as f32, y)
            }
            Self::Diamonds(n, rows) => {
                let (x, y) = (TAU * n * turn, PI * z * rows);
                (x + y).cos().min((x - y).cos())
            }
            Self::Hoops(n) => (TAU * n * z).sin(),
            Self::Weave(n, rows) => {
                let (x, y) = (n * turn, z * rows);
                let up = if (x.floor() as i32 + y.floor() as i32) & 1 == 0 { 1.0 } else { -1.0 };
                up * (PI * x.fract()).sin() * (PI * (y - y.floor())).sin()
            }
            Self::Hammered(seed) => {
                let p = Vec3::new((TAU * turn).cos(), (TAU * turn).sin(), 2.0 * z) * 3.5;
                2.0 * noise::worley(p, seed).0 - 1.0
            }
        }
    }
}

/// Turns spans, with relief of depth `depth` on span `on` between two heights.
pub fn turned(spans: &[Span], section: shapes::Section, relief: Option<(Relief, usize, [f32; 2], f32)>) -> Part {
    let Some((relief, on, [low, high], depth)) = relief else {
        return shapes::lathe(spans, 44, section, 0.13);
    };
    let (around, step) = relief.resolution();
    let soft = 0.12 * (high - low);
    // Only the body is cut finely; the other spans keep their points.
    let fine: Vec<Span> = spans
        .iter()
        .enumerate()
        .map(|(i, span)| Span {
            points: shapes::subdivide(&span.points, if i == on { step.max(0.018) } else { 0.13 }),
            material: span.material,
        })
        .collect();
    shapes::lathe_with(&fine, around.clamp(40, 96), section, 1.0, &|i, turn, p| {
        if i != on {
            return 0.0;
        }
        let fade = ((p.y - low) / soft).clamp(0.0, 1.0) * ((high - p.y) / soft).clamp(0.0, 1.0);
        depth * fade * relief.height(turn, p.y)
    })
}

/// Round but for this share: squares with soft corners.
pub fn plain_section(s: &mut Style, share: f64) -> Box<dyn Fn(f32) -> Vec2> {
    if s.chance(share) { Box::new(shapes::superellipse(Vec2::ONE, s.range(2.5, 6.0))) } else { Box::new(shapes::round) }
}
