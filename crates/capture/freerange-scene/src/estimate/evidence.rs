//! Whether photos and poses belong together: do the photos agree better under their own poses than under each other's?
//!
//! Masks are cut so that they suit the poses, right or wrong, and outlines from all around are much alike; so what they agree to says
//! little by itself. Three things are asked instead, each of the poses as they are and of the same photos handed round among the cameras:
//! how far the photos differ on the surface of the hull, how far on the table, and how much of each mask the hull of the others leaves out.
//! Right poses stand out by one of them, unless the scene looks the same from everywhere; wrong ones are as good as any others.

use super::hull::{Hull, Nearly};
use super::picture::{Picture, bilinear};
use super::plane::{Plane, across};
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::collections::HashSet;

/// Color differences beyond this count as this (Lab).
const CAP: f32 = 30.0;
/// Points of the hull's surface that are looked at, at most.
const POINTS: usize = 3000;
/// Points of the table along each axis.
const TABLE: usize = 48;
/// Ways to hand the photos round that are tried, at most.
const ROUNDS: usize = 11;
/// Voxels along the longest side of the hulls that are compared.
const GRID: usize = 64;

/// A number as it is, and as it is where the photos are handed round.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Compared {
    /// With the poses as they are.
    pub own: f64,
    /// The median of those where the photos are handed round.
    pub others: f64,
    /// The least of those.
    pub least: f64,
}

impl Compared {
    fn of(own: Option<f64>, mut others: Vec<f64>) -> Option<Self> {
        others.sort_by(f64::total_cmp);
        Some(Self { own: own?, others: *others.get(others.len() / 2)?, least: *others.first()? })
    }
}

/// What speaks for the poses.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Evidence {
    /// How far the photos differ where they see one point of the hull's surface, in units of Lab.
    pub surface: Option<Compared>,
    /// How far they differ on the table, in units of Lab.
    pub table: Option<Compared>,
    /// The share of the masks that the hull of the other masks leaves out.
    pub outline: Option<Compared>,
}

/// Share of the masks outside of the others' hull above which poses are doubted, alone and of what it is where photos are handed round. On
/// generated scenes: up to 0.02 and 0.04 of it with right poses; with mixed ones from 0.16 and 0.45, with two photos exchanged from 0.08
/// and 0.24.
const OUTSIDE: f64 = 0.06;
const OF_OTHERS: f64 = 0.2;
/// A table that differs so much where photos are handed round (Lab) tells right poses from wrong ones: on it right ones have at most 0.15 of
/// that, mixed ones 0.7 and more.
const TELLING: f64 = 2.5;
const OF_TELLING: f64 = 0.6;
const OF_CONFIRMED: f64 = 0.8;

impl Evidence {
    /// What speaks against the poses, if anything does.
    pub fn against(&self) -> Option<String> {
        let percent = |v: f64| (100.0 * v).round();
        if let Some(o) = self.outline.filter(|o| o.own > OUTSIDE && o.own > OF_OTHERS * o.others) {
            return Some(format!("{} % of the masks lie outside of the others' hull", percent(o.own)));
        }
        // The ground need not be flat where outlines speak for the poses.
        let confirmed = self.outline.is_some_and(|o| o.others > OUTSIDE && o.own < 0.5 * OF_OTHERS * o.others);
        let most = if confirmed { OF_CONFIRMED } else { OF_TELLING };
        let table = self.table.filter(|t| t.others > TELLING && t.own > most * t.others)?;
        let of = percent(table.own / table.others);
        Some(format!("photos differ on the table {of} % as much as under each other's poses"))
    }
}

/// Asks the photos. `plane`: the best one, whether it stands out or not.
pub fn gather(
    pictures: &[Picture],
    masks: &[Vec<bool>],
    hull: Option<&Hull>,
    center: DVec3,
    radius: f64,
    plane: Option<&Plane>,
    distance: f64,
) -> Evidence {
    let count = pictures.len();
    let rounds: Vec<usize> = match count - 1 {
        n if n <= ROUNDS => (1..count).collect(),
        n => (0..ROUNDS).map(|k| 1 + k * n / ROUNDS).collect(),
    };
    let compared = |f: &(dyn Fn(usize) -> Option<f64> + Sync)| {
        let others = rounds.par_iter().filter_map(|shift| f(*shift)).collect();
        Compared::of(f(0), others)
    };
    let points = hull.map_or(Vec::new(), |hull| surface(hull, pictures));
    let on_surface = |shift: usize| {
        let seen = |i: usize, x: f64, y: f64| {
            let j = (i + shift) % count;
            let (u, v) = handed(&pictures[i], &pictures[j], x, y);
            at(&pictures[j], u, v).filter(|k| masks[j][*k]).map(|_| color(&pictures[j], u, v))
        };
        differ(points.iter().map(|views| views.iter().filter_map(|(i, x, y)| seen(*i, *x, *y)).collect()), 2)
    };
    let on_table = |shift: usize| {
        let spots = plane.map(|plane| spots(center, plane, 0.7 * distance)).unwrap_or_default();
        let seen = |i: usize, point: DVec3| {
            let (x, y, z) = pictures[i].project(point);
            at(&pictures[i], x, y).filter(|_| z > 0.0)?;
            let j = (i + shift) % count;
            let (u, v) = handed(&pictures[i], &pictures[j], x, y);
            at(&pictures[j], u, v).filter(|k| !masks[j][*k]).map(|_| color(&pictures[j], u, v))
        };
        differ(spots.iter().map(|p| (0..count).filter_map(|i| seen(i, *p)).collect()), 3)
    };
    let outlines = |shift: usize| {
        let given: Vec<Vec<bool>> = (0..count)
            .into_par_iter()
            .map(|i| moved(&pictures[i], &pictures[(i + shift) % count], &masks[(i + shift) % count]))
            .collect();
        mean(&outside(pictures, &given, center, radius))
    };
    // One after the other: each holds masks of all views.
    let outline = Compared::of(Some(outlines(0)), rounds.iter().map(|shift| outlines(*shift)).collect());
    Evidence { surface: compared(&on_surface), table: compared(&on_table), outline }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// For each view: the share of its mask that the hull of the other masks does not cover.
pub fn outside(pictures: &[Picture], masks: &[Vec<bool>], center: DVec3, radius: f64) -> Vec<f64> {
    let nearly = Nearly::carve(pictures, masks, center, radius, GRID);
    let one = |i: usize| left_out(&masks[i], &nearly.without(i).outline(&pictures[i]));
    (0..pictures.len()).into_par_iter().map(one).collect()
}

/// The share of a mask that an outline does not cover.
fn left_out(mask: &[bool], outline: &[bool]) -> f64 {
    mask.iter().zip(outline).filter(|(m, o)| **m && !**o).count() as f64 / area(mask)
}

fn area(mask: &[bool]) -> f64 {
    mask.iter().filter(|m| **m).count().max(1) as f64
}

/// For each view, how far its mask and those of the others contradict each other, 0 to 1: the share of it that the hull of the others
/// does not cover, or the share of the others' masks, on average, that no hull covers because of it; the larger of both.
pub fn contradictions(pictures: &[Picture], masks: &[Vec<bool>], center: DVec3, radius: f64) -> Vec<f64> {
    let count = pictures.len();
    let nearly = Nearly::carve(pictures, masks, center, radius, GRID);
    let (alone, both) = nearly.excluded(count);
    let sizes: Vec<f64> = masks.iter().map(|mask| area(mask)).collect();
    // Of each mask the pixels that the hull of the others leaves out.
    let left: Vec<Vec<usize>> = (0..count)
        .into_par_iter()
        .map(|i| {
            let outline = nearly.without(i).outline(&pictures[i]);
            (0..outline.len()).filter(|k| masks[i][*k] && !outline[*k]).collect()
        })
        .collect();
    let none = Vec::new();
    // How many of them are left where `without` excludes nothing either: few points more, and most views exclude none alone.
    let still = |of: usize, without: usize| {
        let pair = [of.min(without), of.max(without)];
        let more = [&alone[without], both.get(&pair).unwrap_or(&none)];
        if left[of].is_empty() || more.iter().all(|points| points.is_empty()) {
            return left[of].len();
        }
        let outline = nearly.hull(more.into_iter().flatten().copied().collect()).outline(&pictures[of]);
        left[of].iter().filter(|k| !outline[**k]).count()
    };
    let share = |of: usize, pixels: usize| pixels as f64 / sizes[of];
    let own: Vec<f64> = (0..count).map(|i| share(i, left[i].len())).collect();
    (0..count)
        .into_par_iter()
        .map(|i| {
            let spared: f64 = (0..count).filter(|j| *j != i).map(|j| own[j] - share(j, still(j, i))).sum();
            own[i].max(spared / (count - 1).max(1) as f64)
        })
        .collect()
}

/// Where a point of picture `from` lies in `to`, if `to` had been taken by the camera of `from`.
fn handed(from: &Picture, to: &Picture, x: f64, y: f64) -> (f64, f64) {
    let (a, b) = (&from.camera, &to.camera);
    ((x - a.cx) / a.fx * b.fx + b.cx, (y - a.cy) / a.fy * b.fy + b.cy)
}

/// A mask of `from` as the camera of `to` would have it.
fn moved(to: &Picture, from: &Picture, mask: &[bool]) -> Vec<bool> {
    let (w, h) = (to.width(), to.height());
    (0..w * h)
        .map(|k| {
            let (u, v) = handed(to, from, (k % w) as f64 + 0.5, (k / w) as f64 + 0.5);
            at(from, u, v).is_some_and(|k| mask[k])
        })
        .collect()
}

/// The pixel at a point, where the picture shows anything.
fn at(picture: &Picture, x: f64, y: f64) -> Option<usize> {
    let (w, h) = (picture.width(), picture.height());
    if !(x >= 0.0 && y >= 0.0 && x < w as f64 && y < h as f64) {
        return None;
    }
    let k = y as usize * w + x as usize;
    picture.valid[k].then_some(k)
}

fn color(picture: &Picture, x: f64, y: f64) -> Vec3 {
    bilinear(&picture.smooth, picture.width(), picture.height(), x, y)
}

/// Points of the hull's surface, each as the views that see it and where: `(view, x, y)`.
fn surface(hull: &Hull, pictures: &[Picture]) -> Vec<Vec<(usize, f64, f64)>> {
    let step = hull.step;
    let cell = |p: DVec3| (p / step).floor().as_i64vec3().to_array();
    let cells: HashSet<[i64; 3]> = hull.points.iter().map(|p| cell(*p)).collect();
    let sides = [DVec3::X, DVec3::Y, DVec3::Z, -DVec3::X, -DVec3::Y, -DVec3::Z];
    let open = |p: &&DVec3| sides.iter().any(|s| !cells.contains(&cell(**p + step * *s)));
    let outer: Vec<DVec3> = hull.points.iter().filter(open).copied().collect();
    let depths: Vec<Vec<f32>> = pictures.par_iter().map(|p| depth(&outer, step, p)).collect();
    let every = outer.len().div_ceil(POINTS).max(1);
    outer
        .iter()
        .step_by(every)
        .map(|point| {
            let seen = |(i, picture): (usize, &Picture)| {
                let (x, y, z) = picture.project(*point);
                let k = at(picture, x, y)?;
                (z > 0.0 && z < f64::from(depths[i][k]) + 2.0 * step).then_some((i, x, y))
            };
            pictures.iter().enumerate().filter_map(seen).collect()
        })
        .collect()
}

/// The least depth of points, each as a square, at every pixel: `[h, w]`.
fn depth(points: &[DVec3], step: f64, picture: &Picture) -> Vec<f32> {
    let (w, h) = (picture.width(), picture.height());
    let mut depth = vec![f32::INFINITY; w * h];
    for point in points {
        let (x, y, z) = picture.project(*point);
        if z <= step {
            continue;
        }
        let reach = 0.6 * picture.camera.fx * step / z;
        let range = |v: f64, size: usize| {
            ((v - reach).clamp(0.0, size as f64) as usize, (v + reach).ceil().clamp(0.0, size as f64) as usize)
        };
        let ((x0, x1), (y0, y1)) = (range(x, w), range(y, h));
        for y in y0..y1 {
            depth[y * w + x0..y * w + x1].iter_mut().for_each(|d| *d = d.min(z as f32));
        }
    }
    depth
}

/// Points of a disc of the table.
fn spots(center: DVec3, plane: &Plane, radius: f64) -> Vec<DVec3> {
    let (a, b) = across(plane.normal);
    let origin = center + plane.height * plane.normal;
    let at = |k: usize| (2.0 * (k as f64 + 0.5) / TABLE as f64 - 1.0) * radius;
    let all = (0..TABLE * TABLE).map(|i| (at(i % TABLE), at(i / TABLE)));
    all.filter(|(x, y)| x.hypot(*y) <= radius).map(|(x, y)| origin + x * a + y * b).collect()
}

/// How far the colors of a point differ from their median, on average over points with `least` colors or more; none where these are
/// few.
fn differ(points: impl Iterator<Item = Vec<Vec3>>, least: usize) -> Option<f64> {
    let (mut sum, mut count) = (0.0, 0usize);
    let mut channel: Vec<f32> = Vec::new();
    for colors in points.filter(|c| c.len() >= least) {
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
    (count >= 100).then(|| sum / count as f64)
}
