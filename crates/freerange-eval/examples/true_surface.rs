//! What better geometry could bring: one opaque layer of Gaussians on an object's true surface, optimized as that of `refine` is.
//!
//! `cargo run --release -p freerange-eval --example true_surface -- RESULT.ply SCENE/transforms_full.json MESH.glb OUT.ply [STEPS] [POINTS]`
//!
//! The result, the scene and the mesh are those of `freerange eval --scenes --meshes`; `freerange eval --method ply` scores what comes out.

use std::{error::Error, ops::ControlFlow, path::Path};

use freerange_camera::Scene;
use freerange_eval::MeshSurface;
use freerange_fit::{LayerConfig, RefineConfig, refine_on_surface};
use freerange_mesh::{LoadLimits, load_mesh};
use freerange_splat::{read_ply, write_ply};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [result, scene, mesh, out, numbers @ ..] = arguments.as_slice() else {
        return Err("expected RESULT.ply SCENE/transforms_full.json MESH.glb OUT.ply [STEPS] [POINTS]".into());
    };
    let number = |i: usize, default: usize| numbers.get(i).map_or(Ok(default), |n| n.parse());
    let layer = LayerConfig { steps: number(0, 80)?, points: number(1, 40_000)?, ..LayerConfig::default() };
    let cloud = read_ply(Path::new(result))?.splats.cloud;
    let photos = Scene::load(Path::new(scene))?.inputs;
    let surface = MeshSurface::new(&load_mesh(Path::new(mesh), &LoadLimits::default())?.mesh);
    let longest = photos.iter().map(|v| v.image.width().max(v.image.height())).max().unwrap_or(0);
    let config = RefineConfig { layer, ..RefineConfig::default().detailed(2, longest) };
    let distance = |at: glam::DVec3| f64::from(surface.nearest(at.as_vec3()).distance);
    let refined = refine_on_surface(&cloud, distance, &photos, &config, |p| {
        eprint!("\r{} of {} steps, loss {:.4}", p.step, p.steps, p.loss);
        ControlFlow::Continue(())
    })?;
    eprintln!();
    Ok(write_ply(&refined, Path::new(out))?)
}
