//! Modulated layer norm, gated residual, GEGLU: each one pass over memory, rows in parallel.

use burn::backend::flex::FlexTensor;
use multiversion::multiversion;
use rayon::prelude::*;

use super::{contiguous, dims, math, tensor, values};
use crate::ops::EPS;

/// Rows per piece of work; fixed, so that sums do not depend on the number of threads.
const ROWS: usize = 32;

/// Calls `f(first row, rows of out)` for pieces of `ROWS` rows that do not cross batch elements, in parallel, and
/// collects what it returns: `[b][pieces per batch element]`.
fn pieces<R: Send>(
    out: &mut [f32],
    [b, t, width]: [usize; 3],
    f: impl Fn(usize, usize, &mut [f32]) -> R + Sync,
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

/// Mean and reciprocal standard deviation of a row.
#[inline(always)]
fn statistics(row: &[f32]) -> (f32, f32) {
    let n = row.len() as f32;
    let mean = math::sum(row, |x| x) / n;
    let variance = math::sum(row, |x| (x - mean) * (x - mean)) / n;
    (mean, 1.0 / (variance + EPS).sqrt())
}

#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
fn norm_rows(x: &[f32], shift: &[f32], scale: &[f32], out: &mut [f32]) {
    let width = shift.len();
    for (x, out) in x.chunks_exact(width).zip(out.chunks_exact_mut(width)) {
        let (mean, inverse) = statistics(x);
        for (((out, x), shift), scale) in out.iter_mut().zip(x).zip(shift).zip(scale) {
            *out = (x - mean) * inverse * (1.0 + scale) + shift;
        }
    }
}

/// Writes the gradient of `x`, adds to those of shift and scale. With y = (x - mean) / deviation and h = grad (1 +
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
            dx[i] = (h[i] - mean_h - (x[i] - mean) * inverse * mean_hy) * inverse;
        }
    }
}

pub fn modulated_norm(x: FlexTensor, shift: FlexTensor, scale: FlexTensor) -> FlexTensor {
    let (x, shift, scale) = (contiguous(x), contiguous(shift), contiguous(scale));
    let shape @ [_, _, d] = dims(&x);
    let (xs, shifts, scales) = (values(&x), values(&shift), values(&scale));
    let mut out = vec![0f32; xs.len()];
    pieces(&mut out, shape, |batch, row, out| {
        let m = batch * d..(batch + 1) * d;
        norm_rows(&xs[row * d..][..out.len()], &shifts[m.clone()], &scales[m], out);
    });
    tensor(out, &shape)
}

pub fn modulated_norm_backward(x: FlexTensor, scale: FlexTensor, grad: FlexTensor) -> [FlexTensor; 3] {
    let (x, scale, grad) = (contiguous(x), contiguous(scale), contiguous(grad));
    let shape @ [_, _, d] = dims(&x);
    let (xs, scales, grads) = (values(&x), values(&scale), values(&grad));
    let mut dx = vec![0f32; xs.len()];
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
fn gated_rows(x: &[f32], gate: &[f32], y: &[f32], out: &mut [f32]) {
    let width = gate.len();
    let rows = x.chunks_exact(width).zip(y.chunks_exact(width)).zip(out.chunks_exact_mut(width));
    for ((x, y), out) in rows {
        for i in 0..width {
            out[i] = x[i] + gate[i] * y[i];
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
fn gated_rows_backward(gate: &[f32], y: &[f32], grad: &[f32], dy: &mut [f32], d_gate: &mut [f32]) {
    let width = gate.len();
    let rows = y.chunks_exact(width).zip(grad.chunks_exact(width)).zip(dy.chunks_exact_mut(width));
    for ((y, grad), dy) in rows {
        for i in 0..width {
            dy[i] = gate[i] * grad[i];
            d_gate[i] += y[i] * grad[i];
        }
    }
}

pub fn gated_add(x: FlexTensor, gate: FlexTensor, y: FlexTensor) -> FlexTensor {
    let (x, gate, y) = (contiguous(x), contiguous(gate), contiguous(y));
    let shape @ [_, _, d] = dims(&x);
    let (xs, gates, ys) = (values(&x), values(&gate), values(&y));
    let mut out = vec![0f32; xs.len()];
    pieces(&mut out, shape, |batch, row, out| {
        let part = row * d..row * d + out.len();
        gated_rows(&xs[part.clone()], &gates[batch * d..][..d], &ys[part], out);
    });
    tensor(out, &shape)
}

pub fn gated_add_backward(gate: FlexTensor, y: FlexTensor, grad: FlexTensor) -> [FlexTensor; 2] {
    let (gate, y, grad) = (contiguous(gate), contiguous(y), contiguous(grad));
    let shape @ [_, _, d] = dims(&y);
    let (gates, ys, grads) = (values(&gate), values(&y), values(&grad));
    let mut dy = vec![0f32; ys.len()];
    let d_gate = pieces(&mut dy, shape, |batch, row, dy| {
        let mut d_gate = vec![0f32; d];
        let part = row * d..row * d + dy.len();
        gated_rows_backward(&gates[batch * d..][..d], &ys[part.clone()], &grads[part], dy, &mut d_gate);
        d_gate
    });
    [total(d_gate, d), tensor(dy, &shape)]
}

#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
fn geglu_rows(x: &[f32], out: &mut [f32], f: usize) {
    for (x, out) in x.chunks_exact(2 * f).zip(out.chunks_exact_mut(f)) {
        let (a, g) = x.split_at(f);
        for i in 0..f {
            out[i] = a[i] * g[i] * math::normal(g[i]).0;
        }
    }
}

/// gelu(g) = g P(g), so gelu'(g) = P(g) + g p(g).
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
fn geglu_rows_backward(x: &[f32], grad: &[f32], dx: &mut [f32], f: usize) {
    for ((x, grad), dx) in x.chunks_exact(2 * f).zip(grad.chunks_exact(f)).zip(dx.chunks_exact_mut(2 * f)) {
        let (a, g) = x.split_at(f);
        let (da, dg) = dx.split_at_mut(f);
        for i in 0..f {
            let (cumulative, density) = math::normal(g[i]);
            da[i] = grad[i] * g[i] * cumulative;
            dg[i] = grad[i] * a[i] * (cumulative + g[i] * density);
        }
    }
}

pub fn geglu(x: FlexTensor) -> FlexTensor {
    let x = contiguous(x);
    let [b, t, f2] = dims(&x);
    let f = f2 / 2;
    let xs = values(&x);
    let mut out = vec![0f32; b * t * f];
    out.par_chunks_mut(ROWS * f).zip(xs.par_chunks(ROWS * f2)).for_each(|(out, x)| geglu_rows(x, out, f));
    tensor(out, &[b, t, f])
}

pub fn geglu_backward(x: FlexTensor, grad: FlexTensor) -> FlexTensor {
    let (x, grad) = (contiguous(x), contiguous(grad));
    let shape @ [_, _, f2] = dims(&x);
    let f = f2 / 2;
    let mut dx = vec![0f32; values(&x).len()];
    dx.par_chunks_mut(ROWS * f2)
        .zip(values(&x).par_chunks(ROWS * f2).zip(values(&grad).par_chunks(ROWS * f)))
        .for_each(|(dx, (x, grad))| geglu_rows_backward(x, grad, dx, f));
    tensor(dx, &shape)
}
