//! SSIM as 3D Gaussian Splatting trains with it, and its gradient.
//!
//! Window: 11 x 11 Gaussian, sigma 1.5, zero padding; mean over all pixels and channels (Wang et al. 2004, with
//! C1 = 0.01^2 and C2 = 0.03^2). The window is separable, and with zero padding its own adjoint, so that the
//! backward pass is the same blur on three maps. Rows are handled one by one: first down the 11 rows around one,
//! then along it, all in cache; interleaved channels are only a stride of 3 along the row.

use crate::{CHANNELS, MetricsError, error::check_size};
use rayon::prelude::*;

/// Taps of the window on each side of its centre.
pub(crate) const RADIUS: usize = 5;
/// Width of the window.
pub(crate) const TAPS: usize = 2 * RADIUS + 1;
pub(crate) const SIGMA: f64 = 1.5;
pub(crate) const C1: f64 = 0.01 * 0.01;
pub(crate) const C2: f64 = 0.03 * 0.03;

/// Zeros on each side of a row buffer, enough for the window.
const PAD: usize = RADIUS * CHANNELS;
/// Values handled together, so that the sums stay in vector registers.
const LANES: usize = 16;

/// The window's weights along one axis; they sum to 1.
pub(crate) fn window() -> [f64; TAPS] {
    let mut w: [f64; TAPS] = std::array::from_fn(|i| {
        let x = i as f64 - RADIUS as f64;
        (-x * x / (2.0 * SIGMA * SIGMA)).exp()
    });
    let sum: f64 = w.iter().sum();
    w.iter_mut().for_each(|v| *v /= sum);
    w
}

fn window_f32() -> [f32; TAPS] {
    window().map(|v| v as f32)
}

/// A row with `PAD` zeros before it and at least that many behind, its length rounded up to whole blocks.
fn padded(row_length: usize) -> usize {
    row_length.next_multiple_of(LANES) + 2 * PAD
}

fn load(row: &[f32], at: usize) -> [f32; LANES] {
    let mut block = [0.0; LANES];
    match row.get(at..at + LANES) {
        Some(full) => block.copy_from_slice(full),
        None => block[..row.len() - at].copy_from_slice(&row[at..]),
    }
    block
}

/// Blurs E[x], E[y], E[xx], E[yy], E[xy] down the rows around row `i`; `out` holds five padded rows.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma"))]
fn moments_down(x: &[f32], y: &[f32], length: usize, i: usize, weights: &[f32; TAPS], out: &mut [Vec<f32>; 5]) {
    let rows = x.len() / length;
    let (first, last) = (i.saturating_sub(RADIUS), (i + RADIUS).min(rows - 1));
    for at in (0..length).step_by(LANES) {
        let mut sums = [[0.0f32; LANES]; 5];
        for r in first..=last {
            let w = weights[r + RADIUS - i];
            let (bx, by) = (load(&x[r * length..][..length], at), load(&y[r * length..][..length], at));
            for l in 0..LANES {
                let (wx, wy) = (w * bx[l], w * by[l]);
                sums[0][l] += wx;
                sums[1][l] += wy;
                sums[2][l] += wx * bx[l];
                sums[3][l] += wy * by[l];
                sums[4][l] += wx * by[l];
            }
        }
        for (row, sum) in out.iter_mut().zip(&sums) {
            row[PAD + at..PAD + at + LANES].copy_from_slice(sum);
        }
    }
}

/// Blurs three maps `[rows, length]` down the rows around row `i`; `out` holds three padded rows.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma"))]
fn maps_down(maps: [&[f32]; 3], length: usize, i: usize, weights: &[f32; TAPS], out: &mut [Vec<f32>; 3]) {
    let rows = maps[0].len() / length;
    let (first, last) = (i.saturating_sub(RADIUS), (i + RADIUS).min(rows - 1));
    for (map, row) in maps.iter().zip(out) {
        for at in (0..length).step_by(LANES) {
            let mut sum = [0.0f32; LANES];
            for r in first..=last {
                let w = weights[r + RADIUS - i];
                let block = load(&map[r * length..][..length], at);
                for l in 0..LANES {
                    sum[l] += w * block[l];
                }
            }
            row[PAD + at..PAD + at + LANES].copy_from_slice(&sum);
        }
    }
}

/// Blurs a padded row along itself, channel by channel.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma"))]
fn along(row: &[f32], weights: &[f32; TAPS], out: &mut [f32]) {
    for (b, target) in out.chunks_exact_mut(LANES).enumerate() {
        let mut sum = [0.0f32; LANES];
        for (k, w) in weights.iter().enumerate() {
            let block = &row[b * LANES + k * CHANNELS..][..LANES];
            for l in 0..LANES {
                sum[l] += w * block[l];
            }
        }
        target.copy_from_slice(&sum);
    }
}

/// From blurred moments to similarity, and its derivatives by E[x], E[xx] and E[xy]; returns the row's sum.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma"))]
fn similarity(m: &[Vec<f32>; 5], by_x: &mut [f32], by_xx: &mut [f32], by_xy: &mut [f32]) -> f64 {
    let (c1, c2) = (C1 as f32, C2 as f32);
    let n = by_x.len();
    let (ex, ey, exx, eyy, exy) = (&m[0][..n], &m[1][..n], &m[2][..n], &m[3][..n], &m[4][..n]);
    let (by_xx, by_xy) = (&mut by_xx[..n], &mut by_xy[..n]);
    let mut total = 0.0;
    for i in 0..n {
        let (mx, my) = (ex[i], ey[i]);
        let a1 = 2.0 * mx * my + c1;
        let a2 = 2.0 * (exy[i] - mx * my) + c2;
        let b1 = mx * mx + my * my + c1;
        let b2 = (exx[i] - mx * mx) + (eyy[i] - my * my) + c2;
        let inverse = 1.0 / (b1 * b2);
        let s = a1 * a2 * inverse;
        // The variances contain the means: dS/dE[x] collects all three ways.
        by_x[i] = 2.0 * inverse * (my * (a2 - a1) + mx * s * (b1 - b2));
        by_xx[i] = -s / b2;
        by_xy[i] = 2.0 * a1 * inverse;
        total += f64::from(s);
    }
    total
}

fn rows_of(length: usize) -> Vec<f32> {
    vec![0.0; padded(length)]
}

/// Row buffers for the five blurred moments E[x], E[y], E[xx], E[yy], E[xy].
struct Moments {
    length: usize,
    down: [Vec<f32>; 5],
    blurred: [Vec<f32>; 5],
}

impl Moments {
    fn new(length: usize) -> Self {
        let rows = || std::array::from_fn(|_| rows_of(length));
        Self { length, down: rows(), blurred: rows() }
    }

    /// The moments of row `i`.
    fn around(&mut self, x: &[f32], y: &[f32], i: usize, weights: &[f32; TAPS]) -> &[Vec<f32>; 5] {
        moments_down(x, y, self.length, i, weights, &mut self.down);
        for (source, target) in self.down.iter().zip(&mut self.blurred) {
            along(source, weights, &mut target[..self.length.next_multiple_of(LANES)]);
        }
        &self.blurred
    }
}

/// Mean SSIM of two images `[height, width, 3]` in `[0, 1]`, 3DGS variant: 11 x 11 Gaussian of sigma 1.5, zero
/// padding, mean over all pixels and channels.
pub fn ssim_3dgs(first: &[f32], second: &[f32], width: usize, height: usize) -> Result<f64, MetricsError> {
    check_size(first, second, width, height)?;
    let (length, weights) = (width * CHANNELS, window_f32());
    let sums: Vec<f64> = (0..height)
        .into_par_iter()
        .map_init(
            || (Moments::new(length), [(); 3].map(|_| vec![0.0; length])),
            |(moments, [dx, dxx, dxy]), i| similarity(moments.around(first, second, i, &weights), dx, dxx, dxy),
        )
        .collect();
    Ok(sums.iter().sum::<f64>() / first.len() as f64)
}

/// [`ssim_3dgs`] and its gradient with respect to the first image, `[height, width, 3]`.
pub fn ssim_with_gradient(
    first: &[f32],
    second: &[f32],
    width: usize,
    height: usize,
) -> Result<(f64, Vec<f32>), MetricsError> {
    let mut gradient = vec![0.0; first.len()];
    let value = accumulate_ssim(first, second, width, height, 1.0, &mut gradient)?;
    Ok((value, gradient))
}

/// The loss of 3D Gaussian Splatting, `(1 - lambda) L1 + lambda (1 - SSIM)` with means over all values, and its
/// gradient with respect to `image`, `[height, width, 3]`. At equal values the gradient of L1 is 0.
pub fn photometric_loss(
    image: &[f32],
    target: &[f32],
    width: usize,
    height: usize,
    lambda: f32,
) -> Result<(f64, Vec<f32>), MetricsError> {
    check_size(image, target, width, height)?;
    let step = (1.0 - lambda) / image.len() as f32;
    let mut gradient: Vec<f32> =
        image.iter().zip(target).map(|(a, b)| if a == b { 0.0 } else { step.copysign(a - b) }).collect();
    let l1 = crate::l1(image, target)?;
    if lambda == 0.0 {
        return Ok((l1, gradient));
    }
    let ssim = accumulate_ssim(image, target, width, height, -lambda, &mut gradient)?;
    Ok(((1.0 - f64::from(lambda)) * l1 + f64::from(lambda) * (1.0 - ssim), gradient))
}

/// Adds `factor` times the gradient of the mean SSIM to `gradient`; returns the mean SSIM.
fn accumulate_ssim(
    first: &[f32],
    second: &[f32],
    width: usize,
    height: usize,
    factor: f32,
    gradient: &mut [f32],
) -> Result<f64, MetricsError> {
    check_size(first, second, width, height)?;
    let (length, weights) = (width * CHANNELS, window_f32());
    let n = first.len();
    let mut maps = vec![0.0f32; 3 * n];
    let (by_x, rest) = maps.split_at_mut(n);
    let (by_xx, by_xy) = rest.split_at_mut(n);
    let sums: Vec<f64> = by_x
        .par_chunks_mut(length)
        .zip(by_xx.par_chunks_mut(length))
        .zip(by_xy.par_chunks_mut(length))
        .enumerate()
        .map_init(
            || Moments::new(length),
            |moments, (i, ((dx, dxx), dxy))| similarity(moments.around(first, second, i, &weights), dx, dxx, dxy),
        )
        .collect();

    let scale = factor / n as f32;
    let maps = [&*by_x, &*by_xx, &*by_xy];
    gradient.par_chunks_mut(length).enumerate().for_each_init(
        || [(); 2].map(|_| std::array::from_fn(|_| rows_of(length))),
        |[down, blurred]: &mut [[Vec<f32>; 3]; 2], (i, target)| {
            maps_down(maps, length, i, &weights, down);
            for (source, out) in down.iter().zip(blurred.iter_mut()) {
                along(source, &weights, &mut out[..length.next_multiple_of(LANES)]);
            }
            let (x, y) = (&first[i * length..][..length], &second[i * length..][..length]);
            let [dx, dxx, dxy] = blurred;
            for (j, g) in target.iter_mut().enumerate() {
                *g += scale * (dx[j] + 2.0 * x[j] * dxx[j] + y[j] * dxy[j]);
            }
        },
    );
    Ok(sums.iter().sum::<f64>() / n as f64)
}
