//! Operands of the tile unit, packed.

use super::{super::matrix::Matrix, LINES, SIDE, Tile, available};

/// How many tiles so many lines of this depth take.
pub fn tiles(lines: usize, depth: usize) -> usize {
    2 * lines.div_ceil(SIDE) * depth.div_ceil(SIDE)
}

/// Which operand of a product.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operand {
    Left,
    Right,
}

/// The lines of an operand. Line `i` at depth `k` is `data[i * line_stride + k * depth_stride]`; one stride is 1.
#[derive(Clone, Copy)]
pub struct Lines<'a> {
    data: &'a [f32],
    line_stride: usize,
    depth_stride: usize,
    lines: usize,
    depth: usize,
    operand: Operand,
}

impl<'a> Lines<'a> {
    /// The rows of a left operand `[lines, depth]`.
    pub fn left(m: Matrix<'a>, lines: usize, depth: usize) -> Self {
        assert!(m.holds(lines, depth), "left operand out of bounds");
        Self::new(m.data, m.row_stride, m.column_stride, lines, depth, Operand::Left)
    }

    /// The columns of a right operand `[depth, lines]`.
    pub fn right(m: Matrix<'a>, depth: usize, lines: usize) -> Self {
        assert!(m.holds(depth, lines), "right operand out of bounds");
        Self::new(m.data, m.column_stride, m.row_stride, lines, depth, Operand::Right)
    }

    fn new(
        data: &'a [f32],
        line_stride: usize,
        depth_stride: usize,
        lines: usize,
        depth: usize,
        operand: Operand,
    ) -> Self {
        assert!(line_stride == 1 || depth_stride == 1 || data.is_empty(), "one axis is contiguous");
        Self { data, line_stride, depth_stride, lines, depth, operand }
    }

    pub fn strips(&self) -> usize {
        self.lines.div_ceil(SIDE)
    }

    pub fn steps(&self) -> usize {
        self.depth.div_ceil(SIDE)
    }

    /// Whether numbers along the depth lie next to each other.
    pub fn is_deep(&self) -> bool {
        self.depth_stride == 1
    }

    /// Packs one step of one strip.
    pub fn pack_step(&self, strip: usize, step: usize, out: &mut [Tile; 2]) {
        assert!(available(), "no tile unit");
        let depth = SIDE.min(self.depth - step * SIDE);
        for (half, out) in out.iter_mut().enumerate() {
            let first = strip * SIDE + half * LINES;
            let lines = LINES.min(self.lines.saturating_sub(first));
            let start = first * self.line_stride + step * SIDE * self.depth_stride;
            let data = self.data.as_ptr().wrapping_add(start);
            // SAFETY: the instructions exist; lines and depth from `data` lie within the slice, as the constructors checked.
            unsafe { self.pack_tile(data, lines, depth, out) }
        }
    }

    /// Packs everything, strip by strip.
    pub fn pack(&self, out: &mut [Tile]) {
        let steps = self.steps();
        let out = out.as_chunks_mut::<2>().0;
        if self.is_deep() {
            for (i, out) in out.iter_mut().enumerate().take(self.strips() * steps) {
                self.pack_step(i / steps, i % steps, out);
            }
        } else {
            for step in 0..steps {
                for strip in 0..self.strips() {
                    self.pack_step(strip, step, &mut out[strip * steps + step]);
                }
            }
        }
    }

    /// # Safety
    /// The CPU must have the instructions, and so many lines and numbers must be readable from `data`.
    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    unsafe fn pack_tile(&self, data: *const f32, lines: usize, depth: usize, out: &mut Tile) {
        // SAFETY: the caller's promise.
        let rows = unsafe {
            match (self.is_deep(), lines == LINES && depth == SIDE) {
                (true, true) => vectors::deep::<true>(data, self.line_stride, lines, depth),
                (true, false) => vectors::deep::<false>(data, self.line_stride, lines, depth),
                (false, true) => vectors::wide::<true>(data, self.depth_stride, lines, depth),
                (false, false) => vectors::wide::<false>(data, self.depth_stride, lines, depth),
            }
        };
        // The left operand wants lines of pairs, the right one pairs of lines.
        let as_is = self.is_deep() == (self.operand == Operand::Left);
        vectors::store(if as_is { rows } else { vectors::transposed(rows) }, &mut out.0);
    }
}

/// Rows of tiles as vectors.
mod vectors {
    use std::arch::x86_64::*;

    type Rows = [__m512i; 16];

    fn mask(n: usize) -> u16 {
        if n >= 16 { u16::MAX } else { (1 << n) - 1 }
    }

    /// Two vectors rounded to bf16, one after the other.
    #[inline]
    #[target_feature(enable = "avx512f,avx512bf16")]
    fn rounded(first: __m512, second: __m512) -> __m512i {
        let both = _mm512_cvtne2ps_pbh(second, first);
        // SAFETY: only the type changes; both are 512 bits.
        unsafe { std::mem::transmute::<__m512bh, __m512i>(both) }
    }

    /// Up to 16 lines of up to 32 numbers that lie next to each other.
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    pub unsafe fn deep<const FULL: bool>(data: *const f32, stride: usize, lines: usize, depth: usize) -> Rows {
        let masks = [mask(depth), mask(depth.saturating_sub(16))];
        std::array::from_fn(|i| {
            if !FULL && i >= lines {
                return _mm512_setzero_si512();
            }
            let line = data.wrapping_add(i * stride);
            // SAFETY: within the caller's promise; what is masked is not read.
            let load = |half: usize| unsafe {
                let place = line.wrapping_add(16 * half);
                if FULL { _mm512_loadu_ps(place) } else { _mm512_maskz_loadu_ps(masks[half], place) }
            };
            rounded(load(0), load(1))
        })
    }

    /// The numbers of up to 16 lines next to each other, up to 32 deep: pair by pair.
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    pub unsafe fn wide<const FULL: bool>(data: *const f32, stride: usize, lines: usize, depth: usize) -> Rows {
        const PAIRS: [u16; 32] = {
            let mut order = [0; 32];
            let mut i = 0;
            while i < 16 {
                order[2 * i] = i as u16;
                order[2 * i + 1] = 16 + i as u16;
                i += 1;
            }
            order
        };
        // SAFETY: 64 bytes of the array.
        let order = unsafe { _mm512_loadu_si512(PAIRS.as_ptr().cast()) };
        let mask = mask(lines);
        std::array::from_fn(|q| {
            // SAFETY: within the caller's promise; what is masked is not read.
            let load = |k: usize| unsafe {
                let place = data.wrapping_add(k * stride);
                match FULL {
                    true => _mm512_loadu_ps(place),
                    false if k < depth => _mm512_maskz_loadu_ps(mask, place),
                    false => _mm512_setzero_ps(),
                }
            };
            _mm512_permutexvar_epi16(order, rounded(load(2 * q), load(2 * q + 1)))
        })
    }

    /// The 16 x 16 matrix of pairs transposed: within quarters of four rows by four columns, then the quarters.
    #[inline]
    #[target_feature(enable = "avx512f")]
    pub fn transposed(r: Rows) -> Rows {
        let zero = _mm512_setzero_si512();
        let mut pairs = [zero; 16]; // of rows 2 i and 2 i + 1
        for i in 0..8 {
            pairs[2 * i] = _mm512_unpacklo_epi32(r[2 * i], r[2 * i + 1]);
            pairs[2 * i + 1] = _mm512_unpackhi_epi32(r[2 * i], r[2 * i + 1]);
        }
        // quads[4 i + j]: of rows 4 i.., column j of each quarter.
        let mut quads = [zero; 16];
        for i in 0..4 {
            for half in 0..2 {
                let (upper, lower) = (pairs[4 * i + half], pairs[4 * i + 2 + half]);
                quads[4 * i + 2 * half] = _mm512_unpacklo_epi64(upper, lower);
                quads[4 * i + 2 * half + 1] = _mm512_unpackhi_epi64(upper, lower);
            }
        }
        let mut out = [zero; 16];
        for j in 0..4 {
            let [a, b, c, d] = [quads[j], quads[4 + j], quads[8 + j], quads[12 + j]];
            let (ab_low, ab_high) = (_mm512_shuffle_i32x4::<0x88>(a, b), _mm512_shuffle_i32x4::<0xdd>(a, b));
            let (cd_low, cd_high) = (_mm512_shuffle_i32x4::<0x88>(c, d), _mm512_shuffle_i32x4::<0xdd>(c, d));
            out[j] = _mm512_shuffle_i32x4::<0x88>(ab_low, cd_low);
            out[8 + j] = _mm512_shuffle_i32x4::<0xdd>(ab_low, cd_low);
            out[4 + j] = _mm512_shuffle_i32x4::<0x88>(ab_high, cd_high);
            out[12 + j] = _mm512_shuffle_i32x4::<0xdd>(ab_high, cd_high);
        }
        out
    }

    #[inline]
    #[target_feature(enable = "avx512f")]
    pub fn store(rows: Rows, out: &mut [u32; 256]) {
        for (row, out) in rows.into_iter().zip(out.as_chunks_mut::<16>().0) {
            // SAFETY: 64 bytes of the array.
            unsafe { _mm512_storeu_si512(out.as_mut_ptr().cast(), row) }
        }
    }
}
