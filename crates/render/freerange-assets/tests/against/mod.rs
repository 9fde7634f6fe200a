//! Pictures of our renderer beside those of Blender Cycles: the shared folder's `objects/NAME.glb` and `views/NAME`.

use std::path::Path;

use freerange_assets::mesh::{LoadLimits, Mesh, load_mesh};
use freerange_assets::render::{Lighting, Scene, render};
use image::RgbaImage;

/// The objects, in alphabetical order.
pub fn names(shared: &Path) -> Vec<String> {
    let mut names: Vec<String> = std::fs::read_dir(shared.join("views"))
        .expect("the shared folder holds `views`")
        .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
        .filter(|name| shared.join("views").join(name).join("transforms_val.json").exists())
        .collect();
    names.sort();
    names
}

/// An object as it was lit for Blender.
pub fn object(shared: &Path, name: &str) -> Mesh {
    let path = shared.join("objects").join(name).with_extension("glb");
    load_mesh(&path, &LoadLimits::default()).expect("a readable object").mesh
}

/// The object's views, as Blender and as we see them.
pub fn views(shared: &Path, name: &str, mesh: Mesh) -> Vec<(RgbaImage, RgbaImage)> {
    let scene = Scene::new(mesh, &Lighting::default()).expect("a sound mesh");
    let file = shared.join("views").join(name).join("transforms_val.json");
    let theirs = freerange_scene::camera::Scene::load(&file).expect("posed pictures");
    theirs
        .inputs
        .into_iter()
        .map(|view| {
            let ours = render(&scene, &view.camera, 2);
            (view.image, ours)
        })
        .collect()
}

/// How alike two pictures are.
#[derive(Clone, Copy, Default)]
pub struct Likeness {
    /// Intersection over union of the pixels of alpha at least 1/2.
    pub iou: f64,
    /// Peak signal to noise ratio in dB over white.
    pub psnr: f64,
    /// Pearson's correlation of the sRGB values where both cover the pixel.
    pub correlation: f64,
    /// Mean of ours minus theirs there, in units of 1/255.
    pub bias: f64,
}

impl Likeness {
    /// Compares pictures of the same size.
    pub fn new(theirs: &RgbaImage, ours: &RgbaImage) -> Self {
        assert_eq!(theirs.dimensions(), ours.dimensions());
        let (mut both, mut either, mut error) = (0.0, 0.0, 0.0);
        let (mut n, mut x, mut y, mut xx, mut yy, mut xy) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        for (a, b) in theirs.pixels().zip(ours.pixels()) {
            both += f64::from(u8::from(a[3] >= 128 && b[3] >= 128));
            either += f64::from(u8::from(a[3] >= 128 || b[3] >= 128));
            let over_white = |p: &image::Rgba<u8>, k: usize| {
                let alpha = f64::from(p[3]) / 255.0;
                f64::from(p[k]) / 255.0 * alpha + 1.0 - alpha
            };
            for k in 0..3 {
                error += (over_white(a, k) - over_white(b, k)).powi(2);
                if a[3] == 255 && b[3] == 255 {
                    let (p, q) = (f64::from(a[k]), f64::from(b[k]));
                    (n, x, y) = (n + 1.0, x + p, y + q);
                    (xx, yy, xy) = (xx + p * p, yy + q * q, xy + p * q);
                }
            }
        }
        let pixels = f64::from(3 * theirs.width() * theirs.height());
        Self {
            iou: both / either,
            psnr: -10.0 * (error / pixels).log10(),
            correlation: (n * xy - x * y) / ((n * xx - x * x) * (n * yy - y * y)).sqrt(),
            bias: (y - x) / n,
        }
    }

    /// The mean over several pairs.
    pub fn mean(all: &[Self]) -> Self {
        let mean = |f: fn(&Self) -> f64| all.iter().map(f).sum::<f64>() / all.len() as f64;
        Self {
            iou: mean(|l| l.iou),
            psnr: mean(|l| l.psnr),
            correlation: mean(|l| l.correlation),
            bias: mean(|l| l.bias),
        }
    }
}
