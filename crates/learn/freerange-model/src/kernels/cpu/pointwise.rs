//! Modulated layer norm, gated residual, GEGLU: each one pass over memory, rows in parallel. Gradients take the place of
//! what they are the last to read.

use std::mem::MaybeUninit;

use burn::backend::flex::FlexTensor;
use multiversion::multiversion;
use rayon::prelude::*;

use super::{contiguous, dims, into_values, linear::ROWS, math, tensor, values};
use crate::kernels::EPS;

/// Calls `f(first row, rows of out)` for pieces of `ROWS` rows that do not cross batch elements, in parallel, and
/// collects what it returns: `[b][pieces per batch element]`.
fn pieces<T: Send, R: Send>(
    out: &mut [T],
    [b, t, width]: [usize; 3],
    f: impl Fn(usize, usize, &mut [T]) -> R + Sync,
) -> Vec<Vec<R>> {
    let f = &f;
    if out.is_empty() {
        return (0..b).map(|_| Vec::new()).collect();
    }
    out.par_chunks_mut(t * width)
        .enumerate()
        .map(|(batch, rows)| {
            rows.par_chunks_mut(ROWS * width)
                .enumerate()
                .map(|(i, piece)| f(batch, batch * t + i * ROWS, piece))
                .collect()
        })
        .collect()
}

/// Adds up the pieces of each batch element, in order: `[b, width]`.
fn total(partial: Vec<Vec<Vec<f32>>>, width: usize) -> FlexTensor {
    let b = partial.len();
    let mut sums = vec![0f32; b * width];
    for (sum, pieces) in sums.chunks_exact_mut(width).zip(partial) {
        pieces.iter().for_each(|piece| math::add(sum, piece));
    }
    tensor(sums, &[b, width])
}

/// So many numbers, which `f` writes.
///
/// # Safety
/// It must write all of them.
unsafe fn written(n: usize, f: impl FnOnce(&mut [MaybeUninit<f32>])) -> Vec<f32> {
    let mut out = Vec::with_capacity(n);
    f(&mut out.spare_capacity_mut()[..n]);
    // SAFETY: within the capacity, and written by the caller's promise.
    unsafe { out.set_len(n) };
    out
}

/// Mean and reciprocal standard deviation of a row.
#[inline(always)]
fn statistics(row: &[f32]) -> (f32, f32) {
    let n = row.len() as f32;
    let mean = math::sum(row, |x| x) / n;
    let variance = math::sum(row, |x| (x - mean) * (x - mean)) / n;
    (mean, 1.0 / (variance + EPS).sqrt())
}

#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
fn norm_rows(x: &[f32], shift: &[f32], scale: &[f32], out: &mut [MaybeUninit<f32>]) {
    let width = shift.len();
    assert!(x.len() == out.len() && x.len().is_multiple_of(width) && scale.len() == width);
    for (x, out) in x.chunks_exact(width).zip(out.chunks_exact_mut(width)) {
        let (mean, inverse) = statistics(x);
        for (((out, x), shift), scale) in out.iter_mut().zip(x).zip(shift).zip(scale) {
            out.write((x - mean) * inverse * (1.0 + scale) + shift);
        }
    }
}

/// Adds to the gradients of `x`, shift and scale. With y = (x - mean) / deviation and h = grad (1 +
/// scale): dx = (h - mean(h) - y mean(h y)) / deviation.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
fn norm_rows_backward(
    x: &[f32],
    scale: &[f32],
    grad: &[f32],
    dx: &mut [f32],
    d_shift: &mut [f32],
    d_scale: &mut [f32],
) {
    let width = scale.len();
    let (d_shift, d_scale) = (&mut d_shift[..width], &mut d_scale[..width]);
    let mut h = vec![0f32; width];
    for ((x, grad), dx) in x.chunks_exact(width).zip(grad.chunks_exact(width)).zip(dx.chunks_exact_mut(width)) {
        let (mean, inverse) = statistics(x);
        for i in 0..width {
            let y = (x[i] - mean) * inverse;
            d_shift[i] += grad[i];
            d_scale[i] += grad[i] * y;
            h[i] = grad[i] * (1.0 + scale[i]);
        }
        let mean_h = math::sum(&h, |h| h) / width as f32;
        let mean_hy = math::sum2(&h, x, |h, x| h * (x - mean)) * inverse / width as f32;
        for i in 0..width {
            dx[i] += (h[i] - mean_h - (x[i] - mean) * inverse * mean_hy) * inverse;
        }
    }
}

pub fn modulated_norm(x: FlexTensor, shift: FlexTensor, scale: FlexTensor) -> FlexTensor {
    let (x, shift, scale) = (contiguous(x), contiguous(shift), contiguous(scale));
    let shape @ [_, _, d] = dims(&x);
    let (xs, shifts, scales) = (values(&x), values(&shift), values(&scale));
    // SAFETY: `norm_rows` writes whole rows, and pieces are all of them.
    let out = unsafe {
        written(xs.len(), |out| {
            pieces(out, shape, |batch, row, out| {
                let m = batch * d..(batch + 1) * d;
                norm_rows(&xs[row * d..][..out.len()], &shifts[m.clone()], &scales[m], out);
            });
        })
    };
    tensor(out, &shape)
}

/// The gradient of `x` is added to the residual's.
pub fn modulated_norm_backward(
    x: FlexTensor,
    scale: FlexTensor,
    grad: FlexTensor,
    residual: Option<FlexTensor>,
) -> [FlexTensor; 3] {
    let (x, scale, grad) = (contiguous(x), contiguous(scale), contiguous(grad));
    let shape @ [_, _, d] = dims(&x);
    let (xs, scales, grads) = (values(&x), values(&scale), values(&grad));
    let mut dx = residual.map_or_else(|| vec![0f32; xs.len()], into_values);
    assert_eq!(dx.len(), xs.len(), "norm: the residual's gradient");
    let sums = pieces(&mut dx, shape, |batch, row, dx| {
        let (mut d_shift, mut d_scale) = (vec![0f32; d], vec![0f32; d]);
        let part = row * d..row * d + dx.len();
        norm_rows_backward(&xs[part.clone()], &scales[batch * d..][..d], &grads[part], dx, &mut d_shift, &mut d_scale);
        (d_shift, d_scale)
    });
    let (d_shift, d_scale) = sums.into_iter().map(|pieces| pieces.into_iter().unzip()).unzip();
    [tensor(dx, &shape), total(d_shift, d), total(d_scale, d)]
}

#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
fn gated_rows(x: &[f32], gate: &[f32], y: &[f32], out: &mut [MaybeUninit<f32>]) {
    let width = gate.len();
    assert!(x.len() == out.len() && y.len() == out.len() && out.len().is_multiple_of(width));
    let rows = x.chunks_exact(width).zip(y.chunks_exact(width)).zip(out.chunks_exact_mut(width));
    for ((x, y), out) in rows {
        for i in 0..width {
            out[i].write(x[i] + gate[i] * y[i]);
        }
    }
}

/// Turns `y` into its gradient, and adds to those of the gate and of `y`'s bias.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
fn gated_rows_backward(gate: &[f32], y: &mut [f32], grad: &[f32], d_gate: &mut [f32], d_bias: &mut [f32]) {
    let width = gate.len();
    let (d_gate, d_bias) = (&mut d_gate[..width], &mut d_bias[..width]);
    for (y, grad) in y.chunks_exact_mut(width).zip(grad.chunks_exact(width)) {
        for i in 0..width {
            let dy = gate[i] * grad[i];
            d_gate[i] += y[i] * grad[i];
            d_bias[i] += dy;
            y[i] = dy;
        }
    }
}

pub fn gated_add(x: FlexTensor, gate: FlexTensor, y: FlexTensor) -> FlexTensor {
    let (x, gate, y) = (contiguous(x), contiguous(gate), contiguous(y));
    let shape @ [_, _, d] = dims(&x);
    let (xs, gates, ys) = (values(&x), values(&gate), values(&y));
    // SAFETY: `gated_rows` writes whole rows, and pieces are all of them.
    let out = unsafe {
        written(xs.len(), |out| {
            pieces(out, shape, |batch, row, out| {
                let part = row * d..row * d + out.len();
                gated_rows(&xs[part.clone()], &gates[batch * d..][..d], &ys[part], out);
            });
        })
    };
    tensor(out, &shape)
}

/// Gradients of the gate, of `y` and of its bias.
pub fn gated_add_backward(gate: FlexTensor, y: FlexTensor, grad: FlexTensor) -> [FlexTensor; 3] {
    let (gate, grad) = (contiguous(gate), contiguous(grad));
    let shape @ [_, _, d] = dims(&y);
    let (gates, grads) = (values(&gate), values(&grad));
    let mut dy = into_values(y);
    let sums = pieces(&mut dy, shape, |batch, row, y| {
        let (mut d_gate, mut d_bias) = (vec![0f32; d], vec![0f32; d]);
        let grad = &grads[row * d..][..y.len()];
        gated_rows_backward(&gates[batch * d..][..d], y, grad, &mut d_gate, &mut d_bias);
        (d_gate, d_bias)
    });
    let (d_gate, d_bias): (Vec<_>, Vec<Vec<_>>) = sums.into_iter().map(|pieces| pieces.into_iter().unzip()).unzip();
    [total(d_gate, d), tensor(dy, &shape), bias(d_bias.into_iter().flatten(), d)]
}

/// Adds up the pieces of a bias' gradient, in order.
fn bias(pieces: impl Iterator<Item = Vec<f32>>, width: usize) -> FlexTensor {
    let mut sums = vec![0f32; width];
    pieces.for_each(|piece| math::add(&mut sums, &piece));
    tensor(sums, &[width])
}

#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
fn geglu_rows(x: &[f32], out: &mut [MaybeUninit<f32>], f: usize) {
    assert!(x.len() == 2 * out.len() && out.len().is_multiple_of(f));
    for (x, out) in x.chunks_exact(2 * f).zip(out.chunks_exact_mut(f)) {
        let (a, g) = x.split_at(f);
        for i in 0..f {
            out[i].write(a[i] * g[i] * math::normal(g[i]).0);
        }
    }
}

/// Turns `x` into its gradient, and adds to that of its bias. gelu(g) = g P(g), so gelu'(g) = P(g) + g p(g).
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
fn geglu_rows_backward(x: &mut [f32], grad: &[f32], d_bias: &mut [f32], f: usize) {
    // Lengths that the compiler knows to be the same: what is checked number by number is not computed in vectors.
    let (a_bias, g_bias) = d_bias[..2 * f].split_at_mut(f);
    for (x, grad) in x.chunks_exact_mut(2 * f).zip(grad.chunks_exact(f)) {
        let (a, g) = x.split_at_mut(f);
        for i in 0..f {
            let (cumulative, density) = math::normal(g[i]);
            let da = grad[i] * g[i] * cumulative;
            let dg = grad[i] * a[i] * (cumulative + g[i] * density);
            a_bias[i] += da;
            g_bias[i] += dg;
            (a[i], g[i]) = (da, dg);
        }
    }
}

pub fn geglu(x: FlexTensor) -> FlexTensor {
    let x = contiguous(x);
    let [b, t, f2] = dims(&x);
    let f = f2 / 2;
    let xs = values(&x);
    // SAFETY: `geglu_rows` writes whole rows, as many as there are of `x`.
    let out = unsafe {
        written(b * t * f, |out| {
            out.par_chunks_mut(ROWS * f).zip(xs.par_chunks(ROWS * f2)).for_each(|(out, x)| geglu_rows(x, out, f));
        })
    };
    tensor(out, &[b, t, f])
}

/// Gradients of `x` and of its bias.
pub fn geglu_backward(x: FlexTensor, grad: FlexTensor) -> [FlexTensor; 2] {
    let grad = contiguous(grad);
    let shape @ [_, _, f2] = dims(&x);
    let f = f2 / 2;
    let mut dx = into_values(x);
    let grads = values(&grad);
    let sums = pieces(&mut dx, shape, |_, row, x| {
        let mut d_bias = vec![0f32; f2];
        geglu_rows_backward(x, &grads[row * f..][..x.len() / 2], &mut d_bias, f);
        d_bias
    });
    [tensor(dx, &shape), bias(sums.into_iter().flatten(), f2)]
}
