//! Self-attention with or without RMS norm of queries and keys, one head of one image at a time.
//!
//! Scores exist only for a few query rows at once, and the gradient computes them again from the stored log of each
//! softmax's denominator (the FlashAttention-2 scheme), so memory is linear in the number of tokens.

use burn::backend::flex::FlexTensor;
use gemm::Parallelism;
use multiversion::multiversion;
use rayon::prelude::*;

use super::{
    Shared, contiguous, dims,
    head::{Saved, Sizes, Weights, gather, gather_backward, scale_row, softmax_rows},
    math,
    matrix::{Matrix, matmul},
    tensor, values,
};

/// Query rows whose scores exist at once.
const ROWS: usize = 64;

/// Scores to probabilities.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
fn probabilities(scores: &mut [f32], tokens: usize, log_sum: &[f32]) {
    for (row, log_sum) in scores.chunks_exact_mut(tokens).zip(log_sum) {
        for s in row.iter_mut() {
            *s = math::exp(*s - log_sum);
        }
    }
}

/// Softmax backward: `dp` becomes p (dp - delta).
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
fn score_gradients(p: &[f32], dp: &mut [f32], tokens: usize, delta: &[f32]) {
    for ((p, dp), delta) in p.chunks_exact(tokens).zip(dp.chunks_exact_mut(tokens)).zip(delta) {
        for (dp, p) in dp.iter_mut().zip(p) {
            *dp = p * (*dp - delta);
        }
    }
}

fn weights(norms: &[FlexTensor; 2]) -> Weights<'_> {
    [values(&norms[0]), values(&norms[1])]
}

/// [`head_forward`].
type Forward = unsafe fn(&[f32], Option<Weights<'_>>, Sizes, usize, *mut f32, &mut [f32]);
/// [`head_backward`].
type Backward = unsafe fn(Saved<'_>, Option<Weights<'_>>, Sizes, usize, *mut f32) -> (Vec<f32>, Vec<f32>);

/// In bf16 where asked for and the CPU has the instructions.
fn by_head(bf16: bool) -> (Forward, Backward) {
    match bf16 {
        #[cfg(target_arch = "x86_64")]
        true if super::tiles::available() => (super::tiles::head_forward, super::tiles::head_backward),
        _ => (head_forward, head_backward),
    }
}

/// See [`crate::kernels::Kernels::attention_forward`].
pub fn forward(
    qkv: FlexTensor,
    norms: Option<[FlexTensor; 2]>,
    heads: usize,
    queries: usize,
    bf16: bool,
) -> (FlexTensor, FlexTensor) {
    let (qkv, norms) = (contiguous(qkv), norms.map(|norms| norms.map(contiguous)));
    let [b, tokens, d3] = dims(&qkv);
    let sizes = Sizes { tokens, queries, heads, width: d3 / 3 / heads };
    let d = sizes.d();
    assert!(d * 3 == d3 && queries <= tokens, "attention: heads and queries fit the tokens");
    let (xs, weights) = (values(&qkv), norms.as_ref().map(weights));
    let mut out = Vec::with_capacity(b * queries * d);
    let mut log_sum = vec![0f32; b * heads * queries];
    let target = Shared(out.as_mut_ptr());
    let (head_forward, _) = by_head(bf16);
    log_sum.par_chunks_mut(queries.max(1)).enumerate().for_each(|(task, log_sum)| {
        let (batch, head) = (task / heads, task % heads);
        let rows = &xs[batch * tokens * d3..][..tokens * d3];
        // SAFETY: this task alone writes this image's rows at this head's columns, all within `out`.
        unsafe {
            let out = target.at(batch * queries * d + head * sizes.width);
            head_forward(rows, weights, sizes, head, out, log_sum);
        }
    });
    // SAFETY: every head of every image has written its columns of all rows.
    unsafe { out.set_len(b * queries * d) };
    (tensor(out, &[b, queries, d]), tensor(log_sum, &[b, heads, queries]))
}

/// # Safety
/// `out` must be valid for `queries` rows of `width` values, `d` apart, that nothing else touches.
unsafe fn head_forward(
    rows: &[f32],
    weights: Option<Weights<'_>>,
    sizes: Sizes,
    head: usize,
    out: *mut f32,
    log_sum: &mut [f32],
) {
    let Sizes { tokens, queries, width, .. } = sizes;
    let stride = 3 * sizes.d();
    let mut k = vec![0f32; tokens * width];
    gather(&rows[sizes.column(1, head)..], stride, weights.map(|w| w[1]), 1.0, width, &mut k);
    let v = Matrix::rows(&rows[sizes.column(2, head)..], stride);
    let mut q = vec![0f32; ROWS * width];
    let mut scores = vec![0f32; ROWS * tokens];
    let mut inverse_sum = [0f32; ROWS];
    for first in (0..queries).step_by(ROWS) {
        let n = ROWS.min(queries - first);
        let start = (tokens - queries + first) * stride + sizes.column(0, head);
        let factor = (width as f32).sqrt().recip();
        gather(&rows[start..], stride, weights.map(|w| w[0]), factor, width, &mut q[..n * width]);
        let (q, k) = (Matrix::rows(&q, width), Matrix::rows(&k, width).transposed());
        // SAFETY: `scores` is ours; the rows of `out` are by the caller's promise.
        unsafe {
            matmul([n, width, tokens], q, k, 1.0, scores.as_mut_ptr(), tokens, false, Parallelism::None);
            softmax_rows(&mut scores[..n * tokens], tokens, tokens, &mut inverse_sum, &mut log_sum[first..first + n]);
            let out = out.add(first * sizes.d());
            let p = Matrix::rows(&scores, tokens);
            matmul([n, tokens, width], p, v, 1.0, out, sizes.d(), false, Parallelism::None);
            for i in 0..n {
                scale_row(std::slice::from_raw_parts_mut(out.add(i * sizes.d()), width), inverse_sum[i]);
            }
        }
    }
}

/// See [`crate::kernels::Kernels::attention_backward`].
pub fn backward(
    qkv: FlexTensor,
    norms: Option<[FlexTensor; 2]>,
    out: FlexTensor,
    log_sum: FlexTensor,
    grad: FlexTensor,
    heads: usize,
    bf16: bool,
) -> (FlexTensor, Option<[FlexTensor; 2]>) {
    let (qkv, norms) = (contiguous(qkv), norms.map(|norms| norms.map(contiguous)));
    let (out, log_sum, grad) = (contiguous(out), contiguous(log_sum), contiguous(grad));
    let [b, tokens, d3] = dims(&qkv);
    let [_, queries, d] = dims(&out);
    let sizes = Sizes { tokens, queries, heads, width: d / heads };
    let (xs, weights) = (values(&qkv), norms.as_ref().map(weights));
    let (outs, log_sums, grads) = (values(&out), values(&log_sum), values(&grad));
    // Queries that are not asked for have no gradient; all else is written.
    let mut d_qkv = if queries == tokens { Vec::with_capacity(xs.len()) } else { vec![0f32; xs.len()] };
    let target = Shared(d_qkv.as_mut_ptr());
    let (_, head_backward) = by_head(bf16);
    let d_weights: Vec<_> = (0..b * heads)
        .into_par_iter()
        .map(|task| {
            let (batch, head) = (task / heads, task % heads);
            let saved = Saved {
                rows: &xs[batch * tokens * d3..][..tokens * d3],
                out: &outs[batch * queries * d..][..queries * d],
                grad: &grads[batch * queries * d..][..queries * d],
                log_sum: &log_sums[task * queries..][..queries],
            };
            // SAFETY: this task alone writes this image's rows at this head's columns, all within `d_qkv`.
            unsafe { head_backward(saved, weights, sizes, head, target.at(batch * tokens * d3)) }
        })
        .collect();
    // SAFETY: every head of every image has written its columns of all rows.
    unsafe { d_qkv.set_len(xs.len()) };
    let (mut d_wq, mut d_wk) = (vec![0f32; sizes.width], vec![0f32; sizes.width]);
    for (wq, wk) in &d_weights {
        math::add(&mut d_wq, wq);
        math::add(&mut d_wk, wk);
    }
    let d_norms = norms.map(|_| [tensor(d_wq, &[sizes.width]), tensor(d_wk, &[sizes.width])]);
    (tensor(d_qkv, &[b, tokens, d3]), d_norms)
}

/// Returns the gradients of both norm weights.
///
/// # Safety
/// `d_rows` must be valid for `tokens` rows of `3 d` values, of which nothing else touches this head's columns.
unsafe fn head_backward(
    saved: Saved<'_>,
    weights: Option<Weights<'_>>,
    sizes: Sizes,
    head: usize,
    d_rows: *mut f32,
) -> (Vec<f32>, Vec<f32>) {
    let Sizes { tokens, queries, width, .. } = sizes;
    let (d, stride) = (sizes.d(), 3 * sizes.d());
    let factor = (width as f32).sqrt().recip();
    let q_rows = &saved.rows[(tokens - queries) * stride + sizes.column(0, head)..];
    let k_rows = &saved.rows[sizes.column(1, head)..];
    let mut q = vec![0f32; queries * width];
    let mut k = vec![0f32; tokens * width];
    if queries > 0 {
        gather(q_rows, stride, weights.map(|w| w[0]), factor, width, &mut q);
    }
    gather(k_rows, stride, weights.map(|w| w[1]), 1.0, width, &mut k);
    let v = Matrix::rows(&saved.rows[sizes.column(2, head)..], stride);
    let (mut dq, mut dk) = (vec![0f32; queries * width], vec![0f32; tokens * width]);
    let (mut p, mut dp) = (vec![0f32; ROWS * tokens], vec![0f32; ROWS * tokens]);
    for first in (0..queries).step_by(ROWS) {
        let n = ROWS.min(queries - first);
        let head_part = |data: &'_ [f32], i: usize| -> std::ops::Range<usize> {
            let start = (first + i) * d + head * width;
            debug_assert!(start + width <= data.len());
            start..start + width
        };
        let delta: [f32; ROWS] = std::array::from_fn(|i| {
            if i >= n {
                return 0.0;
            }
            let part = head_part(saved.out, i);
            math::sum2(&saved.out[part.clone()], &saved.grad[part], |o, g| o * g)
        });
        let q = Matrix::rows(&q[first * width..], width);
        let k = Matrix::rows(&k, width);
        let g = Matrix::rows(&saved.grad[first * d + head * width..], d);
        let none = Parallelism::None;
        // SAFETY: all buffers but `d_rows` are ours; its columns of this head's values are by the caller's promise.
        unsafe {
            matmul([n, width, tokens], q, k.transposed(), 1.0, p.as_mut_ptr(), tokens, false, none);
            probabilities(&mut p[..n * tokens], tokens, &saved.log_sum[first..first + n]);
            let dv = d_rows.add(sizes.column(2, head));
            matmul([tokens, n, width], Matrix::rows(&p, tokens).transposed(), g, 1.0, dv, stride, first > 0, none);
            matmul([n, width, tokens], g, v.transposed(), 1.0, dp.as_mut_ptr(), tokens, false, none);
            score_gradients(&p[..n * tokens], &mut dp[..n * tokens], tokens, &delta);
            let ds = Matrix::rows(&dp, tokens);
            matmul([n, tokens, width], ds, k, 1.0, dq[first * width..].as_mut_ptr(), width, false, none);
            matmul([tokens, n, width], ds.transposed(), q, 1.0, dk.as_mut_ptr(), width, first > 0, none);
        }
    }
    let (mut d_wq, mut d_wk) = (vec![0f32; width], vec![0f32; width]);
    if queries > 0 {
        gather_backward(q_rows, stride, weights.map(|w| w[0]), factor, &mut dq, &mut d_wq);
    }
    gather_backward(k_rows, stride, weights.map(|w| w[1]), 1.0, &mut dk, &mut d_wk);
    // SAFETY: this head's columns, by the caller's promise.
    unsafe {
        sizes.store(&dq, tokens - queries, sizes.column(0, head), d_rows);
        sizes.store(&dk, 0, sizes.column(1, head), d_rows);
    }
    (d_wq, d_wk)
}
