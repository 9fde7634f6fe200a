//! Families of closed surfaces: bodies of revolution, swept tubes, rounded boxes, superquadrics, tori, pierced shells.

use std::f32::consts::{PI, TAU};

use glam::{Vec2, Vec3};

use crate::generate::part::Part;

/// A piece of a profile with one material: points (radius, height). Its texture runs v = 0..1 along the arc length.
#[derive(Clone, Debug)]
pub struct Span {
    pub points: Vec<Vec2>,
    pub material: u16,
}

/// The unit cross-section of a body: angle to a point at distance about 1.
pub type Section<'a> = &'a dyn Fn(f32) -> Vec2;

/// A circle.
pub fn round(angle: f32) -> Vec2 {
    Vec2::new(angle.cos(), angle.sin())
}

/// A superellipse with the given half axes: exponent 2 is an ellipse, 8 nearly a rectangle.
pub fn superellipse(half: Vec2, exponent: f32) -> impl Fn(f32) -> Vec2 {
    move |angle| {
        let d = round(angle);
        let norm = ((d.x.abs()).powf(exponent) + (d.y.abs()).powf(exponent)).powf(1.0 / exponent);
        d / norm * half
    }
}

/// A regular polygon with corners at distance 1.
pub fn polygon(corners: usize) -> impl Fn(f32) -> Vec2 {
    move |angle| {
        let step = TAU / corners as f32;
        let local = (angle + 1e-4).rem_euclid(step) - 0.5 * step;
        round(angle) * ((0.5 * step).cos() / local.cos())
    }
}

/// A circle with `lobes` waves of relative height `depth`.
pub fn lobed(lobes: usize, depth: f32) -> impl Fn(f32) -> Vec2 {
    move |angle| round(angle) * (1.0 + depth * (lobes as f32 * angle).cos()) / (1.0 + depth)
}

/// Revolves a profile about z. The profile starts and ends on the axis, or closes on itself.
/// Segments longer than `max_step` are subdivided.
pub fn lathe(spans: &[Span], segments: usize, section: Section, max_step: f32) -> Part {
    lathe_with(spans, segments, section, max_step, &|_, _, _| 0.0)
}

/// As [`lathe`], with relief: `relief(span, turn, point)` is added to the radius, `turn` in [0, 1).
/// It must be the same where two spans meet.
pub fn lathe_with(
    spans: &[Span],
    segments: usize,
    section: Section,
    max_step: f32,
    relief: &dyn Fn(usize, f32, Vec2) -> f32,
) -> Part {
    let mut part = Part::default();
    let ring: Vec<Vec2> = (0..segments).map(|i| section(TAU * i as f32 / segments as f32)).collect();
    for (s, span) in spans.iter().enumerate() {
        let points = subdivide(&span.points, max_step);
        let mut lengths = vec![0.0];
        for pair in points.windows(2) {
            lengths.push(lengths[lengths.len() - 1] + pair[0].distance(pair[1]));
        }
        let total = lengths[lengths.len() - 1].max(1e-9);
        let base = part.positions.len() as u32;
        for (p, length) in points.iter().zip(&lengths) {
            for i in 0..=segments {
                let turn = (i % segments) as f32 / segments as f32;
                let c = ring[i % segments] * (p.x + relief(s, turn, *p));
                part.vertex(c.extend(p.y), Vec2::new(i as f32 / segments as f32, length / total));
            }
        }
        let id = |i: usize, j: usize| base + (j * (segments + 1) + i) as u32;
        for j in 0..points.len() - 1 {
            for i in 0..segments {
                part.quad([id(i, j), id(i + 1, j), id(i + 1, j + 1), id(i, j + 1)], span.material);
            }
        }
    }
    part
}

/// Splits segments so that none is longer than `max_step`.
pub fn subdivide(points: &[Vec2], max_step: f32) -> Vec<Vec2> {
    let mut out = Vec::with_capacity(2 * points.len());
    out.extend(points.first());
    for pair in points.windows(2) {
        let n = ((pair[0].distance(pair[1]) / max_step).ceil() as usize).clamp(1, 16);
        out.extend((1..=n).map(|k| pair[0].lerp(pair[1], k as f32 / n as f32)));
    }
    out
}

/// A smooth curve through the points (Catmull-Rom), `steps` segments per interval.
pub fn smooth(points: &[Vec2], steps: usize) -> Vec<Vec2> {
    let at = |i: isize| points[i.clamp(0, points.len() as isize - 1) as usize];
    let mut out = vec![points[0]];
    for i in 0..points.len() as isize - 1 {
        let (p0, p1, p2, p3) = (at(i - 1), at(i), at(i + 1), at(i + 2));
        for k in 1..steps {
            let t = k as f32 / steps as f32;
            let (t2, t3) = (t * t, t * t * t);
            out.push(
                0.5 * (2.0 * p1
                    + (p2 - p0) * t
                    + (2.0 * p0 - 5.0 * p1 + 4.0 * p2 - p3) * t2
                    + (3.0 * p1 - p0 - 3.0 * p2 + p3) * t3),
            );
        }
        // To the bit: neighboring spans meet here.
        out.push(p2);
    }
    out
}

/// Rounds the inner corners of a polyline with arcs (quadratic Bezier curves) that start `radius` before them.
pub fn fillet(points: &[Vec2], radius: f32, steps: usize) -> Vec<Vec2> {
    let mut out = vec![points[0]];
    for w in points.windows(3) {
        let (to_a, to_b) = (w[0] - w[1], w[2] - w[1]);
        let r = radius.min(0.45 * to_a.length()).min(0.45 * to_b.length());
        let (a, b) = (w[1] + to_a.normalize_or_zero() * r, w[1] + to_b.normalize_or_zero() * r);
        for k in 0..=steps {
            let t = k as f32 / steps as f32;
            out.push(a.lerp(w[1], t).lerp(w[1].lerp(b, t), t));
        }
    }
    out.push(points[points.len() - 1]);
    out
}

/// Sweeps a superelliptic cross-section along a path. `half(t)` gives its half widths along the frame's side and
/// `up` axes for t = 0..1 along the path; the ends are capped, slightly rounded.
pub fn tube(path: &[Vec3], up: Vec3, half: impl Fn(f32) -> Vec2, exponent: f32, sides: usize, material: u16) -> Part {
    let n = path.len();
    let mut rings: Vec<(Vec3, Vec3, Vec3, Vec2)> = Vec::with_capacity(n + 4);
    let mut reference = up;
    for i in 0..n {
        let tangent = (path[(i + 1).min(n - 1)] - path[i.saturating_sub(1)]).normalize_or(Vec3::Z);
        // Parallel transport: keep the reference as close as possible to the previous one.
        reference =
            (reference - tangent * reference.dot(tangent)).try_normalize().unwrap_or(tangent.any_orthonormal_vector());
        let side = tangent.cross(reference);
        rings.push((path[i], side, reference, half(i as f32 / (n - 1) as f32)));
    }
    let cap = |(p, side, up, h): (Vec3, Vec3, Vec3, Vec2), outwards: Vec3| {
        let depth = 0.35 * h.min_element();
        [(p + 0.7 * depth * outwards, side, up, 0.8 * h), (p + depth * outwards, side, up, Vec2::ZERO)]
    };
    let (first, last) = (rings[0], rings[n - 1]);
    let [a, b] = cap(first, (path[0] - path[1]).normalize_or_zero());
    let [c, d] = cap(last, (path[n - 1] - path[n - 2]).normalize_or_zero());
    rings.splice(0..0, [b, a]);
    rings.extend([c, d]);
    let section = superellipse(Vec2::ONE, exponent);
    let mut part = Part::default();
    let last = rings.len() - 1;
    part.grid([sides, last], [true, false], material, |u, v| {
        let (p, side, up, h) = rings[(v * last as f32).round() as usize];
        let c = section(TAU * u) * h;
        p + side * c.x + up * c.y
    });
    part
}

/// A circular arc in the plane of `x` and `y`, from angle `from` to `to`.
pub fn arc(center: Vec3, x: Vec3, y: Vec3, from: f32, to: f32, steps: usize) -> Vec<Vec3> {
    (0..=steps)
        .map(|i| {
            let a = from + (to - from) * i as f32 / steps as f32;
            center + x * a.cos() + y * a.sin()
        })
        .collect()
}

/// A box with rounded edges. Materials in the order +x, -x, +y, -y, +z, -z; on the sides u runs to the right
/// and v upwards as seen from outside.
pub fn rounded_box(half: Vec3, radius: f32, materials: [u16; 6]) -> Part {
    let r = radius.min(half.min_element() * 0.95).max(0.0);
    let inner = half - r;
    // Coordinates along one axis: a few steps over each rounded edge and a coarse grid between.
    let stations = |h: f32, inner: f32| -> Vec<f32> {
        let cells = ((2.0 * inner / 0.16) as usize).clamp(3, 9);
        // Exactly symmetric, so that mirrored faces meet in the same points.
        let mid = (0..=cells).map(|i| inner * (((2 * i) as f32 - cells as f32) / cells as f32));
        if r < 1e-4 {
            return mid.collect();
        }
        let edge = [h, inner + 0.75 * r, inner + 0.4 * r];
        edge.iter().map(|e| -e).chain(mid).chain(edge.iter().rev().copied()).collect()
    };
    let axes = [stations(half.x, inner.x), stations(half.y, inner.y), stations(half.z, inner.z)];
    // For each face: normal axis and sign, then u axis and sign; v is z on the sides.
    let faces: [(usize, f32, usize, f32, usize, f32); 6] = [
        (0, 1.0, 1, 1.0, 2, 1.0),
        (0, -1.0, 1, -1.0, 2, 1.0),
        (1, 1.0, 0, -1.0, 2, 1.0),
        (1, -1.0, 0, 1.0, 2, 1.0),
        (2, 1.0, 0, 1.0, 1, 1.0),
        (2, -1.0, 0, 1.0, 1, -1.0),
    ];
    let mut part = Part::default();
    for (&(n, ns, u, us, v, vs), &material) in faces.iter().zip(&materials) {
        let (nu, nv) = (axes[u].len() - 1, axes[v].len() - 1);
        let base = part.positions.len();
        part.grid([nu, nv], [false, false], material, |tu, tv| {
            let mut p = Vec3::ZERO;
            p[n] = ns * half[n];
            p[u] = us * axes[u][(tu * nu as f32).round() as usize];
            p[v] = vs * axes[v][(tv * nv as f32).round() as usize];
            p
        });
        for i in base..part.positions.len() {
            let p = part.positions[i];
            part.uvs[i] = 0.5 + 0.5 * Vec2::new(us * p[u] / half[u], vs * p[v] / half[v]);
            let core = p.clamp(-inner, inner);
            part.positions[i] = core + (p - core).normalize_or_zero() * r;
        }
    }
    part
}

fn signed_power(x: f32, e: f32) -> f32 {
    x.abs().powf(e) * x.signum()
}

/// A superquadric with exponents `e1` (profile) and `e2` (plan): 1 is an ellipsoid, 0.2 a box, 2 an octahedron.
pub fn superquadric(half: Vec3, e1: f32, e2: f32, resolution: usize, material: u16) -> Part {
    let mut part = Part::default();
    part.grid([2 * resolution, resolution], [true, false], material, |u, v| {
        let (a, b) = (TAU * u, PI * (v - 0.5));
        // Exactly zero at the poles, so that their triangles are recognized as degenerate.
        let c = if v == 0.0 || v == 1.0 { 0.0 } else { b.cos() };
        half * Vec3::new(
            signed_power(c, e1) * signed_power(a.cos(), e2),
            signed_power(c, e1) * signed_power(a.sin(), e2),
            signed_power(b.sin(), e1),
        )
    });
    part
}

/// A torus about z.
pub fn torus(major: f32, minor: Vec2, exponent: f32, resolution: [usize; 2], material: u16) -> Part {
    let section = superellipse(minor, exponent);
    let mut part = Part::default();
    part.grid(resolution, [true, true], material, |u, v| {
        let s = section(TAU * v);
        (round(TAU * u) * (major + s.x)).extend(s.y)
    });
    part
}

/// A wall between two surfaces over the same grid, pierced where `keep` is false; the rims are closed.
pub fn shell(
    [nu, nv]: [usize; 2],
    wrap_u: bool,
    outer: impl Fn(f32, f32) -> Vec3,
    inner: impl Fn(f32, f32) -> Vec3,
    keep: impl Fn(usize, usize) -> bool,
    [outside, inside]: [u16; 2],
) -> Part {
    let mut part = Part::default();
    let mut sheet = |f: &dyn Fn(f32, f32) -> Vec3| {
        let base = part.positions.len() as u32;
        for j in 0..=nv {
            for i in 0..=nu {
                let (u, v) = (i as f32 / nu as f32, j as f32 / nv as f32);
                part.vertex(f(if wrap_u && i == nu { 0.0 } else { u }, v), Vec2::new(u, v));
            }
        }
        base
    };
    let (front, rear) = (sheet(&outer), sheet(&inner));
    let at = |base: u32, i: usize, j: usize| base + (j * (nu + 1) + i) as u32;
    let kept = |i: isize, j: isize| {
        let i = if wrap_u { i.rem_euclid(nu as isize) } else { i };
        i >= 0 && j >= 0 && i < nu as isize && j < nv as isize && keep(i as usize, j as usize)
    };
    for j in 0..nv {
        for i in 0..nu {
            if !keep(i, j) {
                continue;
            }
            let ring = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)];
            part.quad(ring.map(|(i, j)| at(front, i, j)), outside);
            let [a, b, c, d] = ring.map(|(i, j)| at(rear, i, j));
            part.quad([d, c, b, a], inside);
            let (x, y) = (i as isize, j as isize);
            for (k, (nx, ny)) in [(x, y - 1), (x + 1, y), (x, y + 1), (x - 1, y)].into_iter().enumerate() {
                if !kept(nx, ny) {
                    let (p, q) = (ring[k], ring[(k + 1) % 4]);
                    part.quad(
                        [at(front, q.0, q.1), at(front, p.0, p.1), at(rear, p.0, p.1), at(rear, q.0, q.1)],
                        outside,
                    );
                }
            }
        }
    }
    part
}
