//! Properties that need no reference values.

use freerange_metrics::*;
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

#[test]
fn gradient_is_that_of_finite_differences() {
    let (w, h) = (9, 14);
    let value = |i: usize, k: usize| 0.5 + 0.4 * ((i * k + i) as f32 * 0.37).sin();
    let a: Vec<f32> = (0..3 * w * h).map(|i| value(i, 3)).collect();
    let b: Vec<f32> = (0..3 * w * h).map(|i| value(i, 5)).collect();
    let (_, gradient) = ssim_with_gradient(&a, &b, w, h).unwrap();
    for i in (0..a.len()).step_by(7) {
        let at = |delta: f32| {
            let mut moved = a.clone();
            moved[i] += delta;
            ssim_3dgs(&moved, &b, w, h).unwrap()
        };
        let numeric = (at(2e-3) - at(-2e-3)) / 4e-3;
        assert!((numeric - f64::from(gradient[i])).abs() < 2e-5, "{i}: {numeric} {}", gradient[i]);
    }
}

#[test]
fn sizes_that_do_not_fit_are_refused() {
    let (a, b) = (vec![0.0; 12], vec![0.0; 15]);
    assert_eq!(mse(&a, &b), Err(MetricsError::Mismatch { first: 12, second: 15 }));
    assert_eq!(psnr(&[], &[]), Err(MetricsError::Empty));
    assert!(matches!(ssim_3dgs(&a, &b, 2, 2), Err(MetricsError::Length { image: "second image", .. })));
    assert!(matches!(ssim_with_gradient(&b, &b, 2, 2), Err(MetricsError::Length { expected: 12, found: 15, .. })));
    assert_eq!(ssim_3dgs(&[], &[], 0, 4), Err(MetricsError::Empty));
    assert!(matches!(ssim_3dgs(&a, &a, usize::MAX, 2), Err(MetricsError::Length { .. })));
    assert!(ssim_skimage_gauss(&a, &a, 2, 2).is_err());
}

#[test]
fn a_nan_pixel_does_not_pass() {
    let (mut a, b) = (vec![0.5; 3 * 16], vec![0.5; 3 * 16]);
    a[5] = f32::NAN;
    assert!(psnr(&a, &b).unwrap().is_nan());
    assert!(ssim_3dgs(&a, &b, 4, 4).unwrap().is_nan());
}
