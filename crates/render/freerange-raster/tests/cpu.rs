//! The fast rasterizer against the slow one, on random scenes, and on inputs that nobody should have made.

mod common;

use common::{POISON, camera, noise, scene};
use freerange_raster::{CHANNELS, RasterConfig, RasterError, reference, render, render_backward};
use proptest::prelude::*;

/// Largest difference, and the number of values that differ by more than `limit`.
fn compare(found: &[f32], expected: &[f64], limit: f64) -> (f64, usize) {
    assert_eq!(found.len(), expected.len());
    let distance = |(f, e): (&f32, &f64)| if f.is_nan() { f64::INFINITY } else { (f64::from(*f) - e).abs() };
    let differences = found.iter().zip(expected).map(distance);
    let worst = differences.clone().fold(0.0, f64::max);
    (worst, differences.filter(|d| *d > limit).count())
}

#[test]
fn images_and_gradients_equal_the_reference() {
    let config = RasterConfig { depth: true, ..RasterConfig::default() };
    // Sizes that are no multiple of a block or band, one pixel, one row; more Gaussians than one chunk takes.
    for (seed, n, width, height) in
        [(1, 40, 33, 21), (2, 300, 64, 64), (3, 1, 1, 1), (4, 77, 1, 50), (5, 200, 130, 3), (6, 2500, 47, 38)]
    {
        let (gaussians, camera, background) = (scene(seed, n), camera(0.0, width, height), [0.9, -0.1, 0.4]);
        let pixels = (width * height) as usize;
        let out = render(&gaussians, &[camera], &[background], &config).unwrap();
        let truth = reference::render(&gaussians, &camera, background, &config);
        // A pixel where some opacity is within rounding of 1/255 may differ by that much; there are few.
        for (what, found, expected, limit) in [
            ("rgb", &out.rgb, &truth.rgb, 1e-5),
            ("alpha", &out.alpha, &truth.alpha, 1e-5),
            ("depth", &out.depth, &truth.depth, 2e-5),
        ] {
            let (worst, many) = compare(found, expected, limit);
            println!("{n:5} Gaussians, {width} x {height}, {what}: {worst:.1e}, {many} beyond {limit:e}");
            assert!(worst < 0.02 && many <= pixels / 200, "{what}: worst {worst:e}, {many} of {pixels}");
        }

        let (d_rgb, d_alpha, d_depth) = (noise(7, 3 * pixels), noise(8, pixels), noise(9, pixels));
        let found = render_backward(&gaussians, &out, &d_rgb, &d_alpha, &d_depth).unwrap();
        let doubles = |v: &[f32]| v.iter().map(|v| f64::from(*v)).collect();
        let grad = reference::ImageGrad { rgb: doubles(&d_rgb), alpha: doubles(&d_alpha), depth: doubles(&d_depth) };
        let (d_gaussians, d_background) = reference::render_backward(&gaussians, &camera, background, &config, &grad);
        for channels in [0..3, 3..6, 6..10, 10..11, 11..14] {
            let pick = |row: &[f32]| row[channels.clone()].to_vec();
            let pick64 = |row: &[f64]| row[channels.clone()].to_vec();
            let found: Vec<f32> = found.gaussians.chunks(CHANNELS).flat_map(pick).collect();
            let expected: Vec<f64> = d_gaussians.chunks(CHANNELS).flat_map(pick64).collect();
            let largest = expected.iter().fold(0.0, |m: f64, v| m.max(v.abs()));
            let (worst, many) = compare(&found, &expected, 1e-4 * largest);
            println!("{n:5} Gaussians, gradient of channels {channels:?}: {:.1e} of the largest", worst / largest);
            assert!(
                worst <= 0.01 * largest && many <= found.len() / 100,
                "{channels:?}: {worst:e}, {many}, {largest:e}"
            );
        }
        let (worst, _) = compare(&found.backgrounds[0], &d_background, 0.0);
        assert!(worst < 1e-3, "background: {worst:e}");
    }
}

#[test]
fn several_views_are_independent_and_their_gradients_add_up() {
    let (gaussians, config) = (scene(11, 500), RasterConfig::default());
    let cameras = [0.0, 1.0, 2.5].map(|turn| camera(turn, 50, 41));
    let backgrounds = [[0.0; 3], [1.0; 3], [0.2, 0.5, 0.7]];
    let all = render(&gaussians, &cameras, &backgrounds, &config).unwrap();
    let d_rgb = noise(12, all.rgb.len());
    let all_grads = render_backward(&gaussians, &all, &d_rgb, &[], &[]).unwrap();
    let size = 50 * 41;
    let mut sum = vec![0f64; gaussians.len()];
    for i in 0..3 {
        let one = render(&gaussians, &cameras[i..=i], &backgrounds[i..=i], &config).unwrap();
        assert_eq!(one.rgb, all.rgb[3 * size * i..3 * size * (i + 1)]);
        assert_eq!(one.alpha, all.alpha[size * i..size * (i + 1)]);
        let d_rgb = &d_rgb[3 * size * i..3 * size * (i + 1)];
        let grads = render_backward(&gaussians, &one, d_rgb, &[], &[]).unwrap();
        assert_eq!(grads.backgrounds[0], all_grads.backgrounds[i]);
        sum.iter_mut().zip(grads.gaussians).for_each(|(s, v)| *s += f64::from(v));
    }
    let largest = sum.iter().fold(0.0, |m: f64, v| m.max(v.abs()));
    let (worst, _) = compare(&all_grads.gaussians, &sum, 0.0);
    assert!(worst < 1e-5 * largest, "{worst:e} of {largest:e}");
}

#[test]
fn the_same_bytes_every_time_on_any_number_of_threads() {
    let (gaussians, config) = (scene(21, 6000), RasterConfig::default());
    let cameras = [0.0, 0.7].map(|turn| camera(turn, 90, 70));
    let run = || {
        let out = render(&gaussians, &cameras, &[[0.5; 3]; 2], &config).unwrap();
        let grads =
            render_backward(&gaussians, &out, &noise(22, out.rgb.len()), &noise(23, out.alpha.len()), &[]).unwrap();
        (out.rgb, out.alpha, grads)
    };
    let first = run();
    for threads in [1, 2, 3, 8] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        for _ in 0..3 {
            assert!(pool.install(run) == first, "{threads} threads");
        }
    }
}

#[test]
fn nothing_to_draw() {
    let config = RasterConfig { depth: true, ..RasterConfig::default() };
    let none = render(&[], &[camera(0.0, 5, 4)], &[[0.25, 0.5, 0.75]], &config).unwrap();
    assert!(none.rgb.chunks(3).all(|p| p == [0.25, 0.5, 0.75]));
    assert_eq!((none.alpha, none.depth), (vec![0.0; 20], vec![0.0; 20]));
    let gaussians = scene(1, 3);
    let no_view = render(&gaussians, &[], &[], &config).unwrap();
    assert!(no_view.rgb.is_empty());
    assert_eq!(render_backward(&gaussians, &no_view, &[], &[], &[]).unwrap().gaussians, vec![0.0; 3 * CHANNELS]);
}

#[test]
fn what_does_not_fit_is_an_error() {
    let (gaussians, config, view) = (scene(1, 3), RasterConfig::default(), camera(0.0, 8, 8));
    let fails = |result: Result<freerange_raster::RenderOutput, RasterError>| result.unwrap_err();
    assert!(matches!(fails(render(&gaussians[1..], &[view], &[[0.0; 3]], &config)), RasterError::Length { .. }));
    assert!(matches!(fails(render(&gaussians, &[view], &[], &config)), RasterError::Length { .. }));
    let other = camera(0.0, 8, 9);
    let different = fails(render(&gaussians, &[view, other], &[[0.0; 3]; 2], &config));
    assert!(matches!(different, RasterError::ImageSize { view: 1, .. }), "{different}");
    for size in [0, 1 << 20] {
        let camera = freerange_scene::camera::Camera { width: size, ..view };
        assert!(matches!(fails(render(&gaussians, &[camera], &[[0.0; 3]], &config)), RasterError::ImageSize { .. }));
    }
    let broken = freerange_scene::camera::Camera { fx: f64::NAN, ..view };
    assert_eq!(fails(render(&gaussians, &[broken], &[[0.0; 3]], &config)), RasterError::Camera { view: 0 });
    let black_hole = [[0.0, f32::INFINITY, 0.0]];
    assert_eq!(fails(render(&gaussians, &[view], &black_hole, &config)), RasterError::Background { view: 0 });
    let nowhere = RasterConfig { near: 0.0, ..config };
    assert!(matches!(fails(render(&gaussians, &[view], &[[0.0; 3]], &nowhere)), RasterError::Config { .. }));

    let out = render(&gaussians, &[view], &[[0.0; 3]], &config).unwrap();
    let d_rgb = vec![0.0; 3 * 64];
    assert!(render_backward(&gaussians[14..], &out, &d_rgb, &[], &[]).is_err());
    assert!(render_backward(&gaussians, &out, &d_rgb[1..], &[], &[]).is_err());
    assert!(render_backward(&gaussians, &out, &d_rgb, &[0.0; 3], &[]).is_err());
    assert!(render_backward(&gaussians, &out, &d_rgb, &[], &[0.0; 64]).is_err(), "no depth was rendered");
    assert!(render_backward(&gaussians, &out, &d_rgb, &[0.0; 64], &[]).is_ok());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn poison_neither_spreads_nor_panics(
        seed in 0u64..1000,
        changes in proptest::collection::vec((0usize..12, 0usize..CHANNELS, proptest::sample::select(POISON.to_vec())), 1..20),
    ) {
        let clean = scene(seed, 12);
        let mut gaussians = clean.clone();
        for (i, channel, value) in &changes {
            gaussians[i * CHANNELS + channel] = *value;
        }
        let config = RasterConfig { depth: true, ..RasterConfig::default() };
        let cameras = [0.0, 2.0].map(|turn| camera(turn, 19, 18));
        let out = render(&gaussians, &cameras, &[[0.3; 3]; 2], &config).unwrap();
        for (name, values) in [("rgb", &out.rgb), ("alpha", &out.alpha), ("depth", &out.depth)] {
            prop_assert!(values.iter().all(|v| v.is_finite()), "{} {:?}", name, gaussians);
        }
        let (d_rgb, d) = (noise(seed, out.rgb.len()), noise(seed + 1, out.alpha.len()));
        let grads = render_backward(&gaussians, &out, &d_rgb, &d, &d).unwrap();
        for (row, grad) in gaussians.chunks(CHANNELS).zip(grads.gaussians.chunks(CHANNELS)) {
            prop_assert!(grad.iter().all(|v| v.is_finite()), "{:?} has gradient {:?}", row, grad);
            if row.iter().any(|v| !v.is_finite()) {
                prop_assert!(grad.iter().all(|v| *v == 0.0));
            }
        }
        // Those that are not finite are as if they were not there.
        let kept: Vec<f32> =
            gaussians.chunks(CHANNELS).filter(|row| row.iter().all(|v| v.is_finite())).flatten().copied().collect();
        let without = render(&kept, &cameras, &[[0.3; 3]; 2], &config).unwrap();
        prop_assert_eq!(&without.rgb, &out.rgb);
    }
}

#[test]
fn zero_quaternions_are_culled() {
    let mut gaussians = scene(31, 5);
    let without: Vec<f32> = gaussians[CHANNELS..].to_vec();
    gaussians[6..10].fill(0.0);
    let view = camera(0.0, 30, 30);
    let config = RasterConfig::default();
    let out = render(&gaussians, &[view], &[[0.0; 3]], &config).unwrap();
    assert_eq!(out.rgb, render(&without, &[view], &[[0.0; 3]], &config).unwrap().rgb);
    let grads = render_backward(&gaussians, &out, &noise(1, out.rgb.len()), &[], &[]).unwrap();
    assert_eq!(grads.gaussians[..CHANNELS], [0.0; CHANNELS]);
    assert!(grads.gaussians[CHANNELS..].iter().any(|v| *v != 0.0));
}
