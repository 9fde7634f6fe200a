//! Attention of one head with its products on tiles; what is between them, and all sums, in f32.

use multiversion::multiversion;

use super::{
    super::{
        head::{Saved, Sizes, Weights, gather, gather_backward, softmax_rows},
        math,
        matrix::Matrix,
    },
    Destination, SIDE, Start, Tile, Unit,
    pack::{Lines, tiles},
    with_tiles,
};

/// Keys whose scores exist at once in the gradient.
const KEYS: usize = 2 * SIDE;

/// All of `[rows, columns] = start + left right`, operands packed `steps` deep.
///
/// # Safety
/// As of [`Unit::multiply`], for all of the result.
unsafe fn multiply(unit: &Unit, steps: usize, left: &[Tile], right: &[Tile], start: Start, place: Destination) {
    let Destination { out, stride, rows, columns } = place;
    for j in 0..columns.div_ceil(SIDE) {
        for i in 0..rows.div_ceil(SIDE) {
            let strip = |tiles: &'_ [Tile], i: usize| -> std::ops::Range<usize> {
                debug_assert!(2 * steps * (i + 1) <= tiles.len());
                2 * steps * i..2 * steps * (i + 1)
            };
            let (row, column) = (i * SIDE, j * SIDE);
            let (rows, columns) = (SIDE.min(rows - row), SIDE.min(columns - column));
            // SAFETY: the caller's promise for this part of the result.
            unsafe {
                let out = out.add(row * stride + column);
                let place = Destination { out, stride, rows, columns };
                unit.multiply(&left[strip(left, i)], &right[strip(right, j)], start, place);
            }
        }
    }
}

/// The same into a buffer of ours, whose rows are whole strips wide.
fn product(unit: &Unit, steps: usize, left: &[Tile], right: &[Tile], out: &mut [f32], rows: usize, columns: usize) {
    let stride = columns.next_multiple_of(SIDE);
    assert!(out.len() >= rows * stride);
    let place = Destination { out: out.as_mut_ptr(), stride, rows, columns: stride };
    // SAFETY: exclusively borrowed.
    unsafe { multiply(unit, steps, left, right, Start::Zeros, place) }
}

/// The same as `super::super::attention::head_forward`.
///
/// # Safety
/// As there.
pub unsafe fn head_forward(
    rows: &[f32],
    weights: Option<Weights<'_>>,
    sizes: Sizes,
    head: usize,
    out: *mut f32,
    log_sum: &mut [f32],
) {
    let Sizes { tokens, queries, width, .. } = sizes;
    let stride = 3 * sizes.d();
    let (wide, long) = (width.next_multiple_of(SIDE), tokens.next_multiple_of(SIDE));
    let mut k = vec![0f32; tokens * width];
    gather(&rows[sizes.column(1, head)..], stride, weights.map(|w| w[1]), 1.0, width, &mut k);
    let k = Lines::right(Matrix::rows(&k, width).transposed(), width, tokens);
    let v = Lines::right(Matrix::rows(&rows[sizes.column(2, head)..], stride), tokens, width);
    let mut q = [0f32; SIDE].repeat(width);
    let mut scores = vec![0f32; SIDE * long];
    let mut mixed = vec![0f32; SIDE * wide];
    let mut inverse_sum = [0f32; SIDE];
    let unit = Unit::new();
    let counts = [tiles(tokens, width), tiles(width, tokens), tiles(SIDE, width), tiles(SIDE, tokens)];
    with_tiles(counts.iter().sum(), |buffer| {
        let [k_tiles, v_tiles, q_tiles, p_tiles] = split(buffer, counts);
        k.pack(k_tiles);
        v.pack(v_tiles);
        for first in (0..queries).step_by(SIDE) {
            let n = SIDE.min(queries - first);
            let start = (tokens - queries + first) * stride + sizes.column(0, head);
            let factor = (width as f32).sqrt().recip();
            gather(&rows[start..], stride, weights.map(|w| w[0]), factor, width, &mut q[..n * width]);
            Lines::left(Matrix::rows(&q, width), n, width).pack(q_tiles);
            product(&unit, k.steps(), q_tiles, k_tiles, &mut scores, n, tokens);
            softmax_rows(&mut scores[..n * long], long, tokens, &mut inverse_sum, &mut log_sum[first..first + n]);
            Lines::left(Matrix::rows(&scores, long), n, tokens).pack(p_tiles);
            product(&unit, v.steps(), p_tiles, v_tiles, &mut mixed, n, width);
            for (i, row) in mixed.chunks_exact(wide).enumerate().take(n) {
                // SAFETY: a row of `out`, by the caller's promise.
                let out = unsafe { std::slice::from_raw_parts_mut(out.add((first + i) * sizes.d()), width) };
                out.iter_mut().zip(row).for_each(|(out, x)| *out = x * inverse_sum[i]);
            }
        }
    });
}

/// The same as `super::super::attention::head_backward`, by keys instead of queries: everything about a key's row is then
/// complete at once, and sums over queries go along the depth of a product.
///
/// # Safety
/// As there.
pub unsafe fn head_backward(
    saved: Saved<'_>,
    weights: Option<Weights<'_>>,
    sizes: Sizes,
    head: usize,
    d_rows: *mut f32,
) -> (Vec<f32>, Vec<f32>) {
    let Sizes { tokens, queries, width, .. } = sizes;
    let (mut d_wq, mut d_wk) = (vec![0f32; width], vec![0f32; width]);
    if queries == 0 {
        return (d_wq, d_wk);
    }
    let (d, stride) = (sizes.d(), 3 * sizes.d());
    let (wide, long) = (width.next_multiple_of(SIDE), queries.next_multiple_of(SIDE));
    let factor = (width as f32).sqrt().recip();
    let q_rows = &saved.rows[(tokens - queries) * stride + sizes.column(0, head)..];
    let k_rows = &saved.rows[sizes.column(1, head)..];
    let (mut q, mut k) = (vec![0f32; queries * width], vec![0f32; tokens * width]);
    gather(q_rows, stride, weights.map(|w| w[0]), factor, width, &mut q);
    gather(k_rows, stride, weights.map(|w| w[1]), 1.0, width, &mut k);
    let (q, k) = (Matrix::rows(&q, width), Matrix::rows(&k, width));
    let v = Matrix::rows(&saved.rows[sizes.column(2, head)..], stride);
    let g = Matrix::rows(&saved.grad[head * width..], d);
    let delta: Vec<f32> = (0..queries)
        .map(|i| {
            let part = i * d + head * width..i * d + (head + 1) * width;
            math::sum2(&saved.out[part.clone()], &saved.grad[part], |o, g| o * g)
        })
        .collect();

    let (mut p, mut dp) = (vec![0f32; KEYS * long], vec![0f32; KEYS * long]);
    let mut dk = vec![0f32; tokens * width];
    let mut dq_across = vec![0f32; wide * long]; // [width, queries]
    let unit = Unit::new();
    let (at_depth, across) = (tiles(queries, width), tiles(width, queries));
    let (keys, scores) = (tiles(KEYS, width), tiles(KEYS, queries));
    let counts = [at_depth, at_depth, across, across, keys, keys, keys, scores, scores];
    with_tiles(counts.iter().sum(), |buffer| {
        let [q_deep, g_deep, q_across, g_across, k_tiles, v_tiles, k_across, left, right] = split(buffer, counts);
        Lines::right(q.transposed(), width, queries).pack(q_deep);
        Lines::right(g.transposed(), width, queries).pack(g_deep);
        Lines::right(q, queries, width).pack(q_across);
        Lines::right(g, queries, width).pack(g_across);
        let (inner, outer) = (width.div_ceil(SIDE), queries.div_ceil(SIDE));
        for first in (0..tokens).step_by(KEYS) {
            let n = KEYS.min(tokens - first);
            let (k, v) = (k.below(first), v.below(first));
            Lines::left(k, n, width).pack(k_tiles);
            Lines::left(v, n, width).pack(v_tiles);
            product(&unit, inner, k_tiles, q_deep, &mut p, n, queries);
            product(&unit, inner, v_tiles, g_deep, &mut dp, n, queries);
            score_gradients(&mut p, &mut dp, n, long, saved.log_sum, &delta);
            let into = |tiles: &[Tile], right: &[Tile], out: *mut f32, stride: usize| {
                let place = Destination { out, stride, rows: n, columns: width };
                // SAFETY: rows of `dk`, or this head's columns of values by the caller's promise.
                unsafe { multiply(&unit, outer, tiles, right, Start::Zeros, place) }
            };
            Lines::left(Matrix::rows(&p, long), n, queries).pack(left);
            // SAFETY: within `d_rows`.
            into(left, g_across, unsafe { d_rows.add(first * stride + sizes.column(2, head)) }, stride);
            let ds = Matrix::rows(&dp, long);
            Lines::left(ds, n, queries).pack(left);
            into(left, q_across, dk[first * width..].as_mut_ptr(), width);
            // The queries' gradient is summed over keys: transposed, since that is how its operands lie.
            Lines::left(k.transposed(), width, n).pack(k_across);
            Lines::right(ds, n, queries).pack(right);
            let place = Destination { out: dq_across.as_mut_ptr(), stride: long, rows: wide, columns: long };
            let start = if first > 0 { Start::Result } else { Start::Zeros };
            // SAFETY: all of `dq_across`, which is ours.
            unsafe { multiply(&unit, n.div_ceil(SIDE), k_across, right, start, place) };
        }
    });
    drop(unit);

    let mut dq = vec![0f32; queries * width];
    for (i, row) in dq.chunks_exact_mut(width).enumerate() {
        row.iter_mut().enumerate().for_each(|(j, x)| *x = dq_across[j * long + i]);
    }
    gather_backward(q_rows, stride, weights.map(|w| w[0]), factor, &mut dq, &mut d_wq);
    gather_backward(k_rows, stride, weights.map(|w| w[1]), 1.0, &mut dk, &mut d_wk);
    // SAFETY: this head's columns of queries and keys, by the caller's promise.
    unsafe {
        sizes.store(&dq, tokens - queries, sizes.column(0, head), d_rows);
        sizes.store(&dk, 0, sizes.column(1, head), d_rows);
    }
    (d_wq, d_wk)
}

/// Scores of `n` keys (rows) become probabilities p, and `dp` the scores' gradients p (dp - delta).
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma"))]
fn score_gradients(scores: &mut [f32], dp: &mut [f32], n: usize, stride: usize, log_sum: &[f32], delta: &[f32]) {
    for (p, dp) in scores.chunks_exact_mut(stride).zip(dp.chunks_exact_mut(stride)).take(n) {
        let columns = p.iter_mut().zip(dp).zip(log_sum.iter().zip(delta));
        for ((p, dp), (log_sum, delta)) in columns {
            *p = math::exp(*p - log_sum);
            *dp = *p * (*dp - delta);
        }
    }
}

/// Cuts a buffer into parts of these lengths.
fn split<const N: usize>(mut tiles: &mut [Tile], counts: [usize; N]) -> [&mut [Tile]; N] {
    counts.map(|n| {
        let (part, rest) = std::mem::take(&mut tiles).split_at_mut(n);
        tiles = rest;
        part
    })
}
