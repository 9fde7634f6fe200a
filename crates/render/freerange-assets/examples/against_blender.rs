//! Compares our renderer with Blender Cycles. `cargo run --release -p freerange-assets --example against_blender --
//! SHARED [OUTPUT]`, where SHARED holds `objects` and `views`; OUTPUT receives Blender's and our pictures side by side.
//!
//! Columns: overlap of the silhouettes (least and mean over the views), PSNR over white, Pearson's correlation and mean
//! difference (ours minus Blender's, of 255) where both cover a pixel, and the last three again for base colors alone.

use std::path::PathBuf;

#[path = "../tests/against/mod.rs"]
mod against;
use against::{Likeness, names, object, views};

fn main() {
    let mut args = std::env::args_os().skip(1).map(PathBuf::from);
    let Some(shared) = args.next() else {
        eprintln!("usage: against_blender SHARED [OUTPUT]");
        std::process::exit(2);
    };
    let output = args.next();
    println!("{:34} {:>6} {:>6} {:>6} {:>6} {:>6}  base colors", "", "IoU >=", "IoU", "PSNR", "corr", "bias");
    let mut table = Vec::new();
    for name in names(&shared) {
        let mesh = object(&shared, &name);
        let mut bare = mesh.clone();
        bare.materials.iter_mut().for_each(|m| m.unlit = true);
        let lit = views(&shared, &name, mesh);
        let flat = views(&shared, &name, bare);
        let compare = |pairs: &[(_, _)]| pairs.iter().map(|(a, b)| Likeness::new(a, b)).collect::<Vec<_>>();
        let (all, flat) = (compare(&lit), Likeness::mean(&compare(&flat)));
        let mean = Likeness::mean(&all);
        let least = all.iter().map(|l| l.iou).fold(1.0, f64::min);
        println!(
            "{name:34} {least:6.4} {:6.4} {:6.2} {:6.4} {:6.1}  {:6.2} {:6.4} {:6.1}",
            mean.iou, mean.psnr, mean.correlation, mean.bias, flat.psnr, flat.correlation, flat.bias
        );
        table.push(mean);
        if let Some(folder) = &output {
            std::fs::create_dir_all(folder).expect("a writable folder");
            // Four of the views, Blender's above ours.
            let (w, h) = lit[0].0.dimensions();
            let mut sheet = image::RgbaImage::from_pixel(4 * w, 2 * h, image::Rgba([255; 4]));
            for (i, (theirs, ours)) in lit.iter().step_by(3).take(4).enumerate() {
                image::imageops::overlay(&mut sheet, theirs, i64::from(w) * i as i64, 0);
                image::imageops::overlay(&mut sheet, ours, i64::from(w) * i as i64, i64::from(h));
            }
            sheet.save(folder.join(format!("{name}.png"))).expect("a writable folder");
        }
    }
    let mean = Likeness::mean(&table);
    println!("{:34} {:6} {:6.4} {:6.2} {:6.4} {:6.1}", "mean", "", mean.iou, mean.psnr, mean.correlation, mean.bias);
}
