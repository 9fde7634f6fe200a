//! Image tokens: features, position, color and ray of each patch.

use burn::tensor::{Device, Tensor, TensorData};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::{assert_close, numbers, path};
use crate::{Dinov2, EncoderConfig, FreeRange, ModelConfig, PatchConfig, position_embedding};

fn config(encoder: EncoderConfig, image_size: u32) -> ModelConfig {
    ModelConfig { image_size, encoder, hidden: 16, blocks: 1, heads: 2, registers: 1, ..ModelConfig::default() }
}

fn model(config: &ModelConfig) -> FreeRange {
    FreeRange::new(config, &mut ChaCha8Rng::seed_from_u64(5), &Device::flex()).unwrap()
}

fn counting<const D: usize>(shape: [usize; D], step: f32) -> Tensor<D> {
    let n: usize = shape.iter().product();
    Tensor::from_data(TensorData::new((0..n).map(|i| i as f32 * step).collect::<Vec<_>>(), shape), &Device::flex())
}

#[test]
fn a_token_holds_its_patch_position_color_and_ray() {
    let (b, views, side, p, c) = (2, 3, 8, 4, 4);
    let encoder = EncoderConfig::Patch(PatchConfig { patch_size: p as u32, channels: c });
    let config = config(encoder, side as u32);
    let n = b * views * side * side * c;
    let images = counting([b, views, side, side, c], 1.0 / n as f32);
    let rays = counting([b, views, 2, 2, 6], 0.01);
    let tokens = model(&config).encode(images.clone(), rays.clone());
    let width = p * p * c + 32 + 3 + 6;
    assert_eq!(tokens.dims(), [b, views * 4, width]);
    let (tokens, images, rays) = (numbers(tokens), numbers(images), numbers(rays));
    let positions = position_embedding(2, 2, 32);
    // Spelled out, token by token.
    for (i, token) in tokens.chunks_exact(width).enumerate() {
        let (image, row, column) = (i / 4, i / 2 % 2, i % 2);
        let pixel = |y: usize, x: usize, k: usize| {
            images[((image * side + row * p + y) * side + column * p + x) * c + k] * 2.0 - 1.0
        };
        let mut expected = Vec::new();
        for y in 0..p {
            for x in 0..p {
                expected.extend((0..c).map(|k| pixel(y, x, k)));
            }
        }
        expected.extend(&positions[(row * 2 + column) * 32..][..32]);
        for k in 0..3 {
            let sum: f32 = (0..p * p).map(|j| pixel(j / p, j % p, k)).sum();
            expected.push(sum / (p * p) as f32);
        }
        expected.extend(&rays[i * 6..][..6]);
        assert_close("token", token, &expected, 1e-5);
    }
}

#[test]
fn positions_are_told_apart() {
    let all = position_embedding(37, 37, 32);
    let rows: Vec<&[f32]> = all.chunks_exact(32).collect();
    assert_eq!(rows.len(), 37 * 37);
    for (i, a) in rows.iter().enumerate() {
        for b in &rows[..i] {
            let distance: f32 = a.iter().zip(*b).map(|(x, y)| (x - y) * (x - y)).sum();
            assert!(distance > 1e-2);
        }
    }
}

#[test]
fn dinov2_features_become_tokens() {
    let device = Device::flex();
    let dinov2 = Dinov2::load(&path("dino/registers_img56"), &device).unwrap();
    let config = config(EncoderConfig::Dinov2(dinov2.config().clone()), 28);
    let random = model(&config);
    let image = counting([1, 2, 28, 28, 3], 1.0 / 4704.0);
    let rays = Tensor::<5>::zeros([1, 2, 2, 2, 6], &device);
    let before = numbers(random.encode(image.clone(), rays.clone()));
    let published = random.with_dinov2(&config, dinov2.clone()).unwrap();
    let tokens = published.encode(image.clone(), rays);
    assert_eq!(tokens.dims(), [1, 8, 48 + 41]);
    assert_ne!(numbers(tokens.clone()), before);
    // ImageNet's normalization, spelled out for the second view.
    let pixels = numbers(image)[28 * 28 * 3..].to_vec();
    let mut planes = vec![0f32; pixels.len()];
    for (i, rgb) in pixels.chunks_exact(3).enumerate() {
        for (k, (mean, std)) in [(0.485, 0.229), (0.456, 0.224), (0.406, 0.225)].into_iter().enumerate() {
            planes[k * 28 * 28 + i] = (rgb[k] - mean) / std;
        }
    }
    let features = dinov2.patch_features(Tensor::from_data(TensorData::new(planes, [1, 3, 28, 28]), &device));
    let found = tokens.narrow(1, 4, 4).narrow(2, 0, 48);
    assert_close("features", &numbers(found), &numbers(features), 1e-5);
    // Frozen weights are no parameters, and another architecture is refused.
    assert!(published.parameters().iter().all(|p| p.name.starts_with("dit.")));
    let other = Dinov2::load(&path("dino/mlp_img56"), &device).unwrap();
    assert!(published.with_dinov2(&config, other).is_err());
}
