//! What a quick fit of four views is worth, by its settings: PSNR in dB on held-out views of generated objects over
//! white, of the fit and of its slice of 1,024 Gaussians, and seconds.
//! `cargo run --release -p freerange-data --example initial_fits -- OBJECTS ITERATIONS GAUSSIANS SIZE [ITERATIONS GAUSSIANS SIZE ...]`

use std::{ops::ControlFlow, time::Instant};

use freerange_data::Object;
use freerange_data::build::{ObjectConfig, generate_object};
use freerange_gaussians::Gaussians;
use freerange_optim::{InitialFitConfig, initial_fit, tree_slice};
use freerange_raster::metrics::psnr;
use freerange_raster::{RasterConfig, render};
use freerange_scene::camera::{SelectionConfig, View, image_ops::composite, select_views};
use glam::DVec3;
use rayon::prelude::*;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let numbers: Vec<usize> = std::env::args().skip(1).map(|a| a.parse()).collect::<Result<_, _>>()?;
    let (&objects, settings) = numbers.split_first().ok_or("expected OBJECTS and settings")?;
    let mut config = ObjectConfig { views: 24, ..ObjectConfig::default() };
    config.cameras.resolution = 256;
    config.surface.points = 256;
    let objects: Vec<Object> = (0..objects as u64)
        .into_par_iter()
        .map(|i| generate_object(7_000_000_002_000 + i, &config, &[4]))
        .collect::<Result<_, _>>()?;
    println!(
        "| iterations | Gaussians | px | full: fit | slice | partial: fit | slice | s |\n|---|---|---|---|---|---|---|---|"
    );
    for setting in settings.chunks_exact(3) {
        let quick = InitialFitConfig { iterations: setting[0], gaussians: setting[1], render_size: setting[2] as u32 };
        let begin = Instant::now();
        let scores: Vec<[f64; 4]> = objects.par_iter().map(|o| scores(o, &quick)).collect();
        let seconds = begin.elapsed().as_secs_f64() / (2 * objects.len()) as f64;
        let mean = |k: usize| scores.iter().map(|s| s[k]).sum::<f64>() / scores.len() as f64;
        let [a, b, c, d] = [0, 1, 2, 3].map(mean);
        println!(
            "| {} | {} | {} | {a:.2} | {b:.2} | {c:.2} | {d:.2} | {seconds:.2} |",
            setting[0], setting[1], setting[2]
        );
    }
    Ok(())
}

/// Of the fit and its slice, from views all around and from one side.
fn scores(object: &Object, quick: &InitialFitConfig) -> [f64; 4] {
    let centers: Vec<DVec3> = object.views.iter().map(|v| v.camera.center()).collect();
    let sets = select_views(&centers, DVec3::ZERO, &SelectionConfig::default()).expect("enough views");
    let mut scores = [0.0; 4];
    for (k, inputs) in [&sets.full, &sets.partial].into_iter().enumerate() {
        let inputs: Vec<View> = inputs.iter().map(|&i| object.views[i].clone()).collect();
        let cloud = initial_fit(&inputs, quick, 1, |_| ControlFlow::Continue(())).expect("a fit");
        let slice = tree_slice(&cloud, 10).expect("a slice");
        for (j, cloud) in [cloud, slice].into_iter().enumerate() {
            let sum: f64 = sets.validation.iter().map(|&i| score(&cloud, &object.views[i])).sum();
            scores[2 * k + j] = sum / sets.validation.len() as f64;
        }
    }
    scores
}

fn score(cloud: &Gaussians, view: &View) -> f64 {
    let image = render(cloud.rows(), &[view.camera], &[[1.0; 3]], &RasterConfig::default()).expect("a render");
    let shown: Vec<f32> = image.rgb.iter().map(|v| v.clamp(0.0, 1.0)).collect();
    psnr(&shown, &composite(&view.image, [1.0; 3])).expect("equal sizes")
}
