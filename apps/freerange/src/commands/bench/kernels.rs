//! The rasterizer and the transformer block by themselves.

use std::path::Path;

use burn::tensor::{Distribution, Tensor, TensorData};
use freerange_model::{Compute, bench};
use freerange_raster::{CHANNELS, RasterConfig, rasterize};
use freerange_scene::camera::Camera;
use glam::{DQuat, DVec3};
use rand::SeedableRng;
use serde::Serialize;

use super::{ms, timer::Timer};
use crate::{error::CliError, runtime::TrainConfig};

/// A line about the rasterizer.
#[derive(Serialize)]
pub struct Raster {
    gaussians: usize,
    images: usize,
    pixels: u32,
    forward_seconds: f64,
    both_seconds: f64,
}

impl Raster {
    pub const HEADER: [&str; 5] = ["Gaussians", "images", "px", "forward, ms", "forward + backward, ms"];

    pub fn cells(&self) -> [String; 5] {
        let Self { gaussians, images, pixels, .. } = self;
        [gaussians.to_string(), images.to_string(), pixels.to_string(), ms(self.forward_seconds), ms(self.both_seconds)]
    }
}

/// The same numbers on every machine and in every language: 0 to 1, from two indices.
fn unit(i: usize, k: usize) -> f64 {
    let x = (i as f64 * 12.9898 + k as f64 * 78.233).sin() * 43758.5453;
    x - x.floor()
}

/// Flat, small Gaussians that tile a bumpy surface of radius 0.5, as a fitted object has them. `[n, 14]`
///
/// `tools/bench_peers.py` makes the same.
fn scene(n: usize) -> Vec<f32> {
    let spacing = (std::f64::consts::PI / n as f64).sqrt(); // of n points on a sphere of radius 0.5
    let mut rows = Vec::with_capacity(n * CHANNELS);
    for i in 0..n {
        // A Fibonacci lattice with bumps.
        let z = 1.0 - 2.0 * (i as f64 + 0.5) / n as f64;
        let phi = i as f64 * std::f64::consts::PI * (3.0 - 5f64.sqrt());
        let normal = DVec3::new((1.0 - z * z).sqrt() * phi.cos(), (1.0 - z * z).sqrt() * phi.sin(), z);
        let mean = normal * (0.45 + 0.05 * (7.0 * normal.x).sin() * (5.0 * normal.y).cos());
        // Half way between the z axis and the normal, about which it turns by half a turn: takes z to the normal.
        let q = DQuat::from_axis_angle((normal + DVec3::Z).normalize(), std::f64::consts::PI);
        rows.extend(mean.to_array().map(|v| v as f32));
        for (axis, flat) in [1.0, 1.0, 0.1].into_iter().enumerate() {
            rows.push((spacing * flat * (0.4 + 0.4 * unit(i, axis))).ln() as f32);
        }
        rows.extend([q.w, q.x, q.y, q.z].map(|v| v as f32));
        rows.push((5.0 * unit(i, 3) - 1.0) as f32);
        rows.extend([4, 5, 6].map(|k| unit(i, k) as f32));
    }
    rows
}

/// 1.5 away, with a field of view of 49 degrees.
fn cameras(count: usize, size: u32) -> Vec<Camera> {
    (0..count)
        .map(|i| {
            let eye = DQuat::from_rotation_z(i as f64 * 1.7) * DVec3::new(1.4, 0.0, 0.54);
            Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 49f64.to_radians(), size, size)
        })
        .collect()
}

/// Times the rasterizer on one object in `images` views.
pub fn raster(timer: &Timer, n: usize, images: usize, pixels: u32) -> Result<Raster, CliError> {
    let (cameras, backgrounds) = (vec![cameras(images, pixels)], vec![vec![[1.0; 3]; images]]);
    let config = RasterConfig::default();
    let rows = || TensorData::new(scene(n), [1, n, CHANNELS]);
    let plain = Tensor::<3>::from_data(rows(), &timer.device);
    let forward_seconds = timer.time(|| Ok(rasterize(plain.clone(), &cameras, &backgrounds, &config)?))?;
    let leaf = Tensor::<3>::from_data(rows(), &timer.device.clone().autodiff()).require_grad();
    let both_seconds = timer.time(|| {
        let image = rasterize(leaf.clone(), &cameras, &backgrounds, &config)?;
        let gradients = image.square().sum().backward();
        leaf.grad(&gradients).ok_or_else(|| CliError::failure("no gradient"))
    })?;
    Ok(Raster { gaussians: n, images, pixels, forward_seconds, both_seconds })
}

/// A line about one transformer block.
#[derive(Serialize)]
pub struct Block {
    size: String,
    batch: usize,
    tokens: usize,
    hidden: usize,
    heads: usize,
    ffn: usize,
    attention_forward_seconds: f64,
    attention_both_seconds: f64,
    forward_seconds: f64,
    both_seconds: f64,
    /// FLOPs of a forward pass; one with gradients takes three times that.
    forward_flops: f64,
    /// Share of the device's peak, forward and with gradients.
    share: [f64; 2],
}

impl Block {
    pub const HEADER: [&str; 8] = [
        "size",
        "batch x tokens x width",
        "attention forward, ms",
        "forward + backward, ms",
        "block forward, ms",
        "forward + backward, ms",
        "of peak, forward",
        "of peak, both",
    ];

    pub fn cells(&self) -> [String; 8] {
        [
            self.size.clone(),
            format!("{} x {} x {}", self.batch, self.tokens, self.hidden),
            ms(self.attention_forward_seconds),
            ms(self.attention_both_seconds),
            ms(self.forward_seconds),
            ms(self.both_seconds),
            format!("{:.0} %", 100.0 * self.share[0]),
            format!("{:.0} %", 100.0 * self.share[1]),
        ]
    }
}

/// Times one block at the last stage of a configuration, four views, one object with both branches of the guidance.
pub fn block(timer: &Timer, size: &str, compute: Compute, peak_tflops: f64) -> Result<Block, CliError> {
    let config = TrainConfig::load(Path::new(size))?;
    let stage = config.stage(u64::MAX);
    let model = freerange_model::ModelConfig { image_size: stage.image_size, ..config.model.clone() };
    let (batch, tokens, d) = (2, model.tokens(4, 1 << stage.depth), model.hidden);
    let random = |shape: [usize; 3], device: &_| Tensor::<3>::random(shape, Distribution::Normal(0.0, 1.0), device);
    let c = |device: &_| Tensor::<2>::random([batch, d], Distribution::Normal(0.0, 1.0), device);
    let seconds = |tracked: bool, attention_only: bool| {
        let device = if tracked { timer.device.clone().autodiff() } else { timer.device.clone() };
        let block = bench::Block::new(&model, compute, &mut rand_chacha::ChaCha8Rng::seed_from_u64(1), &device)?;
        let width = if attention_only { 3 * d } else { d };
        let (x, c) = (random([batch, tokens, width], &device), c(&device));
        let x = if tracked { x.require_grad() } else { x };
        timer.time(|| {
            let y = match attention_only {
                true => block.attention(bench::Way::Fused, x.clone()),
                false => block.forward(x.clone(), c.clone()),
            };
            match tracked {
                true => x.grad(&y.sum().backward()).ok_or_else(|| CliError::failure("no gradient")),
                false => Ok(y),
            }
        })
    };
    let (t, w, f) = (tokens as f64, d as f64, model.ffn_width() as f64);
    let forward_flops = 2.0 * batch as f64 * (t * (4.0 * w * w + 3.0 * w * f) + 2.0 * t * t * w + 6.0 * w * w);
    let (forward_seconds, both_seconds) = (seconds(false, false)?, seconds(true, false)?);
    let share = |flops: f64, seconds: f64| flops / seconds / (peak_tflops * 1e12);
    Ok(Block {
        size: size.into(),
        batch,
        tokens,
        hidden: d,
        heads: model.heads,
        ffn: model.ffn_width(),
        attention_forward_seconds: seconds(false, true)?,
        attention_both_seconds: seconds(true, true)?,
        forward_seconds,
        both_seconds,
        forward_flops,
        share: [share(forward_flops, forward_seconds), share(3.0 * forward_flops, both_seconds)],
    })
}

#[cfg(test)]
mod tests {
    use freerange_raster::reference;

    use super::*;

    #[test]
    fn the_scene_is_a_solid_object_seen_whole() {
        let rows = scene(2048);
        let out = reference::render(&rows, &cameras(1, 64)[0], [0.0; 3], &RasterConfig::default());
        let alpha = |x: usize, y: usize| out.alpha[y * 64 + x];
        assert!(alpha(32, 32) > 0.9 && alpha(1, 1) < 0.01 && alpha(62, 32) < 0.01);
    }
}
