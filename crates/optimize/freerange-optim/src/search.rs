//! What searches for symmetries of an object have in common: the hull of its silhouettes, fits that are told of, and how unlike views are what a
//! symmetry makes of them.

use std::{f64::consts::PI, ops::ControlFlow};

use freerange_gaussians::Gaussians;
use freerange_raster::render;
use freerange_scene::camera::Camera;
use glam::DVec3;
use rayon::prelude::*;

use crate::{Evidence, FitError, FitProgress, InitialFitConfig, initial::fit_from, views::Targets};

/// Longest side, in pixels, of the silhouettes that symmetries are judged by.
pub(crate) const OUTLINE: u32 = 64;
/// Longest side, in pixels, of the pictures that they are judged by.
pub(crate) const PICTURE: u32 = 128;
/// Cells along each side of the cube of the visual hull.
const CELLS: usize = 44;
/// Half the side of that cube: a little more than the radius of an object in the canonical frame.
const HALF: f64 = 0.52;
/// Part of the silhouettes that what a symmetry leaves of the hull may not fill.
pub(crate) const UNCOVERED: f64 = 0.01;
/// How often a symmetry is put in its place by its own fit, and the fit goes on.
pub(crate) const ROUNDS: usize = 3;
/// How many are judged at once.
const TOGETHER: usize = 8;

/// What leaves an object as it is.
pub(crate) trait Symmetry: Copy + Send + Sync {
    /// Whether it makes a left hand a right one.
    const MIRRORS: bool;
    /// In how many ways it can be [moved](Self::moved).
    const WAYS: usize;
    /// From where the object looks as it does from `camera` (mirrored, where it mirrors).
    fn cameras(&self, camera: &Camera) -> Vec<Camera>;
    /// A little elsewhere: turned by `step` radians, or shifted by half of that.
    fn moved(&self, way: usize, step: f64) -> Self;
}

/// A search that tells how far it is. What it is asked for is none where it was ended.
pub(crate) struct Search<'a, P> {
    pub progress: &'a mut P,
    pub seed: u64,
    pub done: usize,
}

impl<P: FnMut(usize) -> ControlFlow<()>> Search<'_, P> {
    /// A quick fit, or one that goes on from `start`.
    pub fn fitted<'b>(
        &mut self,
        start: Option<&Gaussians>,
        seen: impl Into<Evidence<'b>>,
        config: &InitialFitConfig,
    ) -> Result<Option<Gaussians>, FitError> {
        let mut ended = false;
        let tell = |p: &FitProgress<'_>| {
            let told = (self.progress)(self.done + p.step);
            ended = told.is_break();
            told
        };
        let cloud = fit_from(start, seen, config, self.seed, tell)?;
        self.done += config.iterations;
        Ok((!ended).then_some(cloud))
    }

    /// What `judge` says of each. It is asked again and again whether to go on, without being further.
    pub fn each<S: Symmetry>(
        &mut self,
        all: Vec<S>,
        judge: impl Fn(S) -> Result<(f64, S), FitError> + Sync,
    ) -> Result<Option<Vec<(f64, S)>>, FitError> {
        let mut judged = Vec::with_capacity(all.len());
        for some in all.chunks(TOGETHER) {
            judged.extend(some.par_iter().map(|&one| judge(one)).collect::<Result<Vec<_>, _>>()?);
            if (self.progress)(self.done).is_break() {
                return Ok(None);
            }
        }
        Ok(Some(judged))
    }
}

/// A third of a fit.
pub(crate) fn going_on(config: &InitialFitConfig) -> InitialFitConfig {
    InitialFitConfig { iterations: config.iterations.div_ceil(ROUNDS), ..config.clone() }
}

/// The symmetry near `start` of the least `value`, and that. Moves begin with `reach` and end with `least`. `value` is told the
/// least so far: it need not compute exactly what reaches that.
pub(crate) fn place<S: Symmetry>(
    start: S,
    [reach, least]: [f64; 2],
    value: impl Fn(&S, f64) -> Result<f64, FitError>,
) -> Result<(f64, S), FitError> {
    let mut best = (value(&start, f64::INFINITY)?, start);
    let mut step = reach;
    while step > least {
        let mut better = false;
        for way in 0..S::WAYS {
            for sign in [-step, step] {
                let next = best.1.moved(way, sign);
                let found = value(&next, best.0)?;
                if found < best.0 {
                    best = (found, next);
                    better = true;
                    break;
                }
            }
        }
        if !better {
            step *= 0.5;
        }
    }
    Ok(best)
}

/// Views to compare renders with.
pub(crate) struct Pictures<'a> {
    targets: &'a Targets,
    pixels: Vec<Vec<[f32; 4]>>, // of each view, color times alpha, and alpha
    colors: bool,
}

impl<'a> Pictures<'a> {
    /// The views of `targets`; without `colors` alpha alone counts.
    pub fn new(targets: &'a Targets, colors: bool) -> Self {
        let straight = |p: &image::Rgba<u8>| {
            let [r, g, b, a] = p.0.map(|v| f32::from(v) / 255.0);
            [a * r, a * g, a * b, a]
        };
        Self { targets, pixels: targets.images.iter().map(|i| i.pixels().map(straight).collect()).collect(), colors }
    }

    /// Mean absolute difference between a cloud and the views, from their own cameras or from those that a symmetry makes of them:
    /// of alpha, plus, where colors count, that of color times alpha. From `enough` on what it is so far.
    pub fn difference<S: Symmetry>(
        &self,
        cloud: &Gaussians,
        symmetry: Option<&S>,
        enough: f64,
    ) -> Result<f64, FitError> {
        let targets = self.targets;
        let cameras = |i: usize| symmetry.map_or_else(|| vec![targets.cameras[i]], |s| s.cameras(&targets.cameras[i]));
        let count: usize = (0..self.pixels.len()).map(|i| self.pixels[i].len() * cameras(i).len()).sum();
        let (mut sum, count) = (0.0, count.max(1) as f64);
        for (i, pixels) in self.pixels.iter().enumerate() {
            let cameras = cameras(i);
            let (width, _) = targets.size(i);
            let output = render(cloud.rows(), &cameras, &vec![[0.0; 3]; cameras.len()], &targets.rasters[i])?;
            let rows = output.rgb.as_chunks::<3>().0.chunks_exact(width).zip(output.alpha.chunks_exact(width));
            for ((rgb, alpha), expected) in rows.zip(pixels.chunks_exact(width).cycle()) {
                for x in 0..width {
                    let [r, g, b, a] = expected[if S::MIRRORS && symmetry.is_some() { width - 1 - x } else { x }];
                    let color = (rgb[x][0] - r).abs() + (rgb[x][1] - g).abs() + (rgb[x][2] - b).abs();
                    sum += f64::from(if self.colors { color / 3.0 } else { 0.0 } + (alpha[x] - a).abs());
                }
            }
            if sum / count >= enough {
                break;
            }
        }
        Ok(sum / count)
    }
}

/// What lies within the silhouettes of all views.
pub(crate) struct Hull<'a> {
    targets: &'a Targets,
    cells: Vec<bool>,            // [CELLS, CELLS, CELLS]
    pub points: Vec<DVec3>,      // of the cells within
    pixels: Vec<Vec<usize>>,     // which pixel of each view shows them
    silhouettes: Vec<Vec<bool>>, // what each view shows of the object
}

impl<'a> Hull<'a> {
    pub fn new(targets: &'a Targets) -> Self {
        let silhouettes: Vec<Vec<bool>> =
            targets.images.iter().map(|image| image.pixels().map(|p| p[3] >= 128).collect()).collect();
        let grown: Vec<Vec<bool>> = (0..silhouettes.len()).map(|i| grown(&silhouettes[i], targets.size(i))).collect();
        let mut hull =
            Self { targets, cells: vec![false; CELLS.pow(3)], points: Vec::new(), pixels: Vec::new(), silhouettes };
        let place = |i: usize| ((i as f64 + 0.5) / CELLS as f64 * 2.0 - 1.0) * HALF;
        for (index, cell) in hull.cells.iter_mut().enumerate() {
            let at = [index / (CELLS * CELLS), index / CELLS % CELLS, index % CELLS];
            let point = DVec3::from_array(at.map(place));
            *cell = (0..grown.len()).all(|i| targets.place(i, point).is_some_and(|p| grown[i][p]));
            if *cell {
                hull.points.push(point);
            }
        }
        let pixels = |i| hull.points.iter().map(|&p| targets.place(i, p).expect("within the hull")).collect();
        hull.pixels = (0..targets.images.len()).map(pixels).collect();
        hull
    }

    /// The part of the silhouettes that points of the hull do not fill whose `copies` all lie within the hull.
    pub fn uncovered(&self, copies: &[impl Fn(DVec3) -> DVec3]) -> f64 {
        let mut covered: Vec<Vec<bool>> = self.silhouettes.iter().map(|o| vec![false; o.len()]).collect();
        for (i, &point) in self.points.iter().enumerate() {
            // Most points show nothing that others did not.
            if covered.iter().zip(&self.pixels).all(|(covered, pixels)| covered[pixels[i]]) {
                continue;
            }
            if copies.iter().all(|copy| self.within(copy(point))) {
                covered.iter_mut().zip(&self.pixels).for_each(|(covered, pixels)| covered[pixels[i]] = true);
            }
        }
        let (mut all, mut lost) = (0, 0);
        for (i, silhouette) in self.silhouettes.iter().enumerate() {
            let covered = grown(&covered[i], self.targets.size(i));
            all += silhouette.iter().filter(|o| **o).count();
            lost += silhouette.iter().zip(covered).filter(|(o, c)| **o && !c).count();
        }
        lost as f64 / all.max(1) as f64
    }

    fn within(&self, point: DVec3) -> bool {
        let at = (point / HALF + 1.0) * (0.5 * CELLS as f64);
        let within = at.min_element() >= 0.0 && at.max_element() < CELLS as f64;
        within && self.cells[(at.x as usize * CELLS + at.y as usize) * CELLS + at.z as usize]
    }

    /// The middle of the hull, along `direction`.
    pub fn middle(&self, direction: DVec3) -> f64 {
        let along = self.points.iter().map(|p| p.dot(direction));
        let (low, high) = along.fold((f64::MAX, f64::MIN), |(l, h), x| (l.min(x), h.max(x)));
        0.5 * (low + high)
    }
}

/// Half a sphere of directions, fifteen degrees apart.
pub(crate) fn normals() -> Vec<DVec3> {
    let mut all = Vec::new();
    for row in 0..=6 {
        let elevation = f64::from(row) * PI / 12.0;
        let count = if row == 6 { 1 } else { (24.0 * elevation.cos()).round() as usize };
        let (count, turn) = if row == 0 { (12, PI) } else { (count, 2.0 * PI) };
        for i in 0..count {
            let azimuth = turn * i as f64 / count as f64;
            all.push(DVec3::new(azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin()));
        }
    }
    all
}

/// A mask and the pixels beside it.
fn grown(mask: &[bool], (width, height): (usize, usize)) -> Vec<bool> {
    let mut out = mask.to_vec();
    for y in 0..height {
        for x in 0..width {
            let i = y * width + x;
            if mask[i] {
                (x > 0).then(|| out[i - 1] = true);
                (x + 1 < width).then(|| out[i + 1] = true);
                (y > 0).then(|| out[i - width] = true);
                (y + 1 < height).then(|| out[i + width] = true);
            }
        }
    }
    out
}
