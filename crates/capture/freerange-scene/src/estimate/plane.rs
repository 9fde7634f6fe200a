//! The plane that the object stands on: where it is, and what it looks like beneath and behind the object.
//!
//! A point of the table has one color from everywhere, shadows included; a point of the plane where the object stands before it has
//! the object's colors in some views. So the plane on which the views agree is looked for, and then every view can be told what it
//! would show without the object, from the views that see past it.

use super::picture::{Picture, bilinear};
use freerange_util::Stop;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Color differences beyond this count as this (Lab).
const CAP: f32 = 30.0;
/// Other views that tell a view what is behind the object, at most. More, and doubts about each of them add up to trust.
const OTHERS: usize = 7;

/// `normal . (x - center) = height`, with the normal pointing up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plane {
    /// Unit normal.
    pub normal: DVec3,
    /// Above the point that the search started from (negative: below), in the world's lengths.
    pub height: f64,
    /// Mean disagreement of the views on it (Lab).
    pub disagreement: f64,
}

/// Two unit vectors at right angles to `n` and to each other.
pub fn across(n: DVec3) -> (DVec3, DVec3) {
    let a = n.any_orthonormal_vector();
    (a, n.cross(a))
}

/// The plane on which the views agree best outside of `object` (`[h, w]` for each picture), and whether it stands out: it does not on a
/// table of one plain color.
pub fn find(
    pictures: &[Picture],
    object: &[Vec<bool>],
    center: DVec3,
    up: DVec3,
    distance: f64,
    stop: &Stop,
) -> Option<(Plane, bool)> {
    let (a, b) = across(up);
    let normal = |tilt: [f64; 2]| (up + tilt[0] * a + tilt[1] * b).normalize();
    let score = |p: [f64; 3], grid: usize| {
        stop.check().ok()?;
        disagreement(pictures, object, center, normal([p[0], p[1]]), p[2] * distance, 0.7 * distance, grid)
    };
    // Farther away little of a plane is seen, and that little may agree by chance: of walls, for one.
    let within = |p: [f64; 3]| p[0].hypot(p[1]) < 0.6 && (-0.5..0.15).contains(&p[2]);
    let mut candidates = Vec::new();
    for i in -1..=1 {
        for j in -1..=1 {
            candidates.extend((0..=22).map(|k| [0.2 * f64::from(i), 0.2 * f64::from(j), -0.45 + 0.025 * f64::from(k)]));
        }
    }
    let mut scored: Vec<(f64, [f64; 3])> =
        candidates.par_iter().filter_map(|p| score(*p, 32).map(|s| (s, *p))).collect();
    scored.sort_by(|x, y| x.0.total_cmp(&y.0));
    let middle = scored.get(scored.len() / 2)?.0;
    let mut starts: Vec<[f64; 3]> = Vec::new();
    for (_, p) in &scored {
        let apart = |q: &[f64; 3]| (p[2] - q[2]).abs() > 0.06 || (p[0] - q[0]).abs() + (p[1] - q[1]).abs() > 0.15;
        if starts.len() < 6 && starts.iter().all(apart) {
            starts.push(*p);
        }
    }
    let (best, p) = starts
        .par_iter()
        .map(|start| descend(*start, |p| within(p).then(|| score(p, 48)).flatten().unwrap_or(f64::INFINITY)))
        .min_by(|x, y| x.0.total_cmp(&y.0))?;
    // On the scenes that this was made with: 5 on the table, 17 to 20 elsewhere.
    let plane = Plane { normal: normal([p[0], p[1]]), height: p[2] * distance, disagreement: best };
    Some((plane, best < 0.6 * middle))
}

/// Nelder and Mead's simplex in three dimensions, 80 steps: `(value, point)`.
fn descend(start: [f64; 3], f: impl Fn([f64; 3]) -> f64) -> (f64, [f64; 3]) {
    let mut simplex: Vec<(f64, DVec3)> = [DVec3::ZERO, DVec3::X * 0.1, DVec3::Y * 0.1, DVec3::Z * 0.03]
        .into_iter()
        .map(|d| DVec3::from_array(start) + d)
        .map(|p| (f(p.to_array()), p))
        .collect();
    for _ in 0..80 {
        simplex.sort_by(|x, y| x.0.total_cmp(&y.0));
        let middle = (simplex[0].1 + simplex[1].1 + simplex[2].1) / 3.0;
        let worst = simplex[3];
        let at = |t: f64| {
            let p = middle + t * (middle - worst.1);
            (f(p.to_array()), p)
        };
        let mirrored = at(1.0);
        let next = if mirrored.0 < simplex[0].0 {
            let farther = at(2.0);
            if farther.0 < mirrored.0 { farther } else { mirrored }
        } else if mirrored.0 < simplex[2].0 {
            mirrored
        } else {
            at(if mirrored.0 < worst.0 { 0.5 } else { -0.5 })
        };
        if next.0 < worst.0 {
            simplex[3] = next;
        } else {
            let best = simplex[0].1;
            for vertex in &mut simplex[1..] {
                let p = 0.5 * (vertex.1 + best);
                *vertex = (f(p.to_array()), p);
            }
        }
    }
    simplex.sort_by(|x, y| x.0.total_cmp(&y.0));
    (simplex[0].0, simplex[0].1.to_array())
}

/// How far the views differ on a disc of a plane, on average; none where too little of it is seen by three or more.
fn disagreement(
    pictures: &[Picture],
    object: &[Vec<bool>],
    center: DVec3,
    normal: DVec3,
    height: f64,
    radius: f64,
    grid: usize,
) -> Option<f64> {
    let (a, b) = across(normal);
    let origin = center + height * normal;
    let (mut sum, mut count, mut seen, mut all) = (0.0, 0usize, 0usize, 0usize);
    let mut colors: Vec<Vec3> = Vec::with_capacity(pictures.len());
    let mut channel: Vec<f32> = Vec::with_capacity(pictures.len());
    for i in 0..grid * grid {
        let at = |k: usize| (2.0 * (k as f64 + 0.5) / grid as f64 - 1.0) * radius;
        let (x, y) = (at(i % grid), at(i / grid));
        if x * x + y * y > radius * radius {
            continue;
        }
        all += 1;
        let point = origin + x * a + y * b;
        colors.clear();
        for (picture, object) in pictures.iter().zip(object) {
            let (u, v, z) = picture.project(point);
            let (w, h) = (picture.width(), picture.height());
            if z <= 0.0 || u < 0.0 || v < 0.0 || u >= w as f64 || v >= h as f64 {
                continue;
            }
            let at = v as usize * w + u as usize;
            if picture.valid[at] && !object[at] {
                colors.push(bilinear(&picture.smooth, w, h, u, v));
            }
        }
        if colors.len() < 3 {
            continue;
        }
        seen += 1;
        let mut median = Vec3::ZERO;
        for c in 0..3 {
            channel.clear();
            channel.extend(colors.iter().map(|v| v[c]));
            channel.sort_by(f32::total_cmp);
            let n = channel.len();
            median[c] = 0.5 * (channel[(n - 1) / 2] + channel[n / 2]);
        }
        sum += colors.iter().map(|v| f64::from((*v - median).abs().max_element().min(CAP))).sum::<f64>();
        count += colors.len();
    }
    (seen * 7 >= all).then(|| sum / count as f64)
}

/// What a view would show without the object, as far as it shows the plane.
pub struct Table {
    /// How far the view is from the plane's color, `[h, w]` (Lab).
    pub off: Vec<f32>,
    /// How far that color can be relied on, 0 to 1.
    pub trust: Vec<f32>,
    /// How far colors may differ from it and still be the plane's (Lab).
    pub scale: Vec<f32>,
    /// That color, in order, where it was asked for and is sure.
    pub beneath: Vec<Vec3>,
}

/// Least trust and largest scale of a color that is sure.
const SURE: (f32, f32) = (0.8, 10.0);

/// Other views to ask about view `i`: all, or some that are spread evenly.
fn others(count: usize, i: usize) -> Vec<usize> {
    let rest: Vec<usize> = (0..count).filter(|j| *j != i).collect();
    match rest.len() {
        n if n <= OTHERS => rest,
        n => (0..OTHERS).map(|k| rest[k * n / OTHERS]).collect(),
    }
}

/// Which of so many views any other asks: at most two for each that one of them does.
pub fn asked(count: usize) -> Vec<bool> {
    let mut asked = vec![false; count];
    (0..count).flat_map(|i| others(count, i)).for_each(|j| asked[j] = true);
    asked
}

/// The weighted median of each channel; `total` is the sum of the weights, `channel` room for one.
fn median(seen: &[(Vec3, f32)], total: f32, channel: &mut Vec<(f32, f32)>) -> Vec3 {
    let of_channel = |c: usize| {
        channel.clear();
        channel.extend(seen.iter().map(|(v, weight)| (v[c], *weight)));
        channel.sort_by(|p, q| p.0.total_cmp(&q.0));
        let mut sum = 0.0;
        let half = channel.iter().find(|(_, weight)| {
            sum += weight;
            sum >= 0.5 * total
        });
        half.map_or(0.0, |v| v.0)
    };
    [0, 1, 2].map(of_channel).into()
}

/// The table of view `i`, whose own picture is `picture`, at the pixels `wanted` (`[h, w]`). `pictures`, and `background` (how likely each pixel of each
/// view is not the object, `[h, w]`): of all views, but only of those that are [`asked`] more than cameras. `beneath`: at which pixels its
/// color is asked for.
pub fn table(
    pictures: &[Picture],
    background: &[Vec<f32>],
    i: usize,
    picture: &Picture,
    center: DVec3,
    plane: &Plane,
    distance: f64,
    wanted: impl Fn(usize) -> bool + Sync,
    beneath: impl Fn(usize) -> bool,
) -> Table {
    let (w, h) = (picture.width(), picture.height());
    let others = others(pictures.len(), i);
    let eye = picture.camera.center();
    let above = (center + plane.height * plane.normal - eye).dot(plane.normal);
    let rows: Vec<Vec<(Vec3, f32, f32)>> = (0..h)
        .into_par_iter()
        .map(|y| {
            let mut seen: Vec<(Vec3, f32)> = Vec::with_capacity(others.len());
            let mut channel: Vec<(f32, f32)> = Vec::with_capacity(others.len());
            (0..w)
                .map(|x| {
                    let unknown = (Vec3::ZERO, 0.0, 2.0);
                    if !wanted(y * w + x) {
                        return unknown;
                    }
                    let direction = picture.camera.ray_direction(x as f64 + 0.5, y as f64 + 0.5);
                    let along = above / direction.dot(plane.normal);
                    let point = eye + along * direction;
                    // false for NaN
                    let near = along > 0.0 && point.distance(center) < 1.5 * distance;
                    if !near {
                        return unknown;
                    }
                    seen.clear();
                    for &j in &others {
                        let other = &pictures[j];
                        let (u, v, z) = other.project(point);
                        let (ow, oh) = (other.width(), other.height());
                        if z <= 0.0 || u < 0.0 || v < 0.0 || u >= ow as f64 || v >= oh as f64 {
                            continue;
                        }
                        if other.valid[v as usize * ow + u as usize] {
                            let weight = bilinear(&background[j], ow, oh, u, v).max(0.02);
                            seen.push((bilinear(&other.smooth, ow, oh, u, v), weight));
                        }
                    }
                    if seen.len() < 2 {
                        return unknown;
                    }
                    let total: f32 = seen.iter().map(|s| s.1).sum();
                    let color = median(&seen, total, &mut channel);
                    let spread =
                        seen.iter().map(|(v, weight)| weight * v.distance(color).min(40.0)).sum::<f32>() / total;
                    (color, ((total - 0.5) / 1.5).clamp(0.0, 1.0), 2.0 + 1.5 * spread)
                })
                .collect()
        })
        .collect();
    let flat = || rows.iter().flatten();
    let sure = |&(k, (_, trust, scale)): &(usize, &(Vec3, f32, f32))| *trust > SURE.0 && *scale < SURE.1 && beneath(k);
    let mut beneath: Vec<Vec3> = flat().enumerate().filter(sure).map(|(_, (color, ..))| *color).collect();
    // Held for all views.
    beneath.shrink_to_fit();
    Table {
        off: flat().zip(&picture.smooth).map(|((color, ..), own)| own.distance(*color)).collect(),
        trust: flat().map(|v| v.1).collect(),
        scale: flat().map(|v| v.2).collect(),
        beneath,
    }
}
