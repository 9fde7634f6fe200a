//! Elementary functions that the compiler turns into vector instructions, and sums in lanes.

/// `exp(x)` within 2 units in the last place; 0 below -87.3.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    const ROUND: f32 = 12_582_912.0; // 1.5 x 2^23: adding it rounds to whole numbers
    let clamped = x.clamp(-87.3, 88.0);
    let n = clamped * std::f32::consts::LOG2_E + ROUND;
    let whole = n - ROUND;
    // x = whole ln 2 + r, with ln 2 in two parts so that r keeps its low bits.
    let r = clamped - whole * 0.693_145_75 - whole * 1.428_606_8e-6;
    let p = 1.987_569_1e-4;
    let p = p * r + 1.398_199_9e-3;
    let p = p * r + 8.333_452e-3;
    let p = p * r + 4.166_579_6e-2;
    let p = p * r + 1.666_666_5e-1;
    let p = p * r + 5e-1;
    let p = p * r * r + r + 1.0;
    let power = f32::from_bits((n.to_bits() << 23).wrapping_add(0x3f80_0000));
    if x < -87.3 { 0.0 } else { p * power }
}

/// The normal distribution's cumulative probability and density at `x`, both within 3e-7.
#[inline(always)]
pub fn normal(x: f32) -> (f32, f32) {
    // Abramowitz and Stegun 7.1.26 for erf(|x| / sqrt 2).
    let z = x.abs() * std::f32::consts::FRAC_1_SQRT_2;
    let e = exp(-z * z);
    let t = 1.0 / (1.0 + 0.327_591_1 * z);
    let p = 1.061_405_4;
    let p = p * t - 1.453_152;
    let p = p * t + 1.421_413_8;
    let p = p * t - 0.284_496_74;
    let p = p * t + 0.254_829_6;
    let half_tail = 0.5 * p * t * e; // (1 - erf z) / 2
    (if x < 0.0 { half_tail } else { 1.0 - half_tail }, 0.398_942_3 * e)
}

const LANES: usize = 16;

/// The sum over both slices' pairs of `f`, in 16 lanes.
#[inline(always)]
pub fn sum2(a: &[f32], b: &[f32], f: impl Fn(f32, f32) -> f32) -> f32 {
    let mut lanes = [0f32; LANES];
    let (a_whole, a_rest) = a.as_chunks::<LANES>();
    let (b_whole, b_rest) = b.as_chunks::<LANES>();
    for (x, y) in a_whole.iter().zip(b_whole) {
        for l in 0..LANES {
            lanes[l] += f(x[l], y[l]);
        }
    }
    let rest: f32 = a_rest.iter().zip(b_rest).map(|(&x, &y)| f(x, y)).sum();
    fold(lanes, |a, b| a + b) + rest
}

/// The sum of `f` over a slice, in 16 lanes.
#[inline(always)]
pub fn sum(a: &[f32], f: impl Fn(f32) -> f32) -> f32 {
    sum2(a, a, |x, _| f(x))
}

/// The largest value.
#[inline(always)]
pub fn max(a: &[f32]) -> f32 {
    let mut lanes = [f32::NEG_INFINITY; LANES];
    let (whole, rest) = a.as_chunks::<LANES>();
    for x in whole {
        for l in 0..LANES {
            lanes[l] = if x[l] > lanes[l] { x[l] } else { lanes[l] };
        }
    }
    rest.iter().fold(fold(lanes, f32::max), |a, &b| a.max(b))
}

#[inline(always)]
fn fold(mut lanes: [f32; LANES], f: impl Fn(f32, f32) -> f32) -> f32 {
    let mut n = LANES / 2;
    while n > 0 {
        for l in 0..n {
            lanes[l] = f(lanes[l], lanes[l + n]);
        }
        n /= 2;
    }
    lanes[0]
}

/// Adds `b` to `a`.
#[inline(always)]
pub fn add(a: &mut [f32], b: &[f32]) {
    for (a, b) in a.iter_mut().zip(b) {
        *a += b;
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn exp_is_exact_to_two_units() {
        for i in -870..=880 {
            let x = i as f32 / 10.0 + 0.013;
            let truth = f64::from(x.clamp(-87.3, 88.0)).exp();
            let error = (f64::from(super::exp(x)) / truth - 1.0).abs();
            assert!(x > 88.0 || error < 2.5e-7, "{x} {error}");
        }
        assert_eq!(super::exp(-100.0), 0.0);
        assert_eq!(super::exp(f32::NEG_INFINITY), 0.0);
        assert_eq!(super::exp(0.0), 1.0);
    }

    #[test]
    fn normal_matches_its_integral() {
        // Simpson's rule from -10 in double precision.
        let density = |x: f64| (-0.5 * x * x).exp() / std::f64::consts::TAU.sqrt();
        for i in -60..=60 {
            let x = f64::from(i) / 10.0;
            let n = 2_000;
            let h = (x + 10.0) / f64::from(n);
            let inner: f64 =
                (1..n).map(|k| if k % 2 == 1 { 4.0 } else { 2.0 } * density(-10.0 + f64::from(k) * h)).sum();
            let truth = (density(-10.0) + density(x) + inner) * h / 3.0;
            let (cdf, pdf) = super::normal(x as f32);
            assert!((f64::from(cdf) - truth).abs() < 3e-7, "{x} {cdf} {truth}");
            assert!((f64::from(pdf) - density(x)).abs() < 3e-7);
        }
    }

    #[test]
    fn sums_and_maxima_include_the_remainder() {
        let a: Vec<f32> = (0..37).map(|i| i as f32).collect();
        assert_eq!(super::sum(&a, |x| x), 666.0);
        assert_eq!(super::max(&a), 36.0);
        assert_eq!(super::sum2(&a, &a, |x, y| x * y), a.iter().map(|x| x * x).sum::<f32>());
    }
}
