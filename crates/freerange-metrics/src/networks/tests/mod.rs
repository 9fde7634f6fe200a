//! The networks against PyTorch's results, and what they do to known changes of an image.

mod behaviour;
mod dreamsim;
mod files;
mod inception;
mod lpips;
mod resize;
mod speed;

use std::{collections::HashMap, path::PathBuf};

use burn::tensor::{Device, Tensor, TensorData};
use safetensors::SafeTensors;

use super::{resize::Image8, source::Source};
use crate::MetricsError;

fn device() -> Device {
    Device::flex()
}

pub(super) fn golden(name: &str) -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/metrics")).join(name)
}

/// A file of vectors.
struct Vectors {
    floats: HashMap<String, (Vec<usize>, Vec<f32>)>,
    images: HashMap<String, Image8>,
}

impl Vectors {
    fn open(path: &std::path::Path) -> Self {
        let bytes = std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let (mut floats, mut images) = (HashMap::new(), HashMap::new());
        for (name, view) in file.iter() {
            let shape = view.shape().to_vec();
            match view.dtype() {
                safetensors::Dtype::U8 => {
                    let image = Image8 { width: shape[1], height: shape[0], values: view.data().to_vec() };
                    images.insert(name.to_owned(), image);
                }
                safetensors::Dtype::F16 => {
                    let f16 = |b: &[u8; 2]| burn::tensor::f16::from_le_bytes(*b).to_f32();
                    floats.insert(name.to_owned(), (shape, view.data().as_chunks().0.iter().map(f16).collect()));
                }
                _ => {
                    let f32 = |b: &[u8; 4]| f32::from_le_bytes(*b);
                    floats.insert(name.to_owned(), (shape, view.data().as_chunks().0.iter().map(f32).collect()));
                }
            }
        }
        Self { floats, images }
    }

    fn values(&self, name: &str) -> &[f32] {
        &self.floats[name].1
    }

    fn tensor(&self, name: &str) -> Tensor<4> {
        let (shape, values) = &self.floats[name];
        Tensor::from_data(TensorData::new(values.clone(), shape.clone()), &device())
    }
}

fn json(path: PathBuf) -> serde_json::Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
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
