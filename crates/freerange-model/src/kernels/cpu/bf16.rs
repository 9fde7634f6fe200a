//! Matrix products of bf16 numbers with f32 sums, for CPUs with AVX-512 BF16: twice the rate of f32.
//!
//! Operands are rounded while they are packed. The scheme is Goto and van de Geijn's (2008): a block of `b` as wide as
//! the result stays packed for all threads, each thread packs a few rows of `a`, and a kernel of 12 x 32 results runs
//! over both. One instruction multiplies pairs along `k`, so packed values are pairs in a `u32`, the even `k` low.

use rayon::prelude::*;

use super::{Shared, linear::Matrix};

/// Rows of the kernel.
const ROWS: usize = 12;
/// Columns of the kernel: two vectors of 16.
const COLUMNS: usize = 32;
/// Depth of a packed block; even.
const DEPTH: usize = 512;
/// Rows per piece of work; a multiple of `ROWS`.
const PIECE: usize = 96;

/// Whether this CPU has the instructions.
#[cfg(target_arch = "x86_64")]
pub fn available() -> bool {
    is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512bw")
        && is_x86_feature_detected!("avx512bf16")
}

/// Whether this CPU has the instructions.
#[cfg(not(target_arch = "x86_64"))]
pub fn available() -> bool {
    false
}

/// Two numbers rounded to the nearest bf16, ties to even, `low` in the lower half.
#[inline(always)]
fn pair(low: f32, high: f32) -> u32 {
    let round = |x: f32| {
        let bits = x.to_bits();
        bits.wrapping_add(0x7fff + ((bits >> 16) & 1))
    };
    (round(low) >> 16) | (round(high) & 0xffff_0000)
}

/// Packs `n` lines (rows of `a`, columns of `b`) of `depth` numbers as `[pairs][W]`, missing ones as zeros. Line `i`
/// at depth `k` is `data[i * line_stride + k * depth_stride]`; one of the strides is 1.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma"))]
fn pack<const W: usize>(
    data: &[f32],
    line_stride: usize,
    depth_stride: usize,
    n: usize,
    depth: usize,
    out: &mut [u32],
) {
    if line_stride == 1 {
        for (q, out) in out.chunks_exact_mut(W).enumerate() {
            let low = &data[2 * q * depth_stride..][..n];
            let high = if 2 * q + 1 < depth { &data[(2 * q + 1) * depth_stride..][..n] } else { &[0.0; W][..n] };
            if n == W {
                for i in 0..W {
                    out[i] = pair(low[i], high[i]);
                }
            } else {
                out.fill(0);
                for i in 0..n {
                    out[i] = pair(low[i], high[i]);
                }
            }
        }
        return;
    }
    assert_eq!(depth_stride, 1, "one axis is contiguous");
    if n < W {
        out.fill(0);
    }
    for i in 0..n {
        let (chunks, rest) = data[i * line_stride..][..depth].as_chunks::<32>();
        let mut place = |numbers: &[f32; 32], first: usize, pairs: usize| {
            let mut packed = [0u32; 16];
            for q in 0..16 {
                packed[q] = pair(numbers[2 * q], numbers[2 * q + 1]);
            }
            for q in 0..pairs {
                out[(first + q) * W + i] = packed[q];
            }
        };
        for (j, chunk) in chunks.iter().enumerate() {
            place(chunk, 16 * j, 16);
        }
        if !rest.is_empty() {
            let mut padded = [0f32; 32];
            padded[..rest.len()].copy_from_slice(rest);
            place(&padded, 16 * chunks.len(), rest.len().div_ceil(2));
        }
    }
}

/// `out = (add ? out : 0) + a b`, where `a` is `[m, k]`, `b` `[k, n]` and `out` `[m, n]`, rounded to bf16 but for `out`.
/// Only where [`available`].
#[cfg(target_arch = "x86_64")]
pub fn product([m, k, n]: [usize; 3], a: Matrix, b: Matrix, out: &mut [f32], add: bool) {
    assert!(available() && a.holds(m, k) && b.holds(k, n) && out.len() == m * n, "matrix product out of bounds");
    let target = Shared(out.as_mut_ptr());
    let panels = n.div_ceil(COLUMNS);
    let mut packed_b = vec![0u32; panels * COLUMNS * DEPTH.min(k).div_ceil(2)];
    for first in (0..k).step_by(DEPTH) {
        let depth = DEPTH.min(k - first);
        let pairs = depth.div_ceil(2);
        let packed_b = &mut packed_b[..panels * COLUMNS * pairs];
        packed_b.par_chunks_mut(COLUMNS * pairs).enumerate().for_each(|(panel, out)| {
            let data = &b.data[first * b.row_stride + panel * COLUMNS * b.column_stride..];
            let columns = COLUMNS.min(n - panel * COLUMNS);
            pack::<COLUMNS>(data, b.column_stride, b.row_stride, columns, depth, out);
        });
        let packed_b = &*packed_b;
        let scratch = || vec![0u32; PIECE * DEPTH / 2];
        (0..m.div_ceil(PIECE)).into_par_iter().for_each_init(scratch, |packed_a, piece| {
            let top = piece * PIECE;
            let rows = PIECE.min(m - top);
            let tiles = rows.div_ceil(ROWS);
            let packed_a = &mut packed_a[..tiles * ROWS * pairs];
            for (tile, out) in packed_a.chunks_exact_mut(ROWS * pairs).enumerate() {
                let data = &a.data[(top + tile * ROWS) * a.row_stride + first * a.column_stride..];
                pack::<ROWS>(data, a.row_stride, a.column_stride, ROWS.min(rows - tile * ROWS), depth, out);
            }
            for (panel, b) in packed_b.chunks_exact(COLUMNS * pairs).enumerate() {
                let columns = COLUMNS.min(n - panel * COLUMNS);
                for (tile, a) in packed_a.chunks_exact(ROWS * pairs).enumerate() {
                    let offset = (top + tile * ROWS) * n + panel * COLUMNS;
                    let size = [ROWS.min(rows - tile * ROWS), columns];
                    // SAFETY: the instructions exist; this task alone writes these rows, all within `out`.
                    unsafe { kernel(a, b, target.at(offset), n, size, add || first > 0) };
                }
            }
        });
    }
}

/// One tile: `out` (at most 12 x 32, rows `stride` apart) `= (add ? out : 0) + a b`, operands as packed.
///
/// # Safety
/// The CPU must have the instructions, and `out` must be valid for `rows` rows of `columns` values that nothing else
/// touches.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn kernel(a: &[u32], b: &[u32], out: *mut f32, stride: usize, [rows, columns]: [usize; 2], add: bool) {
    use std::arch::x86_64::{
        __m512bh, __m512i, _mm512_add_ps, _mm512_dpbf16_ps, _mm512_loadu_si512, _mm512_mask_storeu_ps,
        _mm512_maskz_loadu_ps, _mm512_set1_epi32, _mm512_setzero_ps,
    };
    // SAFETY: only the type changes; both are 512 bits.
    let bf16 = |x: __m512i| unsafe { std::mem::transmute::<__m512i, __m512bh>(x) };
    let mut sums = [[_mm512_setzero_ps(); 2]; ROWS];
    for (a, b) in a.as_chunks::<ROWS>().0.iter().zip(b.as_chunks::<COLUMNS>().0) {
        // SAFETY: each load is one half of the array.
        let (left, right) = unsafe {
            (bf16(_mm512_loadu_si512(b.as_ptr().cast())), bf16(_mm512_loadu_si512(b.as_ptr().add(16).cast())))
        };
        for i in 0..ROWS {
            let row = bf16(_mm512_set1_epi32(a[i].cast_signed()));
            sums[i][0] = _mm512_dpbf16_ps(sums[i][0], row, left);
            sums[i][1] = _mm512_dpbf16_ps(sums[i][1], row, right);
        }
    }
    let mask = |n: usize| if n >= 16 { u16::MAX } else { (1 << n) - 1 };
    let masks = [mask(columns), mask(columns.saturating_sub(16))];
    for (i, sums) in sums.iter().enumerate().take(rows) {
        for (half, &sum) in sums.iter().enumerate() {
            // SAFETY: masked to columns of this row within the caller's promise; a pointer beyond them is not read.
            unsafe {
                let place = out.add(i * stride).wrapping_add(16 * half);
                let before = if add { _mm512_maskz_loadu_ps(masks[half], place) } else { _mm512_setzero_ps() };
                _mm512_mask_storeu_ps(place, masks[half], _mm512_add_ps(before, sum));
            }
        }
    }
}

/// Never called: [`available`] says no.
#[cfg(not(target_arch = "x86_64"))]
pub fn product(_: [usize; 3], _: Matrix, _: Matrix, _: &mut [f32], _: bool) {
    unreachable!("this CPU has no bf16 products")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounding_is_to_nearest_even() {
        for (x, expected) in
            [(1.0f32, 0x3f80), (1.0 + 1.0 / 256.0, 0x3f80), (1.0 + 3.0 / 256.0, 0x3f82), (-2.0, 0xc000)]
        {
            assert_eq!(pair(x, 0.0), expected);
            assert_eq!(pair(0.0, x), expected << 16);
        }
    }
}
