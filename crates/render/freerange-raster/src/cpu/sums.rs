//! Sums over the pixels of a block, for one splat: see [`SUMS`].
//!
//! [`plain`] says what they are. On x86-64 the same sums are made with AVX2, in another order: eight of them at once by a
//! tree of additions of halves of vectors, which the compiler does not find by itself.

use super::math::{LANES, Pixels};
use super::project::SUMS;

/// What is summed.
#[derive(Default)]
pub struct Terms {
    /// d loss / d ln(alpha)
    pub g: Pixels,
    /// Blending weight.
    pub weight: Pixels,
    /// Pixel center - mean of the splat.
    pub dx: Pixels,
    pub dy: Pixels,
}

/// Adds the sums of `terms` to `row`. `d` is d loss / d (red, green, blue, depth).
#[inline(always)]
pub fn add<const AVX2: bool, const DEPTH: bool>(terms: &Terms, d: &[Pixels; 4], row: &mut [f32; SUMS]) {
    #[cfg(target_arch = "x86_64")]
    if AVX2 {
        // SAFETY: AVX2 is true only in functions that are compiled for processors with AVX2 and FMA, and called on these.
        unsafe { avx2::add::<DEPTH>(terms, d, row) };
        return;
    }
    plain::<DEPTH>(terms, d, row);
}

/// The sums, one by one.
#[inline(always)]
fn plain<const DEPTH: bool>(Terms { g, weight, dx, dy }: &Terms, d: &[Pixels; 4], row: &mut [f32; SUMS]) {
    let mut columns = [[0f32; LANES]; 10];
    for l in 0..LANES {
        let (gx, gy) = (g[l] * dx[l], g[l] * dy[l]);
        let [r, g_, b, depth] = [0, 1, 2, 3].map(|c| weight[l] * d[c][l]);
        let terms = [g[l], gx, gy, gx * dx[l], gx * dy[l], gy * dy[l], r, g_, b, depth];
        for (column, term) in columns.iter_mut().zip(terms) {
            column[l] = term;
        }
    }
    let columns = if DEPTH { &columns[..] } else { &columns[..9] };
    for (sum, column) in row.iter_mut().zip(columns) {
        // In halves, which are vectors.
        let eight: [f32; 8] = std::array::from_fn(|i| column[i] + column[8 + i]);
        let four: [f32; 4] = std::array::from_fn(|i| eight[i] + eight[4 + i]);
        *sum += (four[0] + four[2]) + (four[1] + four[3]);
    }
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use std::arch::x86_64::{
        __m128, __m256, _mm_add_ps, _mm_add_ss, _mm_cvtss_f32, _mm_movehl_ps, _mm_shuffle_ps, _mm256_add_ps,
        _mm256_castps256_ps128, _mm256_extractf128_ps, _mm256_fmadd_ps, _mm256_loadu_ps, _mm256_mul_ps,
        _mm256_permute2f128_ps, _mm256_shuffle_ps, _mm256_storeu_ps,
    };

    use super::{Pixels, SUMS, Terms};

    /// As [`plain`](super::plain).
    ///
    /// # Safety
    /// Needs AVX2 and FMA. It has no `target_feature` of its own, which would keep it from being inlined into the loop over
    /// splats.
    #[inline(always)]
    pub unsafe fn add<const DEPTH: bool>(terms: &Terms, d: &[Pixels; 4], row: &mut [f32; SUMS]) {
        // SAFETY: the caller's, for the instructions; loads and stores lie within the arrays.
        unsafe {
            let load = |p: &Pixels| [_mm256_loadu_ps(p.as_ptr()), _mm256_loadu_ps(p.as_ptr().add(8))];
            let (g, weight, dx, dy) = (load(&terms.g), load(&terms.weight), load(&terms.dx), load(&terms.dy));
            // All rows of a block have the same dx.
            let dx = dx[0];
            let (gy0, gy1) = (_mm256_mul_ps(g[0], dy[0]), _mm256_mul_ps(g[1], dy[1]));
            let (sum, sum_y) = (_mm256_add_ps(g[0], g[1]), _mm256_add_ps(gy0, gy1));
            let sum_yy = _mm256_fmadd_ps(gy0, dy[0], _mm256_mul_ps(gy1, dy[1]));
            let (sum_x, sum_xy) = (_mm256_mul_ps(sum, dx), _mm256_mul_ps(sum_y, dx));
            let sum_xx = _mm256_mul_ps(sum_x, dx);
            let color = |c: usize| {
                let d = load(&d[c]);
                _mm256_fmadd_ps(weight[0], d[0], _mm256_mul_ps(weight[1], d[1]))
            };
            let first = quarters(halves(sum, sum_xy), halves(sum_x, sum_yy));
            let second = quarters(halves(sum_y, color(0)), halves(sum_xx, color(1)));
            // sum, x, y, xx, xy, yy, red, green
            let eight = _mm256_add_ps(_mm256_shuffle_ps(first, second, 0x88), _mm256_shuffle_ps(first, second, 0xdd));
            _mm256_storeu_ps(row.as_mut_ptr(), _mm256_add_ps(_mm256_loadu_ps(row.as_ptr()), eight));
            row[8] += total(color(2));
            if DEPTH {
                row[9] += total(color(3));
            }
        }
    }

    /// Sums of the two halves of each: those of `a`, then those of `b`.
    #[inline(always)]
    unsafe fn halves(a: __m256, b: __m256) -> __m256 {
        // SAFETY: the caller's.
        unsafe { _mm256_add_ps(_mm256_permute2f128_ps(a, b, 0x20), _mm256_permute2f128_ps(a, b, 0x31)) }
    }

    /// Sums of the two halves of each half: of the first one of `a` and of `b`, then of the second ones.
    #[inline(always)]
    unsafe fn quarters(a: __m256, b: __m256) -> __m256 {
        // SAFETY: the caller's.
        unsafe { _mm256_add_ps(_mm256_shuffle_ps(a, b, 0x44), _mm256_shuffle_ps(a, b, 0xee)) }
    }

    /// The sum of all eight.
    #[inline(always)]
    unsafe fn total(a: __m256) -> f32 {
        // SAFETY: the caller's.
        unsafe {
            let four: __m128 = _mm_add_ps(_mm256_castps256_ps128(a), _mm256_extractf128_ps(a, 1));
            let two = _mm_add_ps(four, _mm_movehl_ps(four, four));
            _mm_cvtss_f32(_mm_add_ss(two, _mm_shuffle_ps(two, two, 1)))
        }
    }
}

#[cfg(all(test, target_arch = "x86_64"))]
mod tests {
    use super::*;

    #[test]
    fn vectors_of_eight_sum_up_to_the_same() {
        if !(std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma")) {
            eprintln!("skipped: no AVX2 here");
            return;
        }
        let wave = |k: usize| -> Pixels { std::array::from_fn(|l| ((l * 7 + k * 5) as f32 * 0.37).sin()) };
        // As in a block: columns repeat, rows are constant.
        let dx: Pixels = std::array::from_fn(|l| (l % 4) as f32 - 1.7);
        let dy: Pixels = std::array::from_fn(|l| (l / 4) as f32 + 0.4);
        let terms = Terms { g: wave(0), weight: wave(1), dx, dy };
        let d = [2, 3, 4, 5].map(wave);
        let start: [f32; SUMS] = std::array::from_fn(|k| k as f32);
        let (mut expected, mut found, mut flat) = (start, start, start);
        plain::<true>(&terms, &d, &mut expected);
        // SAFETY: checked above.
        unsafe { avx2::add::<true>(&terms, &d, &mut found) };
        for (k, (a, b)) in expected.iter().zip(&found).enumerate() {
            assert!((a - b).abs() < 1e-5, "{k}: {a} and {b}");
            assert_eq!(*a == start[k], k >= 10, "{k}");
        }
        // SAFETY: checked above.
        unsafe { avx2::add::<false>(&terms, &d, &mut flat) };
        assert_eq!((&flat[..9], flat[9]), (&found[..9], start[9]));
    }
}
