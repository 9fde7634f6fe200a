//! The same products by vectors of bf16.

use std::arch::x86_64::{
    __m512bh, __m512i, _mm512_dpbf16_ps, _mm512_load_si512, _mm512_loadu_ps, _mm512_set1_epi32, _mm512_setzero_ps,
    _mm512_storeu_ps,
};

use super::{LINES, SIDE, Tile};

/// Rows whose sums are in registers at once, two vectors each.
const ROWS: usize = 8;

/// # Safety
/// The CPU must have 512-bit vectors.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
#[inline]
unsafe fn bf16(x: __m512i) -> __m512bh {
    // SAFETY: only the type changes; both are 512 bits.
    unsafe { std::mem::transmute::<__m512i, __m512bh>(x) }
}

/// 32 x 32 results from one strip of each operand; `from` is what to start from, or null.
///
/// # Safety
/// The CPU must have the instructions, `left` and `right` must be valid for `2 steps` tiles, `from` and `out` for 32 rows
/// of 32 numbers.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
pub unsafe fn block(
    steps: usize,
    left: *const Tile,
    right: *const Tile,
    from: *const f32,
    from_stride: usize,
    out: *mut f32,
    stride: usize,
) {
    // No closures in here: one that is not inlined, as without LTO between a crate's own parts, costs more than a product.
    for first in (0..SIDE).step_by(ROWS) {
        let mut sums = [[_mm512_setzero_ps(); 2]; ROWS];
        if !from.is_null() {
            for (i, sums) in sums.iter_mut().enumerate() {
                // SAFETY: a row of what to start from.
                *sums = unsafe {
                    let row = from.add((first + i) * from_stride);
                    [_mm512_loadu_ps(row), _mm512_loadu_ps(row.add(16))]
                };
            }
        }
        for step in 0..steps {
            // SAFETY: tiles of this step; each has 16 rows of 16 pairs, aligned to 64 bytes.
            unsafe {
                let rows = (*left.add(2 * step + first / LINES)).0.as_ptr().add(first % LINES * 16);
                let (left_half, right_half) =
                    (right.add(2 * step).cast::<u32>(), right.add(2 * step + 1).cast::<u32>());
                for q in 0..16 {
                    let a = bf16(_mm512_load_si512(left_half.add(16 * q).cast()));
                    let b = bf16(_mm512_load_si512(right_half.add(16 * q).cast()));
                    for (i, sums) in sums.iter_mut().enumerate() {
                        let row = bf16(_mm512_set1_epi32((*rows.add(16 * i + q)).cast_signed()));
                        sums[0] = _mm512_dpbf16_ps(sums[0], row, a);
                        sums[1] = _mm512_dpbf16_ps(sums[1], row, b);
                    }
                }
            }
        }
        for (i, sums) in sums.iter().enumerate() {
            // SAFETY: a row of the result.
            unsafe {
                let row = out.add((first + i) * stride);
                _mm512_storeu_ps(row, sums[0]);
                _mm512_storeu_ps(row.add(16), sums[1]);
            }
        }
    }
}
