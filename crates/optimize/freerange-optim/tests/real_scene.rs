//! A rendered real object: fitted from 12 views and shown from 4 others, then spoilt and optimized from those 4.
//! `cargo test --release -p freerange-optim --test real_scene -- --ignored --nocapture` prints the figures.

use freerange_gaussians::{Gaussians, channel};
use freerange_optim::{FitConfig, OptimizationConfig, fit, optimize};
use freerange_raster::{RasterConfig, render};
use freerange_scene::camera::{Scene, View, image_ops};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::{ops::ControlFlow, path::PathBuf, time::Instant};

fn views(file: &str, size: u32) -> Vec<View> {
    let shared = PathBuf::from(std::env::var("FREERANGE_SHARED").expect("the variable FREERANGE_SHARED is set"));
    let mut views = Scene::load(&shared.join("views/rs_bottle").join(file)).unwrap().inputs;
    for view in &mut views {
        view.camera = view.camera.resized(size, size);
        view.image = image_ops::resize_area(&view.image, size, size);
    }
    views
}

/// Mean PSNR in dB over white.
fn psnr(cloud: &Gaussians, views: &[View]) -> f64 {
    let values = views.iter().map(|v| {
        let out = render(cloud.rows(), &[v.camera], &[[1.0; 3]], &RasterConfig::default()).unwrap();
        let shown: Vec<f32> = out.rgb.iter().map(|v| v.clamp(0.0, 1.0)).collect();
        freerange_raster::metrics::psnr(&shown, &image_ops::composite(&v.image, [1.0; 3])).unwrap()
    });
    values.sum::<f64>() / views.len() as f64
}

#[test]
#[ignore = "needs FREERANGE_SHARED"]
fn a_real_object_is_fitted_and_optimized() {
    let (around, others) = (views("transforms_val.json", 128), views("transforms_full.json", 128));
    let config = FitConfig { iterations: 2000, cap_max: 2048, initial: 1024, ..Default::default() };
    let start = Instant::now();
    let fitted = fit(&around, None, &config, |_| ControlFlow::Continue(())).unwrap();
    let (seen, unseen) = (psnr(&fitted, &around), psnr(&fitted, &others));
    let seconds = start.elapsed().as_secs_f64();
    println!(
        "fit: {} Gaussians, {seen:.2} dB on its 12 views, {unseen:.2} dB on 4 others, {seconds:.1} s",
        fitted.len()
    );
    assert!(seen > 34.0 && unseen > 29.0);

    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut spoilt = fitted.clone();
    for row in spoilt.iter_mut() {
        row[channel::MEAN].iter_mut().for_each(|v| *v += rng.random_range(-0.02..0.02));
        row[channel::COLOR].iter_mut().for_each(|v| *v += rng.random_range(-0.2..0.2));
    }
    let before = psnr(&spoilt, &around);
    let start = Instant::now();
    let optimized =
        optimize(&spoilt, &[], &others, &OptimizationConfig::default(), |_| ControlFlow::Continue(())).unwrap();
    let (seen, unseen) = (psnr(&optimized, &others), psnr(&optimized, &around));
    let seconds = start.elapsed().as_secs_f64();
    println!(
        "optimize: {before:.2} dB, then {unseen:.2} dB on 12 unseen views; {seen:.2} dB on the 4 seen; {seconds:.1} s"
    );
    // Anchors keep some of what was spoilt: it cannot know.
    assert!(unseen > before + 2.0 && seen > 40.0);
}
