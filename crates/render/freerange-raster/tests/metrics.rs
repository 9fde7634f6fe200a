//! Properties that need no reference values.

use freerange_raster::metrics::*;
use proptest::prelude::*;

fn image(n: usize) -> impl Strategy<Value = Vec<f32>> {
    prop::collection::vec(0.0f32..1.0, n)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]
    #[test]
    fn ssim_is_symmetric_and_one_for_equal_images(
        (w, h, a, b) in (1usize..24, 1usize..24)
            .prop_flat_map(|(w, h)| (Just(w), Just(h), image(3 * w * h), image(3 * w * h)))
    ) {
        let (ab, ba) = (ssim_3dgs(&a, &b, w, h).unwrap(), ssim_3dgs(&b, &a, w, h).unwrap());
        prop_assert!((ab - ba).abs() < 1e-5);
        prop_assert!((ssim_3dgs(&a, &a, w, h).unwrap() - 1.0).abs() < 1e-5);
        prop_assert!(ab <= 1.0 + 1e-5);
        prop_assert!((mse(&a, &b).unwrap() - mse(&b, &a).unwrap()).abs() < 1e-12);
    }
}

/// Sizes of one pixel, of less than a strip of columns or a group of rows, of a whole number of them, and of more.
const SIZES: [(usize, usize); 7] = [(1, 1), (3, 20), (10, 8), (11, 3), (32, 9), (43, 16), (70, 31)];

/// Two images that share something.
fn two(w: usize, h: usize) -> [Vec<f32>; 2] {
    [3, 5].map(|k| (0..3 * w * h).map(|i| 0.5 + 0.4 * ((i * k + i) as f32 * 0.37).sin()).collect())
}

/// From the definition, window by window.
#[test]
fn ssim_equals_a_slow_one() {
    let weight = |d: usize| (-((d * d) as f64) / 4.5).exp();
    let norm = (weight(0) + 2.0 * (1..=5).map(weight).sum::<f64>()).powi(2);
    for (w, h) in SIZES {
        let [a, b] = two(w, h);
        let mut total = 0.0;
        for (at, c) in (0..w * h).flat_map(|at| (0..3).map(move |c| (at, c))) {
            let (x, y) = (at % w, at / w);
            let mut m = [0.0f64; 5]; // means of x, y, xx, yy, xy; black beyond the border
            for (u, v) in (0..w * h).map(|i| (i % w, i / w)).filter(|(u, v)| u.abs_diff(x) <= 5 && v.abs_diff(y) <= 5) {
                let (p, q) = (f64::from(a[3 * (v * w + u) + c]), f64::from(b[3 * (v * w + u) + c]));
                let share = weight(u.abs_diff(x)) * weight(v.abs_diff(y)) / norm;
                m.iter_mut().zip([p, q, p * p, q * q, p * q]).for_each(|(m, value)| *m += share * value);
            }
            let [p, q, pp, qq, pq] = m;
            total += (2.0 * p * q + 1e-4) * (2.0 * (pq - p * q) + 9e-4)
                / ((p * p + q * q + 1e-4) * (pp - p * p + qq - q * q + 9e-4));
        }
        let (expected, found) = (total / (3 * w * h) as f64, ssim_3dgs(&a, &b, w, h).unwrap());
        assert!((expected - found).abs() < 1e-6, "{w} x {h}: {expected} {found}");
    }
}

#[test]
fn gradient_is_that_of_finite_differences() {
    for (w, h) in SIZES {
        let [a, b] = two(w, h);
        let (value, gradient) = ssim_with_gradient(&a, &b, w, h).unwrap();
        assert_eq!(value, ssim_3dgs(&a, &b, w, h).unwrap());
        let n = a.len() as f64;
        for i in (0..a.len()).step_by(a.len() / 40 + 1) {
            let at = |delta: f32| {
                let mut moved = a.clone();
                moved[i] += delta;
                n * ssim_3dgs(&moved, &b, w, h).unwrap()
            };
            let (numeric, found) = ((at(2e-3) - at(-2e-3)) / 4e-3, n * f64::from(gradient[i]));
            let tolerance = 2e-3 + 1e-2 * found.abs();
            assert!((numeric - found).abs() < tolerance, "{w} x {h}, {i}: {numeric} {found}");
        }
    }
}

#[test]
fn sizes_that_do_not_fit_are_refused() {
    let (a, b) = (vec![0.0; 12], vec![0.0; 15]);
    assert_eq!(mse(&a, &b), Err(ImageError::Mismatch { first: 12, second: 15 }));
    assert_eq!(psnr(&[], &[]), Err(ImageError::Empty));
    assert!(matches!(ssim_3dgs(&a, &b, 2, 2), Err(ImageError::Length { image: "second image", .. })));
    assert!(matches!(ssim_with_gradient(&b, &b, 2, 2), Err(ImageError::Length { expected: 12, found: 15, .. })));
    assert_eq!(ssim_3dgs(&[], &[], 0, 4), Err(ImageError::Empty));
    assert!(matches!(ssim_3dgs(&a, &a, usize::MAX, 2), Err(ImageError::Length { .. })));
    assert!(ssim_skimage_gauss(&a, &a, 2, 2).is_err());
}

#[test]
fn a_nan_pixel_does_not_pass() {
    let (mut a, b) = (vec![0.5; 3 * 16], vec![0.5; 3 * 16]);
    a[5] = f32::NAN;
    assert!(psnr(&a, &b).unwrap().is_nan() && capped_psnr(&a, &b).unwrap().is_nan());
    assert!(ssim_3dgs(&a, &b, 4, 4).unwrap().is_nan());
}

#[test]
fn equal_images_have_a_mean() {
    let (a, b) = (vec![0.5; 12], vec![0.25; 12]);
    assert_eq!(psnr(&a, &a).unwrap(), f64::INFINITY);
    assert_eq!(capped_psnr(&a, &a).unwrap(), HIGHEST_PSNR);
    assert_eq!(capped_psnr(&a, &b).unwrap(), psnr(&a, &b).unwrap());
}
