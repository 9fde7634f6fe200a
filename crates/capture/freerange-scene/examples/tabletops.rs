//! Photos of generated objects on tables, as folders like those of a user, with the truth beside them: what is measured in dB for photos is
//! chosen on these.
//!
//! `cargo run --release -p freerange-scene --example tabletops -- FIRST_SEED SCENES OUT [PHOTOS]`, then `python tools/photos.py OUT RESULTS`. In
//! each folder eight photos (or PHOTOS) with their cameras (`transforms.json`), their true masks (`truth/masks`), and as many other views of
//! the object alone (`transforms_val.json`). Scenes in which a border cuts the object, or whose photos are of two shapes, are left out.

use std::{error::Error, f64::consts::TAU, fs, path::Path};

use freerange_scene::camera::transforms_json;
use image::{GrayImage, Luma, RgbaImage};

#[path = "../tests/tabletop/mod.rs"]
mod tabletop;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (first, scenes, out, photos) = match arguments.as_slice() {
        [first, scenes, out] => (first, scenes, out, 8),
        [first, scenes, out, photos] => (first, scenes, out, photos.parse()?),
        _ => return Err("expected FIRST_SEED SCENES OUT [PHOTOS]".into()),
    };
    let (first, scenes): (u64, usize) = (first.parse()?, scenes.parse()?);
    // Every other one is a photo, the rest is to compare with.
    let cameras = 2 * photos;
    let mut seeds = first..;
    for _ in 0..scenes {
        let (seed, scene) = seeds
            .by_ref()
            .map(|seed| (seed, tabletop::tabletop(seed, cameras, TAU, (640, 480))))
            .find(|(_, scene)| scene.alone.iter().all(|i| i.dimensions() == scene.alone[0].dimensions() && whole(i)))
            .ok_or("no more seeds")?;
        let folder = Path::new(out).join(format!("tabletop-{seed}"));
        for part in ["images", "truth/masks", "val"] {
            fs::create_dir_all(folder.join(part))?;
        }
        let (mut photos, mut others) = (Vec::new(), Vec::new());
        for (i, (view, alone)) in scene.views.iter().zip(&scene.alone).enumerate() {
            if i % 2 == 0 {
                let name = format!("images/{i:02}.png");
                view.image.save(folder.join(&name))?;
                let mask = GrayImage::from_fn(alone.width(), alone.height(), |x, y| Luma([alone.get_pixel(x, y)[3]]));
                mask.save(folder.join(format!("truth/masks/{i:02}.png.png")))?;
                photos.push((name, view.camera));
            } else {
                let name = format!("val/{i:02}.png");
                alone.save(folder.join(&name))?;
                others.push((name, view.camera));
            }
        }
        fs::write(folder.join("transforms.json"), transforms_json(&photos))?;
        fs::write(folder.join("transforms_val.json"), transforms_json(&others))?;
        println!("{}: {}", folder.display(), scene.what);
    }
    Ok(())
}

/// Whether no border cuts the object.
fn whole(alone: &RgbaImage) -> bool {
    let (w, h) = alone.dimensions();
    alone.enumerate_pixels().all(|(x, y, p)| p[3] == 0 || (x > 0 && y > 0 && x + 1 < w && y + 1 < h))
}
