//! Vectors from an independent reference in PyTorch float64 (gsplat's conventions). Masked pixels are those where float32
//! may take another branch.
#![allow(dead_code)] // each test file uses its own part

use freerange_raster::RasterConfig;
use freerange_scene::camera::Camera;
use freerange_vectors::{Vectors, json, path};
use glam::DMat4;

/// Tensors and their channels in a row of 14.
const CHANNELS: [(&str, std::ops::Range<usize>); 5] =
    [("means", 0..3), ("log_scales", 3..6), ("quats", 6..10), ("logit_opacities", 10..11), ("colors", 11..14)];

/// One scene, and what it should look like.
pub struct Case {
    pub name: String,
    pub tensors: Vectors,
    pub fragile: Vec<bool>, // [views, height, width]
    /// `[n, 14]`
    pub gaussians: Vec<f32>,
    pub cameras: Vec<Camera>,
    pub background: [f32; 3],
    pub config: RasterConfig,
}

impl Case {
    fn load(name: &str) -> Self {
        let tensors = Vectors::read(&format!("raster/{name}.safetensors"));
        let fragile = tensors.bytes("aux/fragile").iter().map(|v| *v != 0).collect();
        let meta = &json(&format!("raster/{name}.json"))["meta"];
        let number = |key: &str| meta[key].as_f64().unwrap();
        let n = number("N") as usize;
        let mut gaussians = vec![0.0; 14 * n];
        for (tensor, range) in CHANNELS {
            let values = tensors.floats(&format!("in/{tensor}"));
            for i in 0..n {
                gaussians[14 * i + range.start..14 * i + range.end]
                    .copy_from_slice(&values[i * range.len()..][..range.len()]);
            }
        }
        let (matrices, intrinsics) = (tensors.doubles("in/viewmats"), tensors.doubles("in/Ks"));
        let cameras = (0..number("C") as usize)
            .map(|i| {
                let k = &intrinsics[9 * i..9 * i + 9];
                Camera {
                    width: number("W") as u32,
                    height: number("H") as u32,
                    fx: k[0],
                    fy: k[4],
                    cx: k[2],
                    cy: k[5],
                    world_to_camera: DMat4::from_cols_slice(&matrices[16 * i..16 * i + 16]).transpose(),
                }
            })
            .collect();
        let background = tensors.floats("in/background").try_into().unwrap();
        let config = RasterConfig { near: number("near_plane") as f32, depth: true, ..RasterConfig::default() };
        Self { name: name.into(), tensors, fragile, gaussians, cameras, background, config }
    }

    /// Compares with the tensor `name`; `channels` values per pixel. The tolerance is relative to the largest value, plus absolute.
    pub fn compare_image(&self, name: &str, found: &[f64], relative: f64, absolute: f64) {
        let expected = self.tensors.floats(name);
        let channels = expected.len() / self.fragile.len();
        let alpha = self.tensors.floats("out/alpha");
        let skip = |pixel: usize| self.fragile[pixel] || (name == "out/depth_exp" && alpha[pixel] <= 1e-2);
        self.compare(name, found, relative, absolute, |i| skip(i / channels));
    }

    pub fn compare(&self, name: &str, found: &[f64], relative: f64, absolute: f64, skip: impl Fn(usize) -> bool) {
        let expected = self.tensors.floats(name);
        assert_eq!(found.len(), expected.len(), "{} {name}", self.name);
        let largest = expected.iter().fold(0.0, |m: f32, v| m.max(v.abs()));
        let mut worst = 0.0f64;
        for (i, (f, e)) in found.iter().zip(expected).enumerate().filter(|(i, _)| !skip(*i)) {
            let error = (f - f64::from(*e)).abs();
            worst = worst.max(error);
            let limit = relative * f64::from(largest) + absolute;
            assert!(error <= limit, "{} {name}[{i}]: {f}, expected {e}; limit {limit:e}", self.name);
        }
        println!("{:34} {name:20} error {worst:.1e}, {:.1e} of the largest", self.name, worst / f64::from(largest));
    }

    pub fn compare_gradients(&self, d_gaussians: &[f64]) {
        for (tensor, range) in CHANNELS {
            let found: Vec<f64> = d_gaussians.chunks(14).flat_map(|row| row[range.clone()].to_vec()).collect();
            self.compare(&format!("grad/{tensor}"), &found, 3e-4, 1e-5, |_| false);
        }
    }

    pub fn compare_background_gradient(&self, d_background: [f64; 3]) {
        self.compare("grad/background", &d_background, 3e-4, 1e-5, |_| false);
    }
}

/// All of them.
pub fn cases() -> Vec<Case> {
    let mut names: Vec<String> = std::fs::read_dir(path("raster"))
        .unwrap()
        .filter_map(|e| e.unwrap().file_name().to_str()?.strip_suffix(".json").map(String::from))
        .collect();
    names.sort();
    assert!(names.len() >= 14, "{names:?}");
    names.iter().map(|name| Case::load(name)).collect()
}

pub fn doubles(values: &[f32]) -> Vec<f64> {
    values.iter().map(|v| f64::from(*v)).collect()
}
