//! How well the canonical frame is found: scenes whose object is known to fill the sphere of radius 0.5 are moved,
//! turned about the vertical and scaled, and the frame is estimated anew.
//!
//! `cargo run --release -p freerange-scene --example canonical_accuracy -- FOLDER_OF_SCENES`

use freerange_scene::camera::{FrameConfig, Scene, Similarity, canonical_from_user};
use glam::{DQuat, DVec3};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = std::env::args().nth(1).ok_or("expected a folder of scenes")?;
    let mut scenes: Vec<_> = std::fs::read_dir(folder)?.flatten().map(|e| e.path()).filter(|p| p.is_dir()).collect();
    scenes.sort();
    println!("{:36} {:>9} {:>8} {:>9}", "scene", "identity", "scale", "center");
    for set in ["full", "partial"] {
        let (mut scales, mut centers) = (Vec::new(), Vec::new());
        for scene in &scenes {
            let views = Scene::load(&scene.join(format!("transforms_{set}.json")))?.inputs;
            let kept =
                canonical_from_user(&views, &FrameConfig::default())?.canonical_from_user == Similarity::IDENTITY;
            let (mut scale, mut center) = (Vec::new(), Vec::new());
            for turn in [0.0, 0.3, 0.8] {
                let moved = Similarity {
                    scale: 3.7,
                    rotation: DQuat::from_rotation_z(turn),
                    translation: DVec3::new(5.0, -2.0, 1.0),
                };
                let mut views = views.clone();
                views.iter_mut().for_each(|v| v.camera = v.camera.transformed(&moved));
                let found = canonical_from_user(&views, &FrameConfig::default())?.canonical_from_user;
                let total = found.after(&moved);
                scale.push(total.scale);
                center.push(total.translation.length());
            }
            let name = scene.file_name().unwrap_or_default().to_string_lossy();
            println!("{:36} {:>9} {:>8.3} {:>9.4}", format!("{name}/{set}"), kept, mean(&scale), mean(&center));
            scales.extend(scale.iter().map(|s| (s - 1.0).abs()));
            centers.extend(center);
        }
        let max = |v: &[f64]| v.iter().copied().fold(0.0, f64::max);
        println!("{set}: |scale - 1| mean {:.4} max {:.4}", mean(&scales), max(&scales));
        println!("{set}: distance of the center from the origin, mean {:.4} max {:.4}", mean(&centers), max(&centers));
    }
    Ok(())
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}
