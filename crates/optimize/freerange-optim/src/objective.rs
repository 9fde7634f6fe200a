//! The loss of a cloud against views, and its gradient.

use crate::{FitError, views::Targets};
use freerange_gaussians::{Gaussians, channel};
use freerange_raster::metrics::photometric_loss;
use freerange_raster::{render, render_backward};
use rayon::prelude::*;

/// A loss, and its gradient by the rows of the cloud.
pub(crate) struct Objective {
    pub loss: f64,
    pub gradients: Vec<f32>, // [n, 14]
}

impl Objective {
    /// Mean over the `chosen` views of `(1 - lambda) L1 + lambda (1 - SSIM)`, all over one `background`.
    pub fn photometric(
        cloud: &Gaussians,
        targets: &Targets,
        chosen: &[usize],
        background: [f32; 3],
        lambda_ssim: f64,
    ) -> Result<Self, FitError> {
        let share = 1.0 / chosen.len() as f32;
        let mut losses: Vec<f64> = Vec::with_capacity(chosen.len());
        let mut sum: Option<Vec<f32>> = None;
        for (group, raster) in targets.groups(chosen) {
            let cameras: Vec<_> = group.iter().map(|&i| targets.cameras[i]).collect();
            let output = render(cloud.rows(), &cameras, &vec![background; group.len()], raster)?;
            let (width, height) = targets.size(group[0]);
            let size = width * height * 3;
            let mut d_rgb = vec![0.0; output.rgb.len()]; // [views, h, w, 3]
            let compared = output.rgb.par_chunks(size).zip(d_rgb.par_chunks_mut(size)).zip(group);
            let compared = compared.map(|((image, gradient), &i)| {
                let target = targets.composite(i, background);
                compare(image, &target, width, lambda_ssim as f32, share, gradient)
            });
            losses.extend(compared.collect::<Result<Vec<_>, _>>()?);
            let gradients = render_backward(cloud.rows(), &output, &d_rgb, &[], &[])?.gaussians;
            match &mut sum {
                None => sum = Some(gradients),
                Some(sum) => sum.iter_mut().zip(gradients).for_each(|(sum, g)| *sum += g),
            }
        }
        let loss = losses.iter().sum::<f64>() / chosen.len() as f64;
        let gradients = sum.unwrap_or_else(|| vec![0.0; cloud.rows().len()]);
        Ok(Self { loss, gradients })
    }

    /// Mean over the `chosen` silhouettes, counted from the first of them, of the absolute difference of alpha.
    pub fn silhouettes(cloud: &Gaussians, targets: &Targets, chosen: &[usize]) -> Result<Self, FitError> {
        let mut sum = Self { loss: 0.0, gradients: vec![0.0; cloud.rows().len()] };
        let chosen: Vec<usize> = chosen.iter().map(|&i| targets.views + i).collect();
        for (group, raster) in targets.groups(&chosen) {
            let cameras: Vec<_> = group.iter().map(|&i| targets.cameras[i]).collect();
            let output = render(cloud.rows(), &cameras, &vec![[0.0; 3]; group.len()], raster)?;
            let (width, height) = targets.size(group[0]);
            let share = 1.0 / (chosen.len() * width * height) as f32;
            let mut d_alpha = vec![0.0; output.alpha.len()]; // [views, h, w]
            let pixels = group.iter().flat_map(|&i| targets.images[i].pixels());
            for ((d, alpha), pixel) in d_alpha.iter_mut().zip(&output.alpha).zip(pixels) {
                let difference = alpha - f32::from(pixel[3]) / 255.0;
                sum.loss += f64::from(share * difference.abs());
                *d = if difference == 0.0 { 0.0 } else { share.copysign(difference) };
            }
            let d_rgb = vec![0.0; output.rgb.len()];
            let gradients = render_backward(cloud.rows(), &output, &d_rgb, &d_alpha, &[])?.gaussians;
            sum.gradients.iter_mut().zip(gradients).for_each(|(sum, g)| *sum += g);
        }
        Ok(sum)
    }

    /// Adds another one, of the same cloud.
    pub fn add(&mut self, other: &Self) {
        self.loss += other.loss;
        self.gradients.iter_mut().zip(&other.gradients).for_each(|(sum, g)| *sum += g);
    }

    /// Adds `weight` times the mean opacity.
    pub fn add_opacity(&mut self, cloud: &Gaussians, weight: f64) {
        if weight == 0.0 {
            return;
        }
        let share = (weight / cloud.len() as f64) as f32;
        self.loss += each_row(cloud, &mut self.gradients, |row, gradient| {
            let opacity = 1.0 / (1.0 + (-row[channel::LOGIT_OPACITY]).exp());
            gradient[channel::LOGIT_OPACITY] += share * opacity * (1.0 - opacity);
            share * opacity
        });
    }

    /// Adds `weight` times the mean standard deviation.
    pub fn add_scale(&mut self, cloud: &Gaussians, weight: f64) {
        if weight == 0.0 {
            return;
        }
        let share = (weight / (3 * cloud.len()) as f64) as f32;
        self.loss += each_row(cloud, &mut self.gradients, |row, gradient| {
            let mut sum = 0.0;
            for c in channel::LOG_SCALE {
                let term = share * row[c].exp();
                gradient[c] += term;
                sum += term;
            }
            sum
        });
    }

    /// Refuses to go on with what is not finite.
    pub fn check(&self, step: usize) -> Result<(), FitError> {
        let refuse = |what| Err(FitError::Diverged { step, what });
        if !self.loss.is_finite() {
            return refuse("the loss");
        }
        if !finite(&self.gradients) {
            return refuse("a gradient");
        }
        Ok(())
    }
}

/// The loss of one image `[h, width, 3]` against its target; `share` times its gradient is written to `gradient`, which
/// must be zero.
///
/// Only a rectangle is looked at: where both are plain background, they agree, and there the loss and its gradient are
/// exactly zero. That holds as far as an SSIM window around a pixel sees no difference, and pixels whose windows do see
/// one must see all of what is around it: two radii more than the differences reach.
fn compare(
    image: &[f32],
    target: &[f32],
    width: usize,
    lambda_ssim: f32,
    share: f32,
    gradient: &mut [f32],
) -> Result<f64, FitError> {
    const MARGIN: usize = 10;
    let height = image.len() / (3 * width);
    let differ = |y: usize| {
        let row = 3 * width * y..3 * width * (y + 1);
        let (a, b) = (&image[row.clone()], &target[row]);
        let unequal = |i: &usize| a[*i] != b[*i];
        if a == b { None } else { Some(((0..a.len()).find(unequal)? / 3, (0..a.len()).rfind(unequal)? / 3)) }
    };
    let (mut left, mut right, mut top, mut bottom) = (width, 0, height, 0); // within these, inclusive
    for (y, (first, last)) in (0..height).filter_map(|y| Some((y, differ(y)?))) {
        (left, right, top, bottom) = (left.min(first), right.max(last), top.min(y), y);
    }
    if left > right {
        return Ok(0.0);
    }
    let (x0, y0) = (left.saturating_sub(MARGIN), top.saturating_sub(MARGIN));
    let (x1, y1) = ((right + 1 + MARGIN).min(width), (bottom + 1 + MARGIN).min(height));
    let rows = || (y0..y1).map(|y| 3 * (y * width + x0)..3 * (y * width + x1));
    let crop = |from: &[f32]| {
        let mut part = Vec::with_capacity(3 * (x1 - x0) * (y1 - y0));
        rows().for_each(|row| part.extend_from_slice(&from[row]));
        part
    };
    let (loss, part) = photometric_loss(&crop(image), &crop(target), x1 - x0, y1 - y0, lambda_ssim)?;
    // Means over the rectangle, where means over the image are asked for.
    let scale = part.len() as f64 / image.len() as f64;
    for (row, part) in rows().zip(part.chunks_exact(3 * (x1 - x0))) {
        gradient[row].iter_mut().zip(part).for_each(|(g, p)| *g = share * scale as f32 * p);
    }
    Ok(scale * loss)
}

/// Gaussians that one thread handles at a time.
const TASK: usize = 1024 * channel::COUNT;

/// Calls `f(row, gradient)` for every Gaussian, and sums what it returns, always in the same order.
fn each_row(
    cloud: &Gaussians,
    gradients: &mut [f32],
    f: impl Fn(&[f32; channel::COUNT], &mut [f32; channel::COUNT]) -> f32 + Sync,
) -> f64 {
    let tasks = cloud.rows().par_chunks(TASK).zip(gradients.par_chunks_mut(TASK));
    let sums = tasks.map(|(rows, gradients)| {
        let rows = rows.as_chunks().0.iter().zip(gradients.as_chunks_mut().0);
        rows.map(|(row, gradient)| f64::from(f(row, gradient))).sum()
    });
    sums.collect::<Vec<f64>>().iter().sum()
}

/// Whether all are: without a branch per number, unlike `all`, so that vectors of them are looked at.
fn finite(values: &[f32]) -> bool {
    const EXPONENT: u32 = 0x7f80_0000;
    values.chunks(1024).all(|v| v.iter().fold(0, |any, v| any | u32::from(v.to_bits() & EXPONENT == EXPONENT)) == 0)
}

/// Refuses to go on with a cloud that is not finite.
pub(crate) fn check_cloud(cloud: &Gaussians, step: usize) -> Result<(), FitError> {
    if finite(cloud.rows()) { Ok(()) } else { Err(FitError::Diverged { step, what: "a Gaussian" }) }
}

/// Gives every quaternion unit length, so that its learning rate means an angle.
pub(crate) fn normalize_rotations(cloud: &mut Gaussians) {
    cloud.rows_mut().par_chunks_mut(TASK).for_each(|rows| {
        for row in rows.as_chunks_mut::<{ channel::COUNT }>().0 {
            let q = &mut row[channel::ROTATION];
            let length = q.iter().map(|v| v * v).sum::<f32>().sqrt();
            if length > 0.0 {
                q.iter_mut().for_each(|v| *v /= length);
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        AnchorConfig, Evidence, PosedImage,
        anchors::Anchors,
        tests::{ball, ring},
    };

    /// The rectangle of differences gives what the whole image gives.
    #[test]
    fn comparing_a_part_is_comparing_all() {
        let (width, height, background) = (50, 40, 0.3f32);
        // Differences inside, at two corners, and none.
        for changed in [vec![(20, 17), (24, 12)], vec![(0, 0), (5, 3)], vec![(49, 39)], vec![]] {
            let mut target = vec![background; width * height * 3];
            for (i, v) in target.iter_mut().enumerate() {
                let (x, y) = (i / 3 % width, i / 3 / width);
                *v += if (18..28).contains(&x) && y < 20 { 0.1 * (i as f32).sin() } else { 0.0 };
            }
            let mut image = target.clone();
            changed.iter().for_each(|(x, y)| image[3 * (y * width + x) + 1] += 0.4);
            let (expected, all) = photometric_loss(&image, &target, width, height, 0.2).unwrap();
            let mut found = vec![0.0; image.len()];
            let loss = compare(&image, &target, width, 0.2, 0.5, &mut found).unwrap();
            assert!((loss - expected).abs() < 1e-8, "{loss} {expected}");
            let largest = all.iter().fold(0.0f32, |m, g| m.max(g.abs()));
            assert!(if changed.is_empty() { found.iter().all(|g| *g == 0.0) } else { largest > 1e-5 });
            for (found, all) in found.iter().zip(&all) {
                // SSIM's own gradient at equal images is zero but for rounding.
                assert!((2.0 * found - all).abs() <= 1e-4 * largest + 1e-8, "{found} {all}");
            }
        }
    }

    #[test]
    fn what_is_not_finite_is_found() {
        let mut values = vec![f32::MAX; 3000];
        assert!(finite(&values) && finite(&[]));
        for (at, bad) in [(0, f32::NAN), (1500, f32::INFINITY), (2999, f32::NEG_INFINITY)] {
            let before = std::mem::replace(&mut values[at], bad);
            assert!(!finite(&values));
            values[at] = before;
        }
    }

    /// All terms together, against central differences.
    #[test]
    fn gradients_match_finite_differences() {
        // Of two sizes, one of them with another blur.
        let mut views = ring(3, 24, &ball(12, 1));
        views[2] = ring(3, 40, &ball(12, 1)).remove(2);
        let targets = Targets::new(&views, Some(32)).unwrap();
        assert_eq!(targets.groups(&[0, 1, 2]).map(|(group, _)| group.len()).collect::<Vec<_>>(), [2, 1]);
        let anchors = AnchorConfig { weight: 0.5, views: 5, size: 24 };
        let anchors = Anchors::new(&[ball(12, 2)], &targets, &anchors).unwrap();
        let value = |cloud: &Gaussians| {
            let mut o = Objective::photometric(cloud, &targets, &[0, 2], [0.3, 0.6, 0.1], 0.2).unwrap();
            o.add_opacity(cloud, 0.3);
            o.add_scale(cloud, 0.7);
            o.add(&anchors.objective(cloud, 1, [0.3, 0.6, 0.1]).unwrap());
            o
        };
        check_gradient(value);
    }

    #[test]
    fn gradients_of_silhouettes_match_finite_differences() {
        let mut views = ring(4, 24, &ball(12, 1));
        views[3] = ring(4, 40, &ball(12, 1)).remove(3);
        let targets = Targets::new(
            Evidence { silhouettes: views[1..].iter().map(PosedImage::from).collect(), ..(&views[..1]).into() },
            Some(32),
        )
        .unwrap();
        let silhouettes =
            |cloud: &Gaussians, chosen: &[usize]| Objective::silhouettes(cloud, &targets, chosen).unwrap();
        check_gradient(|cloud| silhouettes(cloud, &[0, 2]));
        // Colors are no part of them.
        let mut gray = ball(12, 3);
        let colored = silhouettes(&gray, &[1]);
        gray.iter_mut().for_each(|row| row[channel::COLOR].fill(0.5));
        let found = silhouettes(&gray, &[1]);
        assert_eq!((found.loss, found.gradients), (colored.loss, colored.gradients));
        // What agrees has nothing to learn but what rounding to bytes leaves.
        let own = silhouettes(&ball(12, 1), &[0, 1]);
        assert!(own.loss < 2e-3 && colored.loss > 10.0 * own.loss, "{} {}", own.loss, colored.loss);
    }

    fn check_gradient(value: impl Fn(&Gaussians) -> Objective) {
        let mut cloud = ball(12, 3);
        let gradients = value(&cloud).gradients;
        let largest = gradients.iter().fold(0.0f32, |m, g| m.max(g.abs()));
        assert!(largest > 0.0);
        let mut off = 0;
        for i in 0..cloud.rows().len() {
            let h = 2e-3;
            let x = cloud.rows()[i];
            cloud.rows_mut()[i] = x + h;
            let above = value(&cloud).loss;
            cloud.rows_mut()[i] = x - h;
            let below = value(&cloud).loss;
            cloud.rows_mut()[i] = x;
            let difference = ((above - below) / f64::from(2.0 * h)) as f32;
            off += usize::from((difference - gradients[i]).abs() > 0.03 * largest);
        }
        // L1 and the rasterizer's cut-offs have kinks; few differences straddle one.
        assert!(off * 20 < cloud.rows().len(), "{off} of {} gradients are off", cloud.rows().len());
    }
}
