//! Both rasterizers for processors against vectors from an independent reference; `gpu.rs` does the same for GPUs.

#[path = "common/golden.rs"]
mod golden;

use freerange_raster::{reference, render, render_backward};
use golden::{cases, doubles};

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
                rgb: doubles(&case.tensors.floats("loss/w_rgb")[3 * i * pixels..3 * (i + 1) * pixels]),
                alpha: doubles(&case.tensors.floats("loss/w_alpha")[i * pixels..(i + 1) * pixels]),
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
        case.compare_gradients(&d_gaussians);
        case.compare_background_gradient(d_background);
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
        let (w_rgb, w_alpha) = (case.tensors.floats("loss/w_rgb"), case.tensors.floats("loss/w_alpha"));
        let grads = render_backward(&case.gaussians, &out, w_rgb, w_alpha, &[]).unwrap();
        let d_background = grads.backgrounds.iter().fold([0.0; 3], |mut sum, d| {
            (0..3).for_each(|c| sum[c] += f64::from(d[c]));
            sum
        });
        case.compare_gradients(&doubles(&grads.gaussians));
        case.compare_background_gradient(d_background);
    }
}
