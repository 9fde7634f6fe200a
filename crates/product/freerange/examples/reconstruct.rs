//! `cargo run --release -p freerange --example reconstruct -- examples/bowl gaussians.ply`

use std::{error::Error, path::Path};

use freerange::{Device, Reconstructor, Scene, score};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [scene, output] = &arguments[..] else { return Err("expected SCENE and OUTPUT, such as gaussians.ply".into()) };
    let scene = Scene::open(Path::new(scene))?;
    let model = Reconstructor::shipped(&Device::open("auto")?)?;
    let result = model.reconstruct(&scene)?;
    let notes = result.write(Path::new(output))?;
    scene.notes.iter().chain(&result.notes).chain(&notes).for_each(|note| eprintln!("{note}"));
    let scores = score(&result.samples[0].gaussians, scene.views())?;
    println!("{:.2} dB on the input views", scores.map_or(f64::NAN, |s| s.psnr));
    Ok(())
}
