//! Scalar formulas for loops over lanes: branch-free, so that the compiler turns each loop into vector instructions.
//!
//! `FMA` says whether the target has fused multiply-add: without it, `f32::mul_add` would be a call into the C library.

/// Pixels, or Gaussians, that one vector step handles: one AVX-512 register, two of AVX2, four of NEON.
pub const LANES: usize = 16;

/// A number for each pixel of a block, or for each of as many Gaussians.
pub type Pixels = [f32; LANES];

/// `a * b + c`.
#[inline(always)]
pub fn fma<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// The smaller of two; `b` where one is NaN (one instruction, unlike `f32::min`).
#[inline(always)]
pub fn min(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// The larger of two; `b` where one is NaN.
#[inline(always)]
pub fn max(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// Adding it to a float of magnitude below 2^22 rounds that to an integer, which ends up in the low mantissa bits.
const ROUND: f32 = 12_582_912.0; // 1.5 * 2^23

/// `2^x` for `x` in [-126, 127], relative error below 3e-7.
#[inline(always)]
pub fn exp2<const FMA: bool>(x: f32) -> f32 {
    let shifted = x + ROUND;
    let f = x - (shifted - ROUND); // [-0.5, 0.5]
    // Degree 5, interpolated at the Chebyshev nodes: relative error 1.1e-7 before rounding.
    let mut p = fma::<FMA>(0.001_339_086_3, f, 0.009_676_032);
    p = fma::<FMA>(p, f, 0.055_503_57);
    p = fma::<FMA>(p, f, 0.240_221_07);
    p = fma::<FMA>(p, f, std::f32::consts::LN_2);
    p = fma::<FMA>(p, f, 1.0);
    f32::from_bits(p.to_bits().wrapping_add(shifted.to_bits() << 23))
}

/// `e^x` for `x` in [-87, 87], relative error below 2e-7; arguments outside are taken to the nearer end.
#[inline(always)]
pub fn exp<const FMA: bool>(x: f32) -> f32 {
    let x = min(max(x, -87.0), 87.0);
    let shifted = fma::<FMA>(x, std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    // ln 2 in two parts (the first has few bits, so that its product with n is exact).
    let f = fma::<FMA>(n, -0.693_359_4, x);
    let f = fma::<FMA>(n, 2.121_944_4e-4, f);
    let mut p = fma::<FMA>(0.001_394_111, f, 0.008_375_128);
    p = fma::<FMA>(p, f, 0.041_666_354);
    p = fma::<FMA>(p, f, 0.166_664_15);
    p = fma::<FMA>(p, f, 0.5);
    p = fma::<FMA>(p, f, 1.0);
    p = fma::<FMA>(p, f, 1.0);
    f32::from_bits(p.to_bits().wrapping_add(shifted.to_bits() << 23))
}

/// `log2(x)` for normal, positive `x`; for x in [2^-8, 1] within 6e-7 of the larger of its magnitude and 0.3.
#[inline(always)]
pub fn log2<const FMA: bool>(x: f32) -> f32 {
    // x = m 2^e with m in [sqrt(1/2), sqrt(2)); log m = 2 artanh((m - 1) / (m + 1)).
    const SQRT_HALF: u32 = 0x3f35_04f3;
    let bits = x.to_bits().wrapping_sub(SQRT_HALF);
    let e = (bits as i32 >> 23) as f32;
    let m = f32::from_bits((bits & 0x007f_ffff).wrapping_add(SQRT_HALF));
    let s = (m - 1.0) / (m + 1.0);
    let s2 = s * s;
    let mut p = fma::<FMA>(s2, 0.320_598_9, 0.412_198_6); // 2 / (9 ln 2), 2 / (7 ln 2)
    p = fma::<FMA>(p, s2, 0.577_078);
    p = fma::<FMA>(p, s2, 0.961_796_7);
    p = fma::<FMA>(p, s2, 2.885_39);
    fma::<FMA>(p, s, e)
}

/// `x` rounded down, for `x` in [0, 4e6]; rounded up if it is within a thousandth of the next integer. (A cast would be
/// exact, but is not vectorised, as it saturates.)
#[inline(always)]
pub fn floor_index(x: f32) -> u32 {
    ((x - 0.499) + ROUND).to_bits() & 0x003f_ffff
}

/// The scalar product.
#[inline(always)]
pub fn dot<const FMA: bool>(a: [f32; 3], b: [f32; 3]) -> f32 {
    fma::<FMA>(a[2], b[2], fma::<FMA>(a[1], b[1], a[0] * b[0]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sweep(from: f32, to: f32, mut check: impl FnMut(f32)) {
        for i in 0..=200_000 {
            check(from + (to - from) * i as f32 / 200_000.0);
        }
    }

    #[test]
    fn exponentials_match_f64() {
        sweep(-126.0, 126.0, |x| {
            let truth = f64::from(x).exp2();
            for v in [exp2::<true>(x), exp2::<false>(x)] {
                assert!((f64::from(v) / truth - 1.0).abs() < 3e-7, "2^{x} = {v}");
            }
        });
        sweep(-87.0, 87.0, |x| {
            let truth = f64::from(x).exp();
            for v in [exp::<true>(x), exp::<false>(x)] {
                assert!((f64::from(v) / truth - 1.0).abs() < 2.5e-7, "e^{x} = {v}");
            }
        });
    }

    #[test]
    fn floor_index_rounds_down() {
        for i in [0u32, 1, 2, 3, 15, 16, 1000, 16383] {
            for (part, expected) in [(0.0, i), (0.3, i), (0.5, i), (0.99, i), (0.9999, i + 1)] {
                assert_eq!(floor_index(i as f32 + part), expected, "{i} + {part}");
            }
        }
        assert!(floor_index(4e6).abs_diff(4_000_000) <= 1);
    }

    #[test]
    fn logarithm_matches_f64() {
        sweep(1.0 / 256.0, 1.0, |x| {
            let truth = f64::from(x).log2();
            for v in [log2::<true>(x), log2::<false>(x)] {
                assert!((f64::from(v) - truth).abs() < 6e-7 * truth.abs().max(0.3), "log2 {x} = {v}");
            }
        });
    }
}
