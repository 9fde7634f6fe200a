//! Both rasterisers against vectors from an independent reference in PyTorch float64 (gsplat's
//! conventions). Masked pixels are those where float32 may take another branch.

use freerange_camera::Camera;
use freerange_raster::{RasterConfig, reference, render, render_backward};
use glam::DMat4;
use safetensors::SafeTensors;
use std::collections::BTreeMap;

const FOLDER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/raster");
/// Tensors and their channels in a row of 14.
const CHANNELS: [(&str, std::ops::Range<usize>); 5] =
    [("means", 0..3), ("log_scales", 3..6), ("quats", 6..10), ("logit_opacities", 10..11), ("colors", 11..14)];

struct Case {
    name: String,
    tensors: BTreeMap<String, Vec<f32>>,
    fragile: Vec<bool>, // [views, height, width]
    gaussians: Vec<f32>,
    cameras: Vec<Camera>,
    background: [f32; 3],
    config: RasterConfig,
}

impl Case {
    fn load(name: &str) -> Self {
        let bytes = std::fs::read(format!("{FOLDER}/{name}.safetensors")).unwrap();
        let json: serde_json::Value =
            serde_json::from_slice(&std::fs::read(format!("{FOLDER}/{name}.json")).unwrap()).unwrap();
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let mut tensors = BTreeMap::new();
        let mut fragile = vec![];
        for (name, view) in file.tensors() {
            match view.dtype() {
                safetensors::Dtype::F32 => {
                    let floats: Vec<f32> =
                        view.data().as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
                    tensors.insert(name.to_string(), floats);
                }
                safetensors::Dtype::U8 if name == "aux/fragile" => {
                    fragile = view.data().iter().map(|v| *v != 0).collect()
                }
                _ => {}
            }
        }
        let meta = &json["meta"];
        let number = |key: &str| meta[key].as_f64().unwrap();
        let n = number("N") as usize;
        let mut gaussians = vec![0.0; 14 * n];
        for (tensor, range) in CHANNELS {
            let values = &tensors[&format!("in/{tensor}")];
            for i in 0..n {
                gaussians[14 * i + range.start..14 * i + range.end]
                    .copy_from_slice(&values[i * range.len()..][..range.len()]);
            }
        }
        let f64s = |name: &str| -> Vec<f64> { tensors[name].iter().map(|v| f64::from(*v)).collect() };
        let (matrices, intrinsics) = (f64s("in/viewmats"), f64s("in/Ks"));
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
        let background = tensors["in/background"].as_slice().try_into().unwrap();
        let config = RasterConfig { near: number("near_plane") as f32, depth: true, ..RasterConfig::default() };
        Self { name: name.into(), tensors, fragile, gaussians, cameras, background, config }
    }

    /// Compares with the tensor `name`; `channels` values per pixel. The tolerance is relative to the largest value, plus absolute.
    fn compare_image(&self, name: &str, found: &[f64], relative: f64, absolute: f64) {
        let expected = &self.tensors[name];
        let channels = expected.len() / self.fragile.len();
        let alpha = &self.tensors["out/alpha"];
        let skip = |pixel: usize| self.fragile[pixel] || (name == "out/depth_exp" && alpha[pixel] <= 1e-2);
        self.compare(name, found, relative, absolute, |i| skip(i / channels));
    }

    fn compare(&self, name: &str, found: &[f64], relative: f64, absolute: f64, skip: impl Fn(usize) -> bool) {
        let expected = &self.tensors[name];
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

    fn compare_gradients(&self, d_gaussians: &[f64], d_background: [f64; 3]) {
        for (tensor, range) in CHANNELS {
            let found: Vec<f64> = d_gaussians.chunks(14).flat_map(|row| row[range.clone()].to_vec()).collect();
            self.compare(&format!("grad/{tensor}"), &found, 3e-4, 1e-5, |_| false);
        }
        self.compare("grad/background", &d_background, 3e-4, 1e-5, |_| false);
    }
}

fn cases() -> Vec<Case> {
    let mut names: Vec<String> = std::fs::read_dir(FOLDER)
        .unwrap()
        .filter_map(|e| e.unwrap().file_name().to_str()?.strip_suffix(".json").map(String::from))
        .collect();
    names.sort();
    assert!(names.len() >= 14, "{names:?}");
    names.iter().map(|name| Case::load(name)).collect()
}

fn doubles(values: &[f32]) -> Vec<f64> {
    values.iter().map(|v| f64::from(*v)).collect()
}

fn expected_depth(depth: &[f64], alpha: &[f64]) -> Vec<f64> {
    depth.iter().zip(alpha).map(|(d, a)| d / a.max(1e-10)).collect()
}

#[test]
fn reference_matches_golden_vectors() {
    for case in cases() {
        let (mut rgb, mut alpha, mut depth) = (vec![], vec![], vec![]);
        let mut d_gaussians = vec![0.0; case.gaussians.len()];
        let mut d_background = [0.0; 3];
        let pixels = case.fragile.len() / case.cameras.len();
        for (i, camera) in case.cameras.iter().enumerate() {
            let image = reference::render(&case.gaussians, camera, case.background, &case.config);
            rgb.extend(image.rgb);
            alpha.extend(image.alpha);
            depth.extend(image.depth);
            let grad = reference::ImageGrad {
                rgb: doubles(&case.tensors["loss/w_rgb"][3 * i * pixels..3 * (i + 1) * pixels]),
                alpha: doubles(&case.tensors["loss/w_alpha"][i * pixels..(i + 1) * pixels]),
                depth: vec![0.0; pixels],
            };
            let (d, b) = reference::render_backward(&case.gaussians, camera, case.background, &case.config, &grad);
            d_gaussians.iter_mut().zip(d).for_each(|(sum, v)| *sum += v);
            (0..3).for_each(|c| d_background[c] += b[c]);
        }
        // Only the vectors' own rounding to float32 separates the two.
        case.compare_image("out/rgb", &rgb, 2e-6, 0.0);
        case.compare_image("out/alpha", &alpha, 1e-6, 0.0);
        case.compare_image("out/depth_acc", &depth, 1e-6, 0.0);
        case.compare_image("out/depth_exp", &expected_depth(&depth, &alpha), 1e-6, 0.0);
        case.compare_gradients(&d_gaussians, d_background);
    }
}

#[test]
fn cpu_matches_golden_vectors() {
    for case in cases() {
        let backgrounds = vec![case.background; case.cameras.len()];
        let out = render(&case.gaussians, &case.cameras, &backgrounds, &case.config).unwrap();
        let (alpha, depth) = (doubles(&out.alpha), doubles(&out.depth));
        case.compare_image("out/rgb", &doubles(&out.rgb), 0.0, 1e-4);
        case.compare_image("out/alpha", &alpha, 0.0, 1e-4);
        case.compare_image("out/depth_acc", &depth, 2e-4, 1e-4);
        case.compare_image("out/depth_exp", &expected_depth(&depth, &alpha), 2e-3, 1e-3);
        let (w_rgb, w_alpha) = (&case.tensors["loss/w_rgb"], &case.tensors["loss/w_alpha"]);
        let grads = render_backward(&case.gaussians, &out, w_rgb, w_alpha, &[]).unwrap();
        let d_background = grads.backgrounds.iter().fold([0.0; 3], |mut sum, d| {
            (0..3).for_each(|c| sum[c] += f64::from(d[c]));
            sum
        });
        case.compare_gradients(&doubles(&grads.gaussians), d_background);
    }
}
