//! Against vectors of PyTorch's and scikit-image's own results.

use freerange_raster::metrics::*;
use freerange_vectors::{Vectors, json_at};

struct Case {
    name: String,
    width: usize,
    height: usize,
    first: Vec<f32>,
    second: Vec<f32>,
    tensors: Vectors,
    scalars: serde_json::Value,
}

/// `[3, h, w]` to `[h, w, 3]`.
fn interleaved(planes: &[f32]) -> Vec<f32> {
    let n = planes.len() / 3;
    (0..3 * n).map(|i| planes[(i % 3) * n + i / 3]).collect()
}

fn cases() -> Vec<Case> {
    let mut out = Vec::new();
    for entry in std::fs::read_dir(freerange_vectors::path("metrics")).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_string_lossy().into_owned();
        if !name.starts_with("img") || path.extension().unwrap() != "safetensors" {
            continue;
        }
        let json = json_at(&path.with_extension("json"));
        let tensors = Vectors::open(&path);
        out.push(Case {
            name,
            width: json["meta"]["W"].as_u64().unwrap() as usize,
            height: json["meta"]["H"].as_u64().unwrap() as usize,
            first: interleaved(tensors.floats("in/img1")),
            second: interleaved(tensors.floats("in/img2")),
            tensors,
            scalars: json["scalars_f64"].clone(),
        });
    }
    assert_eq!(out.len(), 10);
    out
}

#[test]
fn values() {
    for c in cases() {
        let expect = |key: &str, found: f64, tolerance: f64| {
            let expected = &c.scalars[key];
            match expected.as_f64() {
                Some(e) => assert!((e - found).abs() <= tolerance, "{} {key}: expected {e}, found {found}", c.name),
                // An infinite PSNR is no JSON number.
                None => assert!(found.is_infinite(), "{} {key}: expected {expected}, found {found}", c.name),
            }
        };
        expect("mse", mse(&c.first, &c.second).unwrap(), 1e-7);
        expect("l1", l1(&c.first, &c.second).unwrap(), 1e-7);
        expect("psnr", psnr(&c.first, &c.second).unwrap(), 1e-4);
        expect("ssim_3dgs", ssim_3dgs(&c.first, &c.second, c.width, c.height).unwrap(), 1e-4);
        if c.width.min(c.height) < 11 {
            let error = ssim_skimage_gauss(&c.first, &c.second, c.width, c.height).unwrap_err();
            assert_eq!(error, ImageError::TooSmall { needed: 11, height: c.height, width: c.width });
        } else {
            expect("ssim_skimage_gauss", ssim_skimage_gauss(&c.first, &c.second, c.width, c.height).unwrap(), 1e-6);
            expect("ssim_pixelsplat", ssim_skimage_sample(&c.first, &c.second, c.width, c.height).unwrap(), 1e-6);
        }
    }
}

#[test]
fn gradients() {
    for c in cases() {
        let (ssim, ssim_gradient) = ssim_with_gradient(&c.first, &c.second, c.width, c.height).unwrap();
        assert_eq!(ssim, ssim_3dgs(&c.first, &c.second, c.width, c.height).unwrap());
        let (loss, loss_gradient) = photometric_loss(&c.first, &c.second, c.width, c.height, 0.2).unwrap();
        let expected = 0.8 * l1(&c.first, &c.second).unwrap() + 0.2 * (1.0 - ssim);
        assert!((loss - expected).abs() < 1e-7);
        for (key, found) in [("grad/ssim_3dgs_img1", ssim_gradient), ("grad/dssim_loss_img1", loss_gradient)] {
            let expected = interleaved(c.tensors.floats(key));
            let largest = expected.iter().fold(0.0f32, |m, v| m.max(v.abs()));
            // Where the true gradient is (nearly) zero, what counts is the size of one pixel's share, 1 / n.
            let tolerance = 1e-3 * largest.max(1.0 / expected.len() as f32);
            let worst = expected.iter().zip(&found).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
            assert!(worst <= tolerance, "{} {key}: off by {worst}, largest {largest}", c.name);
        }
    }
}
