//! How far the frame is off, before and after a quick fit corrects it: generated objects, seen by four cameras around
//! them or on one side, moved, turned about the vertical and scaled. Scale as |log|, the center's distance for a sphere of radius
//! 0.5; means with 95 % intervals. Scenes, where given, are held to fill that sphere, and not turned.
//! `cargo run --release -p freerange-data --example frame_accuracy -- OBJECTS [FOLDER_OF_SCENES]`

use std::{ops::ControlFlow, path::Path};

use freerange_data::build::{ObjectConfig, generate_object};
use freerange_optim::{InitialFitConfig, frame_of, initial_fit};
use freerange_scene::camera::{
    FrameConfig, Scene, SelectionConfig, Similarity, View, canonical_from_user, select_views,
};
use glam::{DQuat, DVec3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

type Failure = Box<dyn std::error::Error + Send + Sync>;
/// Of scale and center, before and after.
type Errors = [f64; 4];

fn main() -> Result<(), Failure> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let objects: u64 = arguments.first().ok_or("expected OBJECTS")?.parse()?;
    let mut config = ObjectConfig { views: 24, ..ObjectConfig::default() };
    config.cameras.resolution = 256;
    config.surface.points = 256;
    let generated: Vec<[Errors; 2]> =
        (0..objects).into_par_iter().map(|i| object(7_000_000_002_000 + i, &config)).collect::<Result<_, _>>()?;
    println!(
        "| views | n | scale, before | after | gain | center, before | after | gain |\n|---|---|---|---|---|---|---|---|"
    );
    for (k, name) in ["generated, full", "generated, partial"].into_iter().enumerate() {
        row(name, &generated.iter().map(|e| e[k]).collect::<Vec<_>>());
    }
    let Some(folder) = arguments.get(1) else { return Ok(()) };
    let mut scenes: Vec<_> = std::fs::read_dir(folder)?.flatten().map(|e| e.path()).filter(|p| p.is_dir()).collect();
    scenes.sort();
    for set in ["full", "partial"] {
        let errors: Vec<Errors> = scenes
            .par_iter()
            .map(|path| scene(&path.join(format!("transforms_{set}.json"))))
            .collect::<Result<_, _>>()?;
        row(&format!("scenes, {set}"), &errors);
    }
    Ok(())
}

fn object(seed: u64, config: &ObjectConfig) -> Result<[Errors; 2], Failure> {
    let mesh = freerange_assets::generate::generate(seed, &config.generator)?;
    let object = generate_object(seed, config, &[4])?;
    let centers: Vec<DVec3> = object.views.iter().map(|v| v.camera.center()).collect();
    let sets = select_views(&centers, DVec3::ZERO, &SelectionConfig::default())?;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    // Boxes are along the axes: a turned object has another one.
    let truth = |total: &Similarity| {
        let points = || mesh.positions.iter().map(|p| total.apply(p.as_dvec3()));
        let (low, high) = points().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(l, h), p| (l.min(p), h.max(p)));
        let center = 0.5 * (low + high);
        (center, points().map(|p| p.distance(center)).fold(0.0, f64::max))
    };
    let mut errors = |chosen: &[usize]| {
        let views: Vec<View> = chosen.iter().map(|&i| object.views[i].clone()).collect();
        let moved = Similarity {
            scale: rng.random_range(-1.2..1.2f64).exp(),
            rotation: DQuat::from_rotation_z(rng.random_range(0.0..std::f64::consts::TAU)),
            translation: DVec3::from_array(std::array::from_fn(|_| rng.random_range(-5.0..5.0))),
        };
        errors(&views, &moved, truth)
    };
    Ok([errors(&sets.full)?, errors(&sets.partial)?])
}

fn scene(path: &Path) -> Result<Errors, Failure> {
    let moved = Similarity { scale: 3.7, rotation: DQuat::IDENTITY, translation: DVec3::new(5.0, -2.0, 1.0) };
    errors(&Scene::load(path)?.inputs, &moved, |total| (total.translation, 0.5 * total.scale))
}

/// `truth` says where the object is, center and radius, in the frame that a similarity leads to.
fn errors(views: &[View], moved: &Similarity, truth: impl Fn(&Similarity) -> (DVec3, f64)) -> Result<Errors, Failure> {
    let seen_from = |views: &[View], to: &Similarity| -> Vec<View> {
        views.iter().map(|v| View { camera: v.camera.transformed(to), ..v.clone() }).collect()
    };
    let views = seen_from(views, moved);
    let rough = canonical_from_user(&views, &FrameConfig::default())?.canonical_from_user;
    let views = seen_from(&views, &rough);
    let cloud = initial_fit(&views, &InitialFitConfig::default(), 0, |_| ControlFlow::Continue(()))?;
    let total = rough.after(moved);
    let off = |total: &Similarity| {
        let (center, radius) = truth(total);
        [(radius / 0.5).ln().abs(), 0.5 * center.length() / radius]
    };
    let ([a, c], [b, d]) = (off(&total), off(&frame_of(&cloud, &views)?.after(&total)));
    Ok([a, b, c, d])
}

fn row(name: &str, errors: &[Errors]) {
    let n = errors.len() as f64;
    let shown = |f: &dyn Fn(&Errors) -> f64| {
        let mean = errors.iter().map(f).sum::<f64>() / n;
        let variance = errors.iter().map(|e| (f(e) - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
        format!("{mean:.4} ± {:.4}", 1.96 * (variance / n).sqrt())
    };
    let cells: Vec<String> =
        [0, 2].iter().flat_map(|&k| [shown(&|e| e[k]), shown(&|e| e[k + 1]), shown(&|e| e[k] - e[k + 1])]).collect();
    println!("| {name} | {} | {} |", errors.len(), cells.join(" | "));
}
