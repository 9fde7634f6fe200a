//! Models that predict in one pass: what comes out, where it may lie, and its gradients against finite differences.

use burn::{
    module::{Module, ModuleVisitor, Param},
    tensor::{Device, Gradients, Tensor, TensorData},
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{devices, numbers};
use crate::{
    Alignment, CHANNELS, CellViews, EncoderConfig, FreeRange, ModelConfig, ModelKind, PLUCKER, PatchConfig,
    VolumeConfig,
    one_pass::{HALF_SIDE, REACH},
};

const SIDE: usize = 8;
const VIEWS: usize = 2;

fn config(kind: ModelKind) -> ModelConfig {
    let volume = VolumeConfig { tokens_per_side: 2, cells_per_token_side: 2, gaussians_per_cell: 1 };
    ModelConfig {
        kind,
        image_size: SIDE as u32,
        encoder: EncoderConfig::Patch(PatchConfig { patch_size: 4, channels: 4 }),
        hidden: 16,
        blocks: 2,
        heads: 2,
        ffn: Some(24),
        registers: 2,
        gaussians_per_token: 2,
        latent_tokens: if kind == ModelKind::LatentTokens { 6 } else { 0 },
        volume: (kind == ModelKind::VoxelAligned).then_some(volume),
        gradient_channels: false,
        ..ModelConfig::default()
    }
}

const KINDS: [ModelKind; 3] = [ModelKind::LatentTokens, ModelKind::PixelAligned, ModelKind::VoxelAligned];

/// Unit rays from two cameras on a circle of radius 2, one per pixel, and the cameras' centers.
fn rays(device: &Device) -> (Tensor<5>, Vec<[f32; 3]>) {
    let (mut all, mut origins) = (Vec::new(), Vec::new());
    for view in 0..VIEWS {
        let angle = 0.7 * view as f32;
        let origin = [2.0 * angle.cos(), 2.0 * angle.sin(), 0.3];
        for pixel in 0..SIDE * SIDE {
            let [u, v] = [pixel % SIDE, pixel / SIDE].map(|i| (i as f32 + 0.5) / SIDE as f32 - 0.5);
            let d = [-angle.cos() - 0.4 * u * angle.sin(), -angle.sin() + 0.4 * u * angle.cos(), -0.15 + 0.4 * v];
            let length = d.iter().map(|x| x * x).sum::<f32>().sqrt();
            let d = d.map(|x| x / length);
            all.extend(cross(origin, d).into_iter().chain(d));
            origins.push(origin);
        }
    }
    (Tensor::from_data(TensorData::new(all, [1, VIEWS, SIDE, SIDE, PLUCKER]), device), origins)
}

fn cross(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    std::array::from_fn(|i| a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3])
}

/// Every view shows noise at every cell, and each token's center lies in another patch, or (8) in none.
fn cells(device: &Device) -> CellViews {
    let rng = &mut ChaCha8Rng::seed_from_u64(5);
    let pixels: Vec<f32> = (0..VIEWS * 8 * 32).map(|_| rng.random()).collect();
    let patches: Vec<i64> = (0..VIEWS as i64 * 8).map(|i| i % 9).collect();
    CellViews {
        patches: Tensor::from_data(TensorData::new(patches, [1, VIEWS * 8]), device),
        pixels: Tensor::from_data(TensorData::new(pixels, [1, VIEWS, 8, 32]), device),
    }
}

/// A model all of whose weights are random: those that begin as zeros would hide what comes before them.
fn model(config: &ModelConfig, device: &Device) -> FreeRange {
    let rng = &mut ChaCha8Rng::seed_from_u64(3);
    let model = FreeRange::new(config, rng, device).unwrap();
    let values = model.parameters().into_iter().map(|p| {
        let noise = p.values.iter().map(|x| x + 0.2 * (rng.random::<f32>() - 0.5));
        noise.collect::<Vec<f32>>()
    });
    let values: Vec<Vec<f32>> = values.collect();
    model.set_parameters(&values).unwrap()
}

/// The Gaussians of the model for images of noise. `[1, n, 14]`
fn predict(model: &FreeRange, device: &Device) -> Tensor<3> {
    let rng = &mut ChaCha8Rng::seed_from_u64(4);
    let pixels: Vec<f32> = (0..VIEWS * SIDE * SIDE * 4).map(|_| rng.random()).collect();
    let images = Tensor::from_data(TensorData::new(pixels, [1, VIEWS, SIDE, SIDE, 4]), device);
    let grid: Vec<f32> = (0..VIEWS * 4 * PLUCKER).map(|_| rng.random::<f32>() - 0.5).collect();
    let grid = Tensor::from_data(TensorData::new(grid, [1, VIEWS, 2, 2, PLUCKER]), device);
    let alignment = match model.kind() {
        ModelKind::PixelAligned => Some(Alignment::Rays(rays(device).0)),
        ModelKind::VoxelAligned => Some(Alignment::Cells(cells(device))),
        _ => None,
    };
    model.predict(model.encode(images, grid), alignment)
}

#[test]
fn as_many_gaussians_come_out_as_the_configuration_says() {
    for device in devices() {
        for kind in KINDS {
            let config = config(kind);
            config.validate().unwrap();
            let out = predict(&model(&config, &device), &device);
            assert_eq!(out.dims(), [1, config.gaussians(4, VIEWS), CHANNELS], "{kind:?}");
            assert!(numbers(out).iter().all(|x| x.is_finite()));
        }
    }
}

#[test]
fn pixel_aligned_gaussians_lie_on_the_rays_of_their_pixels() {
    let device = Device::flex();
    let out = numbers(predict(&model(&config(ModelKind::PixelAligned), &device), &device));
    let (rays, origins) = rays(&device);
    let rays = numbers(rays);
    let mut reached = [f32::MAX, f32::MIN];
    // Patches row by row, and the pixels of each row by row.
    for (i, row) in out.chunks(CHANNELS).enumerate() {
        let [view, patch, within] = [i / 64, i / 16 % 4, i % 16];
        let pixel = view * 64 + (patch / 2 * 4 + within / 4) * SIDE + patch % 2 * 4 + within % 4;
        let ray = &rays[pixel * PLUCKER..][..PLUCKER];
        let direction: [f32; 3] = ray[3..].try_into().unwrap();
        let from_camera: [f32; 3] = std::array::from_fn(|k| row[k] - origins[pixel][k]);
        assert!(cross(from_camera, direction).iter().all(|x| x.abs() < 1e-5), "{i}: {row:?}");
        let along: f32 = (0..3).map(|k| row[k] * direction[k]).sum(); // from where the ray passes the center
        assert!(along.abs() <= REACH, "{along}");
        reached = [reached[0].min(along), reached[1].max(along)];
        assert!(row[3..6].iter().all(|s| *s <= 0.15f32.ln() + 0.02), "{row:?}");
        assert!(row[11..].iter().all(|c| (0.0..=1.0).contains(c)), "{row:?}");
    }
    assert!(reached[1] - reached[0] > 0.02, "all at one distance: {reached:?}");
}

#[test]
fn voxel_aligned_gaussians_stay_by_their_cells() {
    let device = Device::flex();
    let config = config(ModelKind::VoxelAligned);
    let out = numbers(predict(&model(&config, &device), &device));
    let cell = 2.0 * HALF_SIDE / 4.0;
    let mut seen = std::collections::BTreeSet::new();
    for (i, row) in out.chunks(CHANNELS).enumerate() {
        let [token, inner] = [i / 8, i % 8].map(|n| [n / 4, n / 2 % 2, n % 2]);
        let at: [usize; 3] = std::array::from_fn(|axis| 2 * token[axis] + inner[axis]);
        seen.insert(at);
        for axis in 0..3 {
            let center = (at[axis] as f32 + 0.5) * cell - HALF_SIDE;
            assert!((row[axis] - center).abs() <= cell, "{i}: {row:?}, cell at {at:?}");
        }
        assert!(row[3..6].iter().all(|s| *s <= (2.0 * cell).ln() + 1e-5), "{row:?}");
        assert!(row[11..].iter().all(|c| (0.0..=1.0).contains(c)), "{row:?}");
    }
    assert_eq!(seen.len(), 64);
}

/// Sum of all channels of all Gaussians, each with a weight of its own: what gradients are taken of.
fn weighed(out: Tensor<3>) -> Tensor<1> {
    let [_, n, c] = out.dims();
    let weights: Vec<f32> = (0..n * c).map(|i| ((i * 37 % 101) as f32 / 50.0 - 1.0) / n as f32).collect();
    (out.clone() * Tensor::from_data(TensorData::new(weights, [1, n, c]), &out.device())).sum()
}

/// The gradient of every weight, in the order of [`FreeRange::parameters`].
struct Collected<'a>(&'a Gradients, Vec<Vec<f32>>);

impl ModuleVisitor for Collected<'_> {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        self.1.push(numbers(param.val().grad(self.0).expect("every weight has a gradient")));
    }
}

#[test]
fn gradients_agree_with_finite_differences() {
    for kind in KINDS {
        let device = Device::flex().autodiff();
        let model = model(&config(kind), &device);
        let gradients = weighed(predict(&model, &device)).backward();
        let mut found = Collected(&gradients, Vec::new());
        model.visit(&mut found);
        let plain = model.valid();
        let (names, values): (Vec<String>, Vec<Vec<f32>>) =
            plain.parameters().into_iter().map(|p| (p.name, p.values)).unzip();
        let at = |tensor: usize, entry: usize, by: f32| {
            let mut moved = values.clone();
            moved[tensor][entry] += by;
            let moved = plain.clone().set_parameters(&moved).unwrap();
            f64::from(numbers(weighed(predict(&moved, &Device::flex())))[0])
        };
        let mut checked = 0;
        for (tensor, (name, gradient)) in names.iter().zip(&found.1).enumerate() {
            // The entry with the largest gradient, where rounding matters least, and one in the middle.
            let largest = (0..gradient.len()).max_by(|&a, &b| gradient[a].abs().total_cmp(&gradient[b].abs())).unwrap();
            for entry in [largest, gradient.len() / 2] {
                let step = 4e-3;
                let expected = (at(tensor, entry, step) - at(tensor, entry, -step)) / f64::from(2.0 * step);
                let error = (f64::from(gradient[entry]) - expected).abs();
                assert!(
                    error < 2e-2 * expected.abs() + 2e-4,
                    "{kind:?} {name}[{entry}]: {} {expected}",
                    gradient[entry]
                );
                checked += 1;
            }
        }
        assert_eq!((checked, found.1.len()), (2 * names.len(), names.len()));
    }
}

#[test]
fn parts_of_other_kinds_are_refused_by_name() {
    let volume = Some(VolumeConfig { tokens_per_side: 2, cells_per_token_side: 1, gaussians_per_cell: 1 });
    let large = Some(VolumeConfig { tokens_per_side: 64, cells_per_token_side: 8, gaussians_per_cell: 64 });
    let cases = [
        ("latent_tokens", ModelConfig { latent_tokens: 0, ..config(ModelKind::LatentTokens) }),
        ("latent_tokens", ModelConfig { latent_tokens: 4, ..config(ModelKind::PixelAligned) }),
        ("volume", ModelConfig { volume, ..config(ModelKind::LatentTokens) }),
        ("volume", ModelConfig { volume: None, ..config(ModelKind::VoxelAligned) }),
        ("volume (Gaussians of all its cells)", ModelConfig { volume: large, ..config(ModelKind::VoxelAligned) }),
        ("gradient_channels", ModelConfig { gradient_channels: true, ..config(ModelKind::PixelAligned) }),
        ("image_size", ModelConfig { image_size: 2048, ..config(ModelKind::PixelAligned) }),
        ("volume", ModelConfig { volume, ..ModelConfig::default() }),
    ];
    for (field, config) in cases {
        let message = config.validate().unwrap_err().to_string();
        assert!(message.contains(&format!(" {field}: expected")), "{field}: {message}");
    }
}
