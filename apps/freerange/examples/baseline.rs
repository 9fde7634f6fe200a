//! The baseline of docs/results.md as a file: 3DGS-MCMC on the input views alone, as `freerange eval --method fit` runs it.
//!
//! `cargo run --release -p freerange-cli --example baseline -- SCENE OUT.ply [PIXELS]`

use std::{error::Error, ops::ControlFlow, path::Path};

use freerange::{Scene, to_canonical, to_user};
use freerange_gaussians::write_ply;
use freerange_optim::{FitConfig, Rates, fit};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (scene, output, pixels) = match &arguments[..] {
        [scene, output] => (scene, output, 128),
        [scene, output, pixels] => (scene, output, pixels.parse()?),
        _ => return Err("expected SCENE OUT.ply [PIXELS]".into()),
    };
    let scene = Scene::open(Path::new(scene))?;
    let (frame, views) = to_canonical(scene.views(), &scene.frame)?;
    // The values of `eval --method fit`, which its settings.json records.
    let config = FitConfig {
        iterations: 2000,
        render_size: Some(pixels),
        rates: Rates { mean: 1.5e-3, scale: 5e-3, ..FitConfig::default().rates },
        final_mean_rate: 1.5e-5,
        ..FitConfig::default()
    };
    let fitted = fit(&views, None, &config, |_| ControlFlow::Continue(()))?;
    let gaussians = to_user(&fitted, &frame.canonical_from_user);
    println!("{output} ({} Gaussians)", gaussians.len());
    Ok(write_ply(&gaussians, Path::new(output))?)
}
