//! Rows of one head of attention: gathered with or without RMS norm, its softmax, and what its gradient needs.

use multiversion::multiversion;

use super::math;
use crate::kernels::EPS;

/// Sizes of one call.
#[derive(Clone, Copy)]
pub struct Sizes {
    pub tokens: usize,
    pub queries: usize,
    pub heads: usize,
    pub width: usize,
}

impl Sizes {
    pub fn d(&self) -> usize {
        self.heads * self.width
    }

    /// Where part `part` (0 queries, 1 keys, 2 values) of `head` starts in a row of `qkv`.
    pub fn column(&self, part: usize, head: usize) -> usize {
        (part * self.heads + head) * self.width
    }

    /// Writes one head's rows `[n, width]` to rows of `3 d` values, from this token and at this column.
    ///
    /// # Safety
    /// Those columns of those rows of `to` must be valid for writes, and nothing else may touch them meanwhile.
    pub unsafe fn store(&self, rows: &[f32], first_token: usize, column: usize, to: *mut f32) {
        for (i, row) in rows.chunks_exact(self.width).enumerate() {
            // SAFETY: the caller's promise.
            unsafe {
                let to = to.add((first_token + i) * 3 * self.d() + column);
                std::ptr::copy_nonoverlapping(row.as_ptr(), to, self.width);
            }
        }
    }
}

/// Gathers the rows of one head (`stride` apart, from `x[0]`) as `factor x`, `[n, width]`.
fn scaled(x: &[f32], stride: usize, factor: f32, width: usize, out: &mut [f32]) {
    for (i, out) in out.chunks_exact_mut(width).enumerate() {
        for (out, x) in out.iter_mut().zip(&x[i * stride..][..width]) {
            *out = factor * x;
        }
    }
}

/// Gathers the rows of one head as `factor weight x / rms(x)`, `[n, width]`; without weights, as `factor x`.
pub fn gather(x: &[f32], stride: usize, weight: Option<&[f32]>, factor: f32, width: usize, out: &mut [f32]) {
    match weight {
        Some(weight) => normalized(x, stride, weight, factor, out),
        None => scaled(x, stride, factor, width, out),
    }
}

/// Backward of [`gather`]: turns the gradient rows in `grad` into those of `x`, and adds to that of the weights.
pub fn gather_backward(
    x: &[f32],
    stride: usize,
    weight: Option<&[f32]>,
    factor: f32,
    grad: &mut [f32],
    d_weight: &mut [f32],
) {
    match weight {
        Some(weight) => normalized_backward(x, stride, weight, factor, grad, d_weight),
        None => scale_row(grad, factor),
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
fn normalized(x: &[f32], stride: usize, weight: &[f32], factor: f32, out: &mut [f32]) {
    let width = weight.len();
    for (i, out) in out.chunks_exact_mut(width).enumerate() {
        let x = &x[i * stride..][..width];
        let inverse = factor / (math::sum(x, |x| x * x) / width as f32 + EPS).sqrt();
        for ((out, x), w) in out.iter_mut().zip(x).zip(weight) {
            *out = x * inverse * w;
        }
    }
}

/// With r = 1 / rms(x) and h = weight grad: dx = r (h - x r^2 mean(h x)).
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
fn normalized_backward(x: &[f32], stride: usize, weight: &[f32], factor: f32, grad: &mut [f32], d_weight: &mut [f32]) {
    let width = weight.len();
    for (i, grad) in grad.chunks_exact_mut(width).enumerate() {
        let x = &x[i * stride..][..width];
        let inverse = 1.0 / (math::sum(x, |x| x * x) / width as f32 + EPS).sqrt();
        for j in 0..width {
            let g = grad[j] * factor;
            d_weight[j] += g * x[j] * inverse;
            grad[j] = g * weight[j];
        }
        let mean = math::sum2(grad, x, |h, x| h * x) / width as f32 * inverse * inverse;
        for j in 0..width {
            grad[j] = inverse * (grad[j] - x[j] * mean);
        }
    }
}

/// Turns the first `tokens` of each row of scores into exp(score - largest); stores 1 / sum and the log of the softmax's
/// denominator.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
pub fn softmax_rows(scores: &mut [f32], stride: usize, tokens: usize, inverse_sum: &mut [f32], log_sum: &mut [f32]) {
    for (i, row) in scores.chunks_exact_mut(stride).enumerate() {
        let row = &mut row[..tokens];
        let largest = math::max(row);
        for s in row.iter_mut() {
            *s = math::exp(*s - largest);
        }
        let sum = math::sum(row, |p| p);
        inverse_sum[i] = 1.0 / sum;
        log_sum[i] = largest + sum.ln();
    }
}

/// Multiplies all of `row`.
pub fn scale_row(row: &mut [f32], factor: f32) {
    row.iter_mut().for_each(|x| *x *= factor);
}

/// The norms' weights of queries and keys.
pub type Weights<'a> = [&'a [f32]; 2];

/// What the gradient of one head needs of its image.
#[derive(Clone, Copy)]
pub struct Saved<'a> {
    pub rows: &'a [f32],    // [tokens, 3 d]
    pub out: &'a [f32],     // [queries, d]
    pub grad: &'a [f32],    // [queries, d]
    pub log_sum: &'a [f32], // [queries]
}
