//! SSIM as 3D Gaussian Splatting trains with it, and its gradient.
//!
//! Window: 11 x 11 Gaussian, sigma 1.5, zero padding; mean over all pixels and channels (Wang et al. 2004, with
//! C1 = 0.01^2 and C2 = 0.03^2). The window is separable, and with zero padding its own adjoint, so that the
//! backward pass is the same blur on three maps. A few rows are handled together: first down the rows around each, a
//! strip of columns at a time that stays in the nearest cache, then along each; interleaved channels are only a stride of
//! 3 along the row.

use crate::metrics::{CHANNELS, ImageError, error::check_size};
use multiversion::{multiversion, target::target_cfg_f};
use rayon::prelude::*;
use std::ops::Range;

/// Taps of the window on each side of its center.
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
/// Rows handled together, and columns of theirs.
const ROWS: usize = 8;
const STRIP: usize = 32;

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

/// `a * b + c`, in one instruction where the target has it.
#[inline(always)]
fn fma<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// Blurs `map`, `[rows, length]`, down the rows around each of `band`; `out` holds a padded row for each.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma"))]
fn down(map: &[f32], length: usize, band: Range<usize>, weights: &[f32; TAPS], out: &mut [f32]) {
    const FMA: bool = target_cfg_f!(any(target_feature = "fma", target_arch = "aarch64"));
    let rows = map.len() / length;
    let window = |i: usize| i.saturating_sub(RADIUS)..(i + RADIUS + 1).min(rows);
    // The last strip begins where it still fits: some of its columns are computed twice.
    let last = (length > STRIP && !length.is_multiple_of(STRIP)).then(|| length - STRIP);
    for at in (0..length / STRIP).map(|strip| strip * STRIP).chain(last) {
        for (i, row) in band.clone().zip(out.chunks_exact_mut(padded(length))) {
            let mut sum = [0.0f32; STRIP];
            for r in window(i) {
                let (w, block) = (weights[r + RADIUS - i], &map[r * length + at..][..STRIP]);
                for l in 0..STRIP {
                    sum[l] = fma::<FMA>(w, block[l], sum[l]);
                }
            }
            row[PAD + at..][..STRIP].copy_from_slice(&sum);
        }
    }
    if length < STRIP {
        for (i, row) in band.zip(out.chunks_exact_mut(padded(length))) {
            for (j, out) in row[PAD..][..length].iter_mut().enumerate() {
                *out = window(i).fold(0.0, |sum, r| fma::<FMA>(weights[r + RADIUS - i], map[r * length + j], sum));
            }
        }
    }
}

/// Blurs a padded row along itself, channel by channel.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma"))]
fn along(row: &[f32], weights: &[f32; TAPS], out: &mut [f32]) {
    const FMA: bool = target_cfg_f!(any(target_feature = "fma", target_arch = "aarch64"));
    for (b, target) in out.chunks_exact_mut(LANES).enumerate() {
        let mut sum = [0.0f32; LANES];
        for (k, w) in weights.iter().enumerate() {
            let block = &row[b * LANES + k * CHANNELS..][..LANES];
            for l in 0..LANES {
                sum[l] = fma::<FMA>(*w, block[l], sum[l]);
            }
        }
        target.copy_from_slice(&sum);
    }
}

/// From blurred moments to similarity, and its derivatives by E[x], E[xx] and E[xy]; returns the row's sum.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma"))]
fn similarity(m: [&[f32]; 4], by_x: &mut [f32], by_xx: &mut [f32], by_xy: &mut [f32]) -> f64 {
    let (c1, c2) = (C1 as f32, C2 as f32);
    let n = by_x.len();
    let (ex, ey, both, exy) = (&m[0][..n], &m[1][..n], &m[2][..n], &m[3][..n]);
    let (by_xx, by_xy) = (&mut by_xx[..n], &mut by_xy[..n]);
    let mut totals = [0.0f64; LANES]; // side by side, else each sum waits for the one before
    for at in (0..n).step_by(LANES) {
        let mut found = [0.0f32; LANES];
        for (s, i) in found.iter_mut().zip(at..n) {
            let (mx, my) = (ex[i], ey[i]);
            let a1 = 2.0 * mx * my + c1;
            let a2 = 2.0 * (exy[i] - mx * my) + c2;
            let squares = mx * mx + my * my;
            let b1 = squares + c1;
            let b2 = (both[i] - squares) + c2;
            let inverse = 1.0 / (b1 * b2);
            *s = a1 * a2 * inverse;
            // The variances contain the means: dS/dE[x] collects all three ways.
            by_x[i] = 2.0 * inverse * (my * (a2 - a1) + mx * *s * (b1 - b2));
            by_xx[i] = -*s * inverse * b1;
            by_xy[i] = 2.0 * a1 * inverse;
        }
        totals.iter_mut().zip(found).for_each(|(total, s)| *total += f64::from(s));
    }
    totals.iter().sum()
}

/// `xx + yy` and `xy` of two images.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma"))]
fn products(x: &[f32], y: &[f32]) -> [Vec<f32>; 2] {
    let pairs = || x.iter().zip(y);
    [pairs().map(|(x, y)| x * x + y * y).collect(), pairs().map(|(x, y)| x * y).collect()]
}

/// Maps `[rows, length]`, and some of their rows blurred.
struct Blur<'a, const N: usize> {
    maps: [&'a [f32]; N],
    length: usize,
    down: Vec<f32>,         // [ROWS, padded length]
    blurred: [Vec<f32>; N], // [ROWS, whole blocks] each
}

impl<'a, const N: usize> Blur<'a, N> {
    fn new(maps: [&'a [f32]; N], length: usize) -> Self {
        let blurred = std::array::from_fn(|_| vec![0.0; ROWS * length.next_multiple_of(LANES)]);
        Self { maps, length, down: vec![0.0; ROWS * padded(length)], blurred }
    }

    /// Blurs at most [`ROWS`] rows from `first` on, and calls `f` with the number of each and what became of it.
    fn each(&mut self, first: usize, weights: &[f32; TAPS], mut f: impl FnMut(usize, [&[f32]; N])) {
        let band = first..(first + ROWS).min(self.maps[0].len() / self.length);
        let whole = self.length.next_multiple_of(LANES);
        for (map, blurred) in self.maps.iter().zip(&mut self.blurred) {
            down(map, self.length, band.clone(), weights, &mut self.down);
            let rows = self.down.chunks_exact(padded(self.length)).zip(blurred.chunks_exact_mut(whole));
            rows.take(band.len()).for_each(|(row, out)| along(row, weights, out));
        }
        for i in band.clone() {
            f(i, self.blurred.each_ref().map(|map| &map[(i - first) * whole..][..self.length]));
        }
    }
}

/// Mean SSIM of two images `[height, width, 3]` in `[0, 1]`, 3DGS variant: 11 x 11 Gaussian of sigma 1.5, zero
/// padding, mean over all pixels and channels.
pub fn ssim_3dgs(first: &[f32], second: &[f32], width: usize, height: usize) -> Result<f64, ImageError> {
    check_size(first, second, width, height)?;
    let (length, weights) = (width * CHANNELS, window_f32());
    let [squares, product] = products(first, second);
    let moments = [first, second, &squares, &product];
    let sums: Vec<f64> = (0..height.div_ceil(ROWS))
        .into_par_iter()
        .map_init(
            || (Blur::new(moments, length), [(); 3].map(|_| vec![0.0; length])),
            |(blur, [dx, dxx, dxy]), band| {
                let mut sum = 0.0;
                blur.each(band * ROWS, &weights, |_, moments| sum += similarity(moments, dx, dxx, dxy));
                sum
            },
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
) -> Result<(f64, Vec<f32>), ImageError> {
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
) -> Result<(f64, Vec<f32>), ImageError> {
    check_size(image, target, width, height)?;
    let step = (1.0 - lambda) / image.len() as f32;
    let mut gradient: Vec<f32> =
        image.iter().zip(target).map(|(a, b)| if a == b { 0.0 } else { step.copysign(a - b) }).collect();
    let l1 = crate::metrics::l1(image, target)?;
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
) -> Result<f64, ImageError> {
    check_size(first, second, width, height)?;
    let (length, weights) = (width * CHANNELS, window_f32());
    let n = first.len();
    let [squares, product] = products(first, second);
    let moments = [first, second, &squares, &product];
    let mut maps = vec![0.0f32; 3 * n];
    let (by_x, rest) = maps.split_at_mut(n);
    let (by_xx, by_xy) = rest.split_at_mut(n);
    let band = ROWS * length;
    let sums: Vec<f64> = by_x
        .par_chunks_mut(band)
        .zip(by_xx.par_chunks_mut(band))
        .zip(by_xy.par_chunks_mut(band))
        .enumerate()
        .map_init(
            || Blur::new(moments, length),
            |blur, (b, ((dx, dxx), dxy))| {
                let mut sum = 0.0;
                blur.each(b * ROWS, &weights, |i, moments| {
                    let row = (i - b * ROWS) * length..(i - b * ROWS + 1) * length;
                    sum += similarity(moments, &mut dx[row.clone()], &mut dxx[row.clone()], &mut dxy[row]);
                });
                sum
            },
        )
        .collect();

    let scale = factor / n as f32;
    let maps = [&*by_x, &*by_xx, &*by_xy];
    gradient.par_chunks_mut(band).enumerate().for_each_init(
        || Blur::new(maps, length),
        |blur, (b, target)| {
            blur.each(b * ROWS, &weights, |i, [dx, dxx, dxy]| {
                let (x, y) = (&first[i * length..][..length], &second[i * length..][..length]);
                for (j, g) in target[(i - b * ROWS) * length..][..length].iter_mut().enumerate() {
                    *g += scale * (dx[j] + 2.0 * x[j] * dxx[j] + y[j] * dxy[j]);
                }
            });
        },
    );
    Ok(sums.iter().sum::<f64>() / n as f64)
}
