//! Where the time goes from a seed to an object and its views, per family.
//!
//! `cargo bench -p freerange-assets --bench generate [-- FAMILY]`

use std::error::Error;
use std::time::{Duration, Instant};

use freerange_assets::generate::{GeneratorConfig, generate};
use freerange_assets::render::{CameraConfig, LightingConfig, Scene, orbit_cameras, render};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const VIEWS: usize = 4;

fn main() -> Result<(), Box<dyn Error>> {
    let family = std::env::args().skip(1).find(|a| !a.starts_with("--"));
    let generator = match &family {
        Some(kind) => GeneratorConfig::only(serde_json::from_value(kind.as_str().into())?),
        None => GeneratorConfig::default(),
    };
    println!("{:<12} {:>10} {:>10} {:>10} {:>9} {:>9}", "family", "generate", "worst", "scene", "triangles", "most");
    let mut total = [0.0; 2];
    let weights = generator.weights();
    let all: f32 = weights.iter().map(|w| w.1).sum();
    for (kind, weight) in weights {
        if weight == 0.0 {
            continue;
        }
        let config = GeneratorConfig::only(kind);
        let (mut spent, mut worst) = ([Duration::ZERO; 2], Duration::ZERO);
        let (mut triangles, mut most) = (0, 0);
        let n = 60u32;
        for seed in 0..u64::from(n) {
            let start = Instant::now();
            let mesh = generate(seed, &config)?;
            let one = start.elapsed();
            spent[0] += one;
            worst = worst.max(one);
            triangles += mesh.triangles.len();
            most = most.max(mesh.triangles.len());
            if seed < 6 {
                let start = Instant::now();
                let mut rng = ChaCha8Rng::seed_from_u64(seed);
                let scene = Scene::new(mesh, &LightingConfig::default().sample(&mut rng))?;
                for camera in &orbit_cameras(VIEWS, &mut rng, &CameraConfig::default()) {
                    render(&scene, camera, 2);
                }
                spent[1] += start.elapsed();
            }
        }
        let ms = |d: Duration, n: u32| 1e3 * d.as_secs_f64() / f64::from(n);
        let (a, b) = (ms(spent[0], n), ms(spent[1], 6));
        let name = format!("{kind:?}");
        println!("{name:<12} {a:>7.2} ms {:>7.1} ms {b:>7.1} ms {:>9} {most:>9}", ms(worst, 1), triangles / n as usize);
        let share = f64::from(weight / all);
        total = [total[0] + share * a, total[1] + share * b];
    }
    println!("mean by weight: generate {:.2} ms, scene and {VIEWS} views {:.1} ms", total[0], total[1]);
    Ok(())
}
