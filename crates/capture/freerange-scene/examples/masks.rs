//! How good masks from poses and colors, or a network's, are: intersection over union with true masks, for every photo.
//!
//! `masks SCENES [--views N] [--mask-model FILE.onnx RANGE]`: folders as `freerange reconstruct` takes them, each with `truth/masks/NAME.png`, which are only compared
//! with. `--views N` uses the first N photos only; `--write FOLDER` writes the masks; `--mask-model`
//! as in the program (`--features mask-model`).

use freerange_scene::{LoadConfig, MaskModel, MaskSource, PixelRange, estimate::overlap, load, read, write_masks};
use std::{path::Path, time::Instant};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut scenes = Vec::new();
    let (mut count, mut write, mut masks) = (usize::MAX, None, MaskSource::Estimate);
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--views" => count = args.next().ok_or("--views N")?.parse()?,
            "--write" => write = args.next(),
            "--mask-model" => {
                let (file, range) = args.next().zip(args.next()).ok_or("--mask-model FILE.onnx RANGE")?;
                let (_, pixels) = PixelRange::ALL.into_iter().find(|(name, _)| *name == range).ok_or("RANGE")?;
                masks = MaskSource::Model(MaskModel { file: file.into(), pixels });
            }
            _ => scenes.push(arg),
        }
    }
    let mut all = Vec::new();
    for scene in scenes {
        let scene = Path::new(&scene);
        let mut cameras = read::cameras(scene, None, None)?;
        cameras.photos.truncate(count);
        let begin = Instant::now();
        let estimated = load(&cameras, &LoadConfig { masks: masks.clone(), ..LoadConfig::default() });
        let seconds = begin.elapsed().as_secs_f64();
        let estimated = match estimated {
            Ok(estimated) => estimated,
            Err(e) => {
                println!("{}: {e}", scene.display());
                continue;
            }
        };
        let truth = LoadConfig { masks: MaskSource::Files(scene.join("truth/masks")), ..LoadConfig::default() };
        let truth = load(&cameras, &truth)?;
        let solid = |image: &image::RgbaImage| image.pixels().map(|p| p[3] >= 128).collect::<Vec<bool>>();
        let shares: Vec<f64> = estimated
            .views
            .iter()
            .zip(&truth.views)
            .map(|(a, b)| overlap(&solid(&a.image), &solid(&b.image)))
            .collect();
        let mean = shares.iter().sum::<f64>() / shares.len() as f64;
        let sure = estimated.estimate.as_ref().map_or(0.0, |e| e.sureness());
        println!("{}: mean {mean:.4}, sureness {sure:.3}, {seconds:.1} s", scene.display());
        for note in &estimated.notes {
            println!("  ({note})");
        }
        if let Some(estimate) = &estimated.estimate {
            for (i, view) in estimated.views.iter().enumerate() {
                let (share, agreement, clearness) = (shares[i], estimate.agreement[i], estimate.clearness[i]);
                println!("  {:20} IoU {share:.4}  agreement {agreement:.3}  clearness {clearness:.3}", view.name);
            }
        }
        if let Some(folder) = &write {
            write_masks(&Path::new(folder).join(scene.file_name().unwrap_or_default()), &cameras, &estimated)?;
        }
        all.extend(shares);
    }
    println!(
        "all: mean {:.4}, least {:.4}",
        all.iter().sum::<f64>() / all.len() as f64,
        all.iter().copied().fold(1.0, f64::min)
    );
    Ok(())
}
