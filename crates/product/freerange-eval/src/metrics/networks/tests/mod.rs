//! The networks against PyTorch's results, and what they do to known changes of an image.

mod behavior;
mod dreamsim;
mod files;
mod inception;
mod lpips;
mod resize;
mod speed;

use std::path::PathBuf;

use burn::tensor::{Device, Tensor, TensorData};
use freerange_vectors::Vectors;

use super::{resize::Image8, source::Source};
use crate::metrics::MetricsError;

fn device() -> Device {
    Device::flex()
}

pub(super) fn golden(name: &str) -> PathBuf {
    freerange_vectors::path("metrics").join(name)
}

fn image(vectors: &Vectors, name: &str) -> Image8 {
    let shape = vectors.shape(name);
    Image8 { width: shape[1], height: shape[0], values: vectors.bytes(name).to_vec() }
}

fn tensor(vectors: &Vectors, name: &str) -> Tensor<4> {
    Tensor::from_data(TensorData::new(vectors.floats(name).to_vec(), vectors.shape(name).to_vec()), &device())
}

/// `low..high` by splitmix64, 24 bits each.
fn uniform(seed: u64, n: usize, low: f32, high: f32) -> Vec<f32> {
    (1..=n as u64)
        .map(|i| {
            let mut z = seed.wrapping_add(i.wrapping_mul(0x9E37_79B9_7F4A_7C15));
            z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
            z ^= z >> 31;
            low + (z >> 40) as f32 / (1u64 << 24) as f32 * (high - low)
        })
        .collect()
}

/// Weights that depend on their name and shape alone, as `tools/metric_vectors.py` makes them.
struct Random;

impl Source for Random {
    fn values(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, MetricsError> {
        let mut seed = 0xCBF2_9CE4_8422_2325_u64;
        for byte in name.bytes() {
            seed = (seed ^ u64::from(byte)).wrapping_mul(0x100_0000_01B3);
        }
        let (low, high) = match shape {
            _ if name.ends_with("running_var") => (0.5, 1.5),
            _ if name.ends_with("bn.weight") || name.contains("norm") && name.ends_with("weight") => (0.8, 1.2),
            _ if name.starts_with("lin") => (0.0, 1.0), // the published ones are not negative either
            [_, inputs @ ..] if shape.len() >= 2 && !name.contains("embed") && !name.contains("token") => {
                let bound = (6.0 / inputs.iter().product::<usize>() as f64).sqrt() as f32;
                (-bound, bound)
            }
            _ => (-0.1, 0.1),
        };
        Ok(uniform(seed, shape.iter().product(), low, high))
    }
}

fn close(found: &[f32], expected: &[f32], tolerance: f32) {
    assert_eq!(found.len(), expected.len());
    let worst = found.iter().zip(expected).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
    assert!(worst <= tolerance, "off by {worst}, tolerance {tolerance}");
}
