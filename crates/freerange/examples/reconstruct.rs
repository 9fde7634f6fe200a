//! `cargo run --release -p freerange --example reconstruct -- examples/bowl gaussians.ply`

use std::{error::Error, ops::ControlFlow, path::Path};

use freerange::{DeviceName, Reconstructor, Scene, score, write_ply};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [scene, output] = &arguments[..] else { return Err("expected SCENE and OUTPUT.ply".into()) };
    let scene = Scene::open(Path::new(scene))?;
    let model = Reconstructor::shipped(&DeviceName::Auto.open()?)?;
    let mut options = model.options()?;
    options.frame = scene.frame;
    let result = model.run(scene.views(), &options, &mut |progress| {
        // The Gaussians by now, whenever one likes to look.
        if progress.done.is_multiple_of(10)
            && let Ok(Some(preview)) = progress.preview()
        {
            eprintln!("{} {} of {}: {} Gaussians", progress.stage, progress.done, progress.total, preview.len());
        }
        ControlFlow::Continue(())
    })?;
    let gaussians = &result.samples[0].gaussians;
    println!("{:.2} dB on the input views", score(gaussians, scene.views())?.map_or(f64::NAN, |s| s.psnr));
    Ok(write_ply(gaussians, Path::new(output))?)
}
