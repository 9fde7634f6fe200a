//! Fits of small scenes that the rasterizer itself has drawn, and what all tests share.

use crate::*;
use crate::{anchors::Anchors, initial::fit_from, views::Targets};
use freerange_gaussians::{Gaussians, channel};
use freerange_raster::{RasterConfig, render};
use freerange_scene::camera::{Camera, View, Window};
use glam::DVec3;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::ops::ControlFlow;

/// `n` opaque, colored Gaussians in a ball of radius 0.4.
pub(crate) fn ball(n: usize, seed: u64) -> Gaussians {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut cloud = Gaussians::default();
    while cloud.len() < n {
        let mean = DVec3::from_array(std::array::from_fn(|_| rng.random_range(-0.4..0.4)));
        if mean.length() > 0.4 {
            continue;
        }
        let mut row = [0.0; channel::COUNT];
        row[channel::MEAN].copy_from_slice(&mean.as_vec3().to_array());
        row[channel::LOG_SCALE].fill_with(|| rng.random_range(-3.2..-2.2));
        row[channel::ROTATION].fill_with(|| rng.random_range(-1.0..1.0));
        row[channel::LOGIT_OPACITY] = rng.random_range(1.0..4.0);
        row[channel::COLOR].fill_with(|| rng.random_range(0.1..0.9));
        cloud.push(&row);
    }
    cloud
}

/// Cameras spread over a sphere of radius 1.5 (a Fibonacci spiral).
pub(crate) fn cameras(count: usize, size: u32, turn: f64) -> Vec<Camera> {
    (0..count)
        .map(|i| {
            let z = 0.8 * (1.0 - (2.0 * i as f64 + 1.0) / count as f64);
            let angle = turn + 2.399_963 * i as f64;
            let r = (1.0 - z * z).sqrt();
            let eye = 1.5 * DVec3::new(r * angle.cos(), r * angle.sin(), z);
            Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 0.857, size, size)
        })
        .collect()
}

/// The cloud as seen by a camera, with straight alpha.
pub(crate) fn photograph(cloud: &Gaussians, camera: &Camera) -> View {
    let out = render(cloud.rows(), &[*camera], &[[0.0; 3]], &RasterConfig::default()).unwrap();
    let mut image = image::RgbaImage::new(camera.width, camera.height);
    for (i, pixel) in image.pixels_mut().enumerate() {
        let alpha = out.alpha[i];
        for c in 0..3 {
            pixel[c] = (out.rgb[3 * i + c] / alpha.max(1e-6) * 255.0).round() as u8;
        }
        pixel[3] = (alpha * 255.0).round() as u8;
    }
    View { name: "view".into(), camera: *camera, image }
}

/// A window is what the whole view shows there, and shows the object.
#[test]
fn windows_are_parts_of_views() {
    let cloud = ball(3, 1);
    let views = ring(3, 40, &cloud);
    let targets = Targets::new(&views, None).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let background = [0.3, 0.6, 0.1];
    let config = RasterConfig::default();
    let mut places = std::collections::HashSet::new();
    for _ in 0..10 {
        let windows = targets.windows(&[2, 0], 0.5, &mut rng);
        assert_eq!((windows.views, windows.images.len(), windows.size(0)), (2, 2, (20, 20)));
        for (k, of) in [2, 0].into_iter().enumerate() {
            let (camera, whole) = (windows.cameras[k], targets.cameras[of]);
            let (x, y) = ((whole.cx - camera.cx) as usize, (whole.cy - camera.cy) as usize);
            places.insert((x, y));
            assert!(windows.images[k].pixels().any(|p| p[3] > 0));
            assert_eq!(windows.images[k].get_pixel(3, 7), targets.images[of].get_pixel(x as u32 + 3, y as u32 + 7));
            let part = render(cloud.rows(), &[camera], &[background], &config).unwrap();
            let all = render(cloud.rows(), &[whole], &[background], &config).unwrap();
            // But for what is outside of the window by more than 0.15 of its sides, whose perspective is bounded (see `Pinhole`).
            let expected = (0..20).flat_map(|i| &all.rgb[3 * ((y + i) * 40 + x)..][..60]);
            let off: Vec<f32> = part.rgb.iter().zip(expected).map(|(a, b)| (a - b).abs()).collect();
            assert!(off.iter().all(|off| *off < 0.03) && off.iter().sum::<f32>() < 1e-3 * off.len() as f32, "{off:?}");
        }
    }
    assert!(places.len() > 5, "{places:?}");
    // All of a view is a window, too.
    let all = targets.windows(&[1], 1.0, &mut rng);
    assert_eq!((all.images[0].clone(), all.cameras[0].cx), (targets.images[1].clone(), targets.cameras[1].cx));
    // Where there is no object it is in the middle.
    let empty = View { image: image::RgbaImage::new(40, 40), ..views[0].clone() };
    let windows = Targets::new(&[empty], None).unwrap().windows(&[0], 0.25, &mut rng);
    assert_eq!(targets.cameras[0].cx - windows.cameras[0].cx, 15.0);
}

/// Many silhouettes may share one picture, which is shrunk once.
#[test]
fn silhouettes_share_pictures() {
    let mut views = ring(2, 24, &ball(12, 1));
    views[1] = ring(2, 40, &ball(12, 1)).remove(1);
    let from = cameras(3, 24, 1.0);
    let silhouettes = from.iter().zip([1, 0, 1]).map(|(camera, of)| {
        let (width, height) = views[of].image.dimensions();
        PosedImage { camera: camera.resized(width, height), ..PosedImage::from(&views[of]) }
    });
    let targets = Targets::new(Evidence { silhouettes: silhouettes.collect(), ..(&views).into() }, Some(32)).unwrap();
    assert_eq!((targets.views, targets.cameras.len()), (2, 5));
    for (i, (of, size)) in [(0, 24), (1, 32), (1, 32), (0, 24), (1, 32)].into_iter().enumerate() {
        let expected = freerange_scene::camera::image_ops::resize_area(&views[of].image, size, size);
        assert_eq!(*targets.images[i], expected, "{i}");
        assert!(std::ptr::eq(&*targets.images[i], &*targets.images[of]), "{i}: held once");
        let camera = if i < 2 { views[of].camera } else { from[i - 2] };
        assert!(targets.cameras[i].world_to_camera == camera.world_to_camera, "{i}");
        let found = &targets.cameras[i];
        assert!(found.width == size && (found.fx - camera.resized(size, size).fx).abs() < 1e-9, "{i}: {found:?}");
    }
    let wrong = PosedImage { camera: from[0], ..PosedImage::from(&views[1]) };
    let refused = Targets::new(Evidence { silhouettes: vec![wrong], ..(&views[..1]).into() }, None).err().unwrap();
    assert!(matches!(refused, FitError::View { field: "image", .. }), "{refused}");
    for weight in [0.5, -1.0, 2.0, f64::NAN] {
        let view = PosedImage { weight, ..PosedImage::from(&views[0]) };
        let refused = Targets::new(vec![view], None).err().unwrap();
        assert!(matches!(refused, FitError::View { field: "weight", .. }), "{weight}: {refused}");
    }
}

/// Parts of images are compared as if they had been cut out, and fits of all views but one share their images.
#[test]
fn parts_of_images_and_all_views_but_one_are_no_copies() {
    let whole = ring(4, 60, &ball(12, 1));
    let far: Vec<View> = whole
        .iter()
        .map(|view| {
            let mut image = image::RgbaImage::new(90, 70);
            image::imageops::replace(&mut image, &view.image, 20, 5);
            let c = view.camera;
            View {
                image,
                camera: Camera { width: 90, height: 70, cx: c.cx + 20.0, cy: c.cy + 5.0, ..c },
                ..view.clone()
            }
        })
        .collect();
    let window = |view: &View| Window::around(view);
    let cut: Vec<View> = far.iter().map(|view| window(view).cut(view).into_owned()).collect();
    let part = |view| {
        let (window, posed) = (window(view), PosedImage::from(view));
        PosedImage { camera: window.camera(&posed.camera), window: Some(window), ..posed }
    };
    let parts: Vec<PosedImage<'_>> = far.iter().map(part).collect();
    for size in [None, Some(32)] {
        let (a, b) = (Targets::new(parts.clone(), size).unwrap(), Targets::new(&cut, size).unwrap());
        assert_eq!((&a.images, &a.cameras), (&b.images, &b.cameras));
        let others = a.without(1);
        assert_eq!((others.views, &others.cameras[1]), (3, &a.cameras[2]));
        assert!(std::sync::Arc::ptr_eq(&others.images[2], &a.images[3]));
    }
    let config = InitialFitConfig { iterations: 20, gaussians: 30, render_size: 32 };
    let found = LeaveOneOut::new(&cut, &config).unwrap().fit(1, 5, go).unwrap();
    let others = [cut[0].clone(), cut[2].clone(), cut[3].clone()];
    assert_eq!(found.rows(), initial_fit(&others, &config, 5, go).unwrap().rows());
}

/// Photos that searches for symmetries are tested with.
pub(crate) fn photos(cloud: &Gaussians) -> Vec<View> {
    cameras(4, 64, 0.3).iter().map(|c| photograph(cloud, c)).collect()
}

/// What searches for symmetries begin with.
pub(crate) fn own(views: &[View], config: &InitialFitConfig) -> Gaussians {
    initial_fit(views, config, 0, go).unwrap()
}

/// Views of the cloud from all around.
pub(crate) fn ring(count: usize, size: u32, cloud: &Gaussians) -> Vec<View> {
    cameras(count, size, 0.0).iter().map(|c| photograph(cloud, c)).collect()
}

fn psnr(cloud: &Gaussians, views: &[View]) -> f64 {
    psnr_over_white(cloud, views).unwrap()
}

pub(crate) fn go(_: &FitProgress<'_>) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

fn small() -> FitConfig {
    FitConfig {
        iterations: 800,
        cap_max: 200,
        initial: 100,
        growth_start: 100,
        refine_every: 50,
        growth: 1.1,
        ..Default::default()
    }
}

#[test]
fn a_fit_shows_unseen_views() {
    let scene = ball(60, 11);
    let held_out: Vec<View> = cameras(5, 48, 1.0).iter().map(|c| photograph(&scene, c)).collect();
    let mut counts = vec![];
    let fitted = fit(&ring(12, 48, &scene), None, &small(), |p| {
        counts.push(p.gaussians);
        ControlFlow::Continue(())
    })
    .unwrap();
    assert_eq!(counts.len(), 800);
    assert_eq!((counts[0], fitted.len()), (100, 200));
    let found = psnr(&fitted, &held_out);
    assert!(found > 25.0, "{found} dB");
    for row in &fitted {
        let length: f32 = row[channel::ROTATION].iter().map(|v| v * v).sum();
        assert!((length - 1.0).abs() < 1e-5);
    }
}

#[test]
fn the_same_seed_gives_the_same_bytes() {
    let views = ring(4, 24, &ball(30, 4));
    let config = FitConfig { iterations: 150, views_per_step: 3, ..small() };
    let run = |seed| fit(&views, None, &FitConfig { seed, ..config.clone() }, go).unwrap();
    assert_eq!(run(1), run(1));
    assert_ne!(run(1), run(2));
    let optimized = |seed| {
        let config =
            OptimizationConfig { steps: 20, gaussians: 60, anchors: small_anchors(), seed, ..Default::default() };
        optimize(&ball(30, 5), &[], &views, &config, go).unwrap()
    };
    assert_eq!(optimized(1), optimized(1));
    assert_ne!(optimized(1), optimized(2));
}

#[test]
fn a_fit_can_start_from_a_cloud_and_stop_early() {
    let scene = ball(30, 4);
    let views = ring(4, 24, &scene);
    let mut steps = 0;
    let stopped = fit(&views, Some(&scene), &small(), |p| {
        steps = p.step;
        if p.step == 3 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })
    .unwrap();
    assert_eq!((steps, stopped.len()), (3, 30));
    assert!(psnr(&stopped, &views) > 25.0);
}

#[test]
fn continuing_keeps_the_number_and_comes_nearer() {
    let scene = ball(30, 4);
    let views = ring(4, 32, &scene);
    let rough = disturbed(&scene, 9);
    let mut steps = 0;
    let config = InitialFitConfig { iterations: 150, gaussians: 7, render_size: 32 };
    let continued = fit_from(Some(&rough), &views, &config, 3, |p| {
        steps = p.steps;
        ControlFlow::Continue(())
    })
    .unwrap();
    assert_eq!((steps, continued.len()), (150, 30));
    let [before, after] = [&rough, &continued].map(|cloud| psnr(cloud, &views));
    assert!(after > before + 2.0, "{before} dB, continued {after} dB");
    assert!(fit_from(Some(&Gaussians::default()), &views, &config, 3, go).is_err());
}

fn evidence<'a>(views: &'a [View], silhouettes: &'a [View]) -> Evidence<'a> {
    Evidence { silhouettes: silhouettes.iter().map(PosedImage::from).collect(), ..views.into() }
}

/// Silhouettes from further places mend the shape, and tell no colors.
#[test]
fn silhouettes_are_fitted_to() {
    let scene = ball(40, 12);
    let photos: Vec<View> = cameras(3, 32, 0.2).iter().map(|c| photograph(&scene, c)).collect();
    let silhouettes = ring(12, 32, &scene);
    let config = FitConfig { iterations: 300, cap_max: 100, ..small() };
    let seen = |silhouettes| evidence(&photos, silhouettes);
    let alone = fit(&photos, None, &config, go).unwrap();
    let helped = fit(seen(&silhouettes), None, &config, go).unwrap();
    let apart = |cloud: &Gaussians| {
        let views = cameras(5, 32, 1.0).into_iter().map(|c| (photograph(&scene, &c), photograph(cloud, &c)));
        let each = views.map(|(a, b)| {
            let pixels = a.image.pixels().zip(b.image.pixels());
            pixels.map(|(a, b)| f64::from(a[3].abs_diff(b[3]))).sum::<f64>()
        });
        each.sum::<f64>()
    };
    assert!(apart(&helped) < 0.7 * apart(&alone), "{} {}", apart(&helped), apart(&alone));
    let config_of_optimization = OptimizationConfig { steps: 200, gaussians: 100, ..OptimizationConfig::default() };
    let [plain, by_silhouette] = [&[][..], &silhouettes]
        .map(|silhouettes| optimize(&alone, &[], seen(silhouettes), &config_of_optimization, go).unwrap());
    assert!(apart(&by_silhouette) < 0.8 * apart(&plain), "{} {}", apart(&by_silhouette), apart(&plain));
    let mut gray = silhouettes.clone();
    gray.iter_mut().for_each(|view| view.image.pixels_mut().for_each(|p| p.0 = [9, 99, 199, p[3]]));
    let other = fit(seen(&gray), None, &config, go).unwrap();
    assert_eq!(other, helped);
    assert!(matches!(fit(evidence(&[], &silhouettes), None, &config, go), Err(FitError::NoViews)));
}

/// A cloud as a generator might give it: right on the whole, wrong in detail.
fn disturbed(cloud: &Gaussians, seed: u64) -> Gaussians {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut out = cloud.clone();
    for row in out.iter_mut() {
        row[channel::MEAN].iter_mut().for_each(|v| *v += rng.random_range(-0.02..0.02));
        row[channel::LOG_SCALE].iter_mut().for_each(|v| *v += rng.random_range(-0.3..0.3));
        row[channel::COLOR].iter_mut().for_each(|v| *v += rng.random_range(-0.15..0.15));
    }
    out
}

fn small_anchors() -> AnchorConfig {
    AnchorConfig { size: 48, ..Default::default() }
}

#[test]
fn anchors_have_the_photos_colors() {
    // A solid ball, gray, of which photos from all around say that it is red.
    let solid = |color: [f32; 3]| {
        let mut rows = Vec::new();
        let along = || (-5..=5).map(|i| f64::from(i) * 0.06);
        for (x, y, z) in along().flat_map(|x| along().flat_map(move |y| along().map(move |z| (x, y, z)))) {
            let mean = DVec3::new(x, y, z);
            if mean.length() < 0.31 {
                let mut row = [0.0; channel::COUNT];
                row[channel::MEAN].copy_from_slice(&mean.as_vec3().to_array());
                row[channel::LOG_SCALE].fill(-3.0);
                row[channel::ROTATION][0] = 1.0;
                row[channel::LOGIT_OPACITY] = 6.0;
                row[channel::COLOR].copy_from_slice(&color);
                rows.extend(row);
            }
        }
        Gaussians::from_rows(rows)
    };
    let [gray, red] = [[0.5; 3], [0.9, 0.1, 0.1]].map(solid);
    let photos = Targets::new(&ring(8, 96, &red), None).unwrap();
    let anchors = Anchors::new(std::slice::from_ref(&gray), &photos, &small_anchors()).unwrap();
    let loss = |cloud| (0..6).map(|view| anchors.objective(cloud, view, [0.0; 3]).unwrap().loss).sum::<f64>();
    assert!(loss(&red) < 0.5 * loss(&gray), "{} {}", loss(&red), loss(&gray));
}

#[test]
fn refining_helps_seen_and_unseen_views() {
    let scene = ball(60, 21);
    let start = disturbed(&scene, 22);
    let views = ring(4, 64, &scene);
    let held_out: Vec<View> = cameras(6, 64, 0.5).iter().map(|c| photograph(&scene, c)).collect();
    let config = OptimizationConfig { steps: 300, gaussians: 90, anchors: small_anchors(), ..Default::default() };
    let mut seen = vec![];
    let optimized = optimize(&start, &[], &views, &config, |p| {
        seen.push((p.step, p.gaussians));
        ControlFlow::Continue(())
    })
    .unwrap();
    assert_eq!((seen[0], seen[299], optimized.len()), ((1, 60), (300, 90), 90));
    assert!(optimized.check_finite().is_ok());
    for views in [&views, &held_out] {
        let (before, after) = (psnr(&start, views), psnr(&optimized, views));
        assert!(after > before + 2.0, "{before} dB, then {after} dB");
    }
    // With fewer Gaussians asked for than there are, their number stays.
    let config = OptimizationConfig { steps: 3, gaussians: 10, ..config };
    assert_eq!(optimize(&start, &[], &views, &config, go).unwrap().len(), 60);
}

/// Coarse steps see what an optimization at their size sees, and the others all there is.
#[test]
fn refining_may_begin_with_small_pictures() {
    let scene = ball(60, 21);
    let (start, views) = (disturbed(&scene, 22), ring(4, 64, &scene));
    let optimized = |coarse, coarse_size, render_size| {
        let anchors = small_anchors();
        let config = OptimizationConfig {
            steps: 20,
            gaussians: 90,
            coarse,
            coarse_size,
            render_size,
            anchors,
            ..Default::default()
        };
        optimize(&start, &[], &views, &config, go).unwrap()
    };
    let (small, whole) = (optimized(0.0, 1, 32), optimized(0.0, 1, 64));
    assert_eq!(optimized(1.0, 32, 64).rows(), small.rows());
    // The views have 64 pixels.
    assert_eq!(optimized(1.0, 1000, 64).rows(), whole.rows());
    let both = optimized(0.5, 32, 64);
    assert!(both.rows() != small.rows() && both.rows() != whole.rows());
}

/// The last steps go on from a layer, unless the end comes before.
#[test]
fn refining_may_end_with_a_layer() {
    let scene = ball(60, 21);
    let (start, views) = (disturbed(&scene, 22), ring(4, 64, &scene));
    let config = OptimizationConfig {
        steps: 40,
        gaussians: 300,
        layer: 0.25,
        render_size: 64,
        anchors: small_anchors(),
        ..Default::default()
    };
    let run = |layer, end| {
        let mut told = Vec::new();
        let config = OptimizationConfig { layer, ..config.clone() };
        let found = optimize(&start, &[], &views, &config, |p| {
            told.push((p.step, p.steps, p.gaussians));
            if p.step == end { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        assert!(told.iter().enumerate().all(|(i, (step, steps, _))| (*step, *steps) == (i + 1, 40)));
        (found.unwrap(), told)
    };
    let (with, told) = run(0.25, 0);
    assert!(told.len() == 40 && told[29].2 <= 300 && with.len() <= 600);
    assert_eq!(told[30].2, with.len());
    assert_eq!(run(0.25, 30).0.len(), told[29].2, "an end before the layer");
    let without = run(0.0, 0).0;
    assert!(without.len() == 300 && with != without);
}

/// Refined together, equal clouds look as one does, and there are no more Gaussians than were asked for.
#[test]
fn clouds_are_optimized_together() {
    let scene = ball(60, 21);
    let start = disturbed(&scene, 22);
    let (views, alone) = (ring(4, 64, &scene), ring(4, 64, &start));
    let begun = |others: &[Gaussians], gaussians| {
        let anchors = small_anchors();
        // Too slow to move anything.
        let rates = Rates { mean: 1e-9, scale: 0.0, rotation: 0.0, opacity: 0.0, color: 0.0 };
        let config = OptimizationConfig { steps: 1, gaussians, rates, anchors, ..Default::default() };
        optimize(&start, others, &views, &config, go).unwrap()
    };
    let other = disturbed(&scene, 23);
    for (others, gaussians, expected) in [
        (vec![], 240, 60),
        (vec![start.clone(); 3], 240, 240),
        (vec![start.clone(); 3], 239, 180),
        (vec![other.clone(); 3], 100, 60),
        (vec![other.clone()], 10, 60),
    ] {
        let together = begun(&others, gaussians);
        assert_eq!(together.len(), expected);
        assert!(psnr(&together, &alone) > 30.0, "{expected}: {} dB", psnr(&together, &alone));
    }
    // What others show is there, too.
    let (both, beside) = (begun(std::slice::from_ref(&other), 120), ring(4, 64, &other));
    assert!(psnr(&both, &beside) > psnr(&start, &beside) + 1.0);
}

/// All views from one side: that side gets better, and the other, which they say nothing of, stays what it was.
#[test]
fn anchors_keep_the_unseen_side() {
    let scene = ball(150, 31);
    let start = disturbed(&scene, 32);
    let from = |angle: f64, cloud: &Gaussians| {
        let turned = [-0.3, 0.0, 0.3].map(|turn| {
            let (sin, cos) = (angle + turn).sin_cos();
            Camera::look_at(1.5 * DVec3::new(cos, sin, turn), DVec3::ZERO, DVec3::Z, 0.857, 64, 64)
        });
        turned.map(|c| photograph(cloud, &c))
    };
    let (photos, behind) = (from(0.0, &scene), from(std::f64::consts::PI, &start));
    let optimized = |weight| {
        let anchors = AnchorConfig { weight, ..small_anchors() };
        optimize(&start, &[], &photos, &OptimizationConfig { gaussians: 200, anchors, ..Default::default() }, go)
            .unwrap()
    };
    let (held, free) = (optimized(0.5), optimized(0.0));
    let gain = psnr(&held, &photos) - psnr(&start, &photos);
    assert!(gain > 4.0, "{gain} dB");
    let (held, free) = (psnr(&held, &behind), psnr(&free, &behind));
    assert!(held > 28.0 && held > free + 3.0, "agreement with the start: {held} dB held, {free} dB without");
}

/// Guesses that err differently: where no view looks, their mean is nearer to the truth than each of them.
#[test]
fn other_guesses_help_on_the_unseen_side() {
    let scene = ball(150, 31);
    let from = |angle: f64| {
        let turned = [-0.3, 0.0, 0.3].map(|turn| {
            let (sin, cos) = (angle + turn).sin_cos();
            Camera::look_at(1.5 * DVec3::new(cos, sin, turn), DVec3::ZERO, DVec3::Z, 0.857, 64, 64)
        });
        turned.map(|c| photograph(&scene, &c))
    };
    let (photos, behind) = (from(0.0), from(std::f64::consts::PI));
    let guesses: Vec<Gaussians> = (32..36).map(|seed| disturbed(&scene, seed)).collect();
    let optimized = |others: &[Gaussians]| {
        let anchors = AnchorConfig { weight: 0.5, ..small_anchors() };
        optimize(
            &guesses[0],
            others,
            &photos,
            &OptimizationConfig { gaussians: 200, anchors, ..Default::default() },
            go,
        )
        .unwrap()
    };
    let (alone, together) = (psnr(&optimized(&[]), &behind), psnr(&optimized(&guesses[1..]), &behind));
    assert!(together > alone + 1.0, "{alone} dB alone, {together} dB together");
}

/// Photos of several cameras, upright and lying.
#[test]
fn views_may_have_any_size() {
    let scene = ball(60, 21);
    let mut photos = cameras(4, 64, 0.0);
    for (camera, (w, h)) in photos.iter_mut().zip([(64, 64), (96, 64), (48, 80), (200, 150)]) {
        let (scale, side) = (f64::from(w.min(h)) / 64.0, [w, h].map(f64::from));
        *camera = Camera {
            width: w,
            height: h,
            fx: scale * camera.fx,
            fy: scale * camera.fy,
            cx: side[0] / 2.0 + 3.0,
            cy: side[1] / 2.0,
            ..*camera
        };
    }
    let photos: Vec<View> = photos.iter().map(|c| photograph(&scene, c)).collect();
    let held_out: Vec<View> = cameras(6, 64, 0.5).iter().map(|c| photograph(&scene, c)).collect();
    let start = disturbed(&scene, 22);
    let config = OptimizationConfig { steps: 300, gaussians: 90, anchors: small_anchors(), ..Default::default() };
    let optimized = optimize(&start, &[], &photos, &config, go).unwrap();
    for views in [&photos, &held_out] {
        let (before, after) = (psnr(&start, views), psnr(&optimized, views));
        assert!(after > before + 2.0, "{before} dB, then {after} dB");
    }
    let fitted = fit(&photos, None, &FitConfig { views_per_step: 3, render_size: Some(64), ..small() }, go).unwrap();
    assert!(psnr(&fitted, &photos) > 25.0, "{} dB", psnr(&fitted, &photos));
    let centerd = frame_of(&fitted, &photos).unwrap();
    assert!(centerd.translation.length() < 0.1 && (0.8..1.25).contains(&centerd.scale), "{centerd:?}");
}

#[test]
fn bad_input_is_refused() {
    let (cloud, views) = (ball(5, 1), ring(3, 16, &ball(5, 1)));
    let fit_message = |views: &[View], cloud: Option<&Gaussians>| {
        fit(views, cloud, &FitConfig { iterations: 1, ..Default::default() }, go).unwrap_err().to_string()
    };
    let optimize_message = |views: &[View], cloud: &Gaussians| {
        optimize(cloud, &[], views, &OptimizationConfig::default(), go).unwrap_err().to_string()
    };
    let both = |views: &[View], expected: &str| {
        for message in [fit_message(views, None), optimize_message(views, &cloud)] {
            assert!(message.contains(expected), "{message}");
        }
    };
    both(&[], "no views");

    let change = |change: &dyn Fn(&mut View)| {
        let mut views = views.clone();
        change(&mut views[1]);
        views
    };
    both(&change(&|v| v.image = image::RgbaImage::new(16, 15)), "the camera's size");
    both(&change(&|v| v.camera.fx = f64::NAN), "focal");
    both(&change(&|v| v.camera.fy = 0.0), "focal");
    both(&change(&|v| v.camera.world_to_camera.w_axis.x = f64::INFINITY), "rigid");
    both(&change(&|v| v.camera.world_to_camera.x_axis *= 2.0), "rigid");

    let mut broken = cloud.clone();
    broken.rows_mut()[20] = f32::NAN;
    for (bad, expected) in [(&broken, "NaN"), (&Gaussians::default(), "no Gaussians")] {
        for message in [fit_message(&views, Some(bad)), optimize_message(&views, bad)] {
            assert!(message.contains(expected), "{message}");
        }
    }
    let large = ball(20, 1);
    let tight = FitConfig { cap_max: 10, initial: 10, ..Default::default() };
    assert!(fit(&views, Some(&large), &tight, go).unwrap_err().to_string().contains("20 Gaussians"));
}

#[test]
fn divergence_is_an_error() {
    let views = ring(2, 16, &ball(5, 1));
    let config = FitConfig { iterations: 50, noise_lr: 1e300, ..small() };
    let message = fit(&views, None, &config, go).unwrap_err().to_string();
    assert!(message.contains("not finite") && message.starts_with("step"), "{message}");
}
