//! What better geometry could bring: a refinement that starts from one layer of Gaussians on an object's true surface.
//!
//! `cargo run --release -p freerange-eval --example true_surface -- RESULT.ply SCENE/transforms_full.json MESH.glb OUT.ply [STEPS]`
//!
//! The result, the scene and the mesh are those of `freerange eval --scenes --meshes`; `freerange eval --method ply` scores what comes out.

use std::{error::Error, ops::ControlFlow, path::Path};

use freerange_camera::Scene;
use freerange_eval::MeshSurface;
use freerange_fit::{RefineConfig, refine_on_surface};
use freerange_mesh::{LoadLimits, load_mesh};
use freerange_splat::{read_ply, write_ply};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [result, scene, mesh, out, steps @ ..] = arguments.as_slice() else {
        return Err("expected RESULT.ply SCENE/transforms_full.json MESH.glb OUT.ply [STEPS]".into());
    };
    let cloud = read_ply(Path::new(result))?.splats.cloud;
    let photos = Scene::load(Path::new(scene))?.inputs;
    let surface = MeshSurface::new(&load_mesh(Path::new(mesh), &LoadLimits::default())?.mesh);
    let longest = photos.iter().map(|v| v.image.width().max(v.image.height())).max().unwrap_or(0);
    let config = RefineConfig::default().detailed(2, longest);
    let steps = steps.first().map_or(Ok(config.steps), |steps| steps.parse())?;
    let config = RefineConfig { steps, ..config };
    let distance = |at: glam::DVec3| f64::from(surface.nearest(at.as_vec3()).distance);
    let refined = refine_on_surface(&cloud, distance, &photos, &config, |p| {
        eprint!("\r{} of {} steps, loss {:.4}", p.step, p.steps, p.loss);
        ControlFlow::Continue(())
    })?;
    eprintln!();
    Ok(write_ply(&refined, Path::new(out))?)
}
