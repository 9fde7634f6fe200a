//! Sampling and training as a whole.

use std::{ops::ControlFlow, path::Path, time::Instant};

use burn::tensor::{Device, Distribution, Tensor};
use freerange_data::build::{GaussianSource, generate_object};
use freerange_diffusion::{
    conditioning::Conditioning,
    conditioning::shrink,
    photometric::Photometric,
    sample::{FlowConfig, FlowSampler},
    targets::Images,
};
use freerange_gaussians::{Normalization, Statistics};
use freerange_model::{Checkpoint, Compute, EncoderConfig, Execution, FreeRange, ModelConfig, ModelInfo, Workload};
use freerange_scene::camera::View;
use freerange_train::{config::Stage, trainer::Trainer};
use rand::SeedableRng;
use serde::Serialize;

use super::{ms, reserved, timer::Timer};
use crate::{error::CliError, runtime::TrainConfig};

/// Views given to the model: the paper's number.
const VIEWS: usize = 4;

/// A line about sampling.
#[derive(Serialize)]
pub struct Sample {
    size: String,
    objects: usize,
    gaussians: usize,
    image_size: u32,
    steps: usize,
    /// Encoding the images, once.
    encode_seconds: f64,
    /// The network, per step: both branches where there is classifier-free guidance.
    transformer_seconds: f64,
    /// Render, compare, and the gradient, per step: for the network and for guidance.
    gradient_seconds: f64,
    /// All steps, and what comes before and after.
    whole_seconds: f64,
    /// Share of the device's peak that the whole run's matrix products make.
    share: f64,
}

impl Sample {
    pub const HEADER: [&str; 9] = [
        "size",
        "objects x Gaussians, images",
        "steps",
        "encode, ms",
        "transformer, ms/step",
        "photometric gradients, ms/step",
        "whole, s",
        "whole, ms/step",
        "of peak",
    ];

    pub fn cells(&self) -> [String; 9] {
        [
            self.size.clone(),
            format!("{} x {}, {VIEWS} x {} px", self.objects, self.gaussians, self.image_size),
            self.steps.to_string(),
            ms(self.encode_seconds),
            ms(self.transformer_seconds),
            ms(self.gradient_seconds),
            format!("{:.2}", self.whole_seconds),
            ms(self.whole_seconds / self.steps as f64),
            format!("{:.0} %", 100.0 * self.share),
        ]
    }
}

/// The configuration with objects that are quick to make.
pub(super) fn load(size: &str) -> Result<TrainConfig, CliError> {
    let mut config = TrainConfig::load(Path::new(size))?;
    config.data.shards = None;
    // Time does not depend on weights.
    if let EncoderConfig::Dinov2(encoder) = &mut config.model.encoder {
        (encoder.weights, encoder.random) = (None, true);
    }
    config.data.making.object.gaussians = GaussianSource::Surface;
    config.data.making.object.slice_iterations = 0;
    let most = config.stages.iter().map(|s| 1usize << s.depth).max().unwrap_or(1);
    config.data.making.object.surface.points = config.data.making.object.surface.points.max(2 * most);
    config.data.making.object.views = config.loss.input_views.1.max(VIEWS) + config.loss.held_views;
    Ok(config)
}

/// A model of random weights: time does not depend on them.
fn untrained(
    config: &ModelConfig,
    normalization: Normalization,
    depth: u32,
    device: &Device,
) -> Result<Checkpoint, CliError> {
    let rng = &mut rand_chacha::ChaCha8Rng::seed_from_u64(1);
    Ok(Checkpoint {
        model: FreeRange::new(config, rng, device)?,
        config: config.clone(),
        normalization,
        gradient_rms: [1.0; 14],
        depth,
        provenance: serde_json::Value::Null,
    })
}

/// Times sampling at the last stage of a configuration.
pub fn sample(
    timer: &Timer,
    size: &str,
    steps: usize,
    objects: usize,
    compute: Compute,
    peak_tflops: f64,
) -> Result<Sample, CliError> {
    let config = load(size)?;
    let (stage, device) = (config.stage(u64::MAX).clone(), &timer.device);
    let model_config = ModelConfig { image_size: stage.image_size, ..config.model.clone() };
    let object = generate_object(7, &config.data.making.object, &[stage.depth])?;
    let mut statistics = Statistics::default();
    statistics.add(object.slice(stage.depth)?)?;
    let checkpoint = untrained(&model_config, statistics.normalization()?, stage.depth, device)?;
    let views: Vec<View> = object.views[..VIEWS].to_vec();
    let batch: Vec<&[View]> = vec![&views; objects];
    let settings = FlowConfig { steps, compute, lod_depth: None, ..config.sample.clone() };

    // The parts of a step.
    let (b, n) = (objects, 1usize << stage.depth);
    let seen: Vec<Vec<&View>> = vec![views.iter().collect(); b];
    let model = checkpoint.model.clone().with_compute(compute);
    let conditioning = Conditioning::new(&seen, &model_config, device)?;
    let encode_seconds = timer.time(|| Ok(conditioning.clone().encode(&model)))?;
    let tokens = conditioning.encode(&model);
    let branches = if settings.cfg_scale == 1.0 { 1 } else { 2 };
    let tokens = tokens.repeat_dim(0, branches);
    let normal = |b: usize| Tensor::<3>::random([b, n, 14], Distribution::Normal(0.0, 1.0), device);
    let (z, gradient) = (normal(branches * b), normal(branches * b));
    let t = Tensor::<1>::full([branches * b], 0.5, device);
    let gradient = model_config.gradient_channels.then_some(gradient);
    let transformer_seconds =
        timer.time(|| Ok(model.denoise(z.clone(), gradient.clone(), tokens.clone(), t.clone())))?;
    let photometric = Photometric::new(&checkpoint.normalization, device);
    let start = normal(b);
    let gradient_at = |size: u32| {
        let small: Vec<View> = views.iter().map(|v| shrink(v, size)).collect();
        let images = Images::new(&vec![small.iter().collect(); b], device)?;
        timer.time(|| Ok(photometric.gradient(start.clone(), &images.on(&vec![[0.5; 3]; b]))?))
    };
    let mut gradient_seconds = 0.0;
    if model_config.gradient_channels {
        gradient_seconds += gradient_at(settings.gradient_size)?;
    }
    if settings.lambda_pg > 0.0 {
        gradient_seconds += gradient_at(settings.gradient_size)?;
    }

    // The whole. One step first: every kernel is compiled by then.
    let run = |steps| {
        let config = &FlowConfig { steps, ..settings.clone() };
        let sampler = FlowSampler { checkpoint: &checkpoint, config, device };
        sampler.sample(&batch, &[0], |_| ControlFlow::Continue(()))
    };
    run(1)?;
    let begin = Instant::now();
    run(steps)?;
    let whole_seconds = begin.elapsed().as_secs_f64();
    let info = ModelInfo::new(&model_config, Workload { batch: branches * b, views: VIEWS, gaussians: n });
    let flops = info.encoder_flops / branches as f64 + steps as f64 * info.forward_flops;
    Ok(Sample {
        size: size.into(),
        objects,
        gaussians: n,
        image_size: stage.image_size,
        steps,
        encode_seconds,
        transformer_seconds,
        gradient_seconds,
        whole_seconds,
        share: flops / whole_seconds / (peak_tflops * 1e12),
    })
}

/// A line about training.
#[derive(Serialize)]
pub struct Train {
    size: String,
    depth: u32,
    image_size: u32,
    batch: usize,
    recompute: bool,
    seconds: f64,
    data_seconds: f64,
    tflops: f64,
    share: f64,
    predicted_bytes: u64,
    reserved_bytes: Option<u64>,
}

impl Train {
    pub const HEADER: [&str; 8] = [
        "size",
        "batch x Gaussians, images",
        "s/step",
        "of it waiting for data",
        "TFLOP/s",
        "of peak",
        "memory predicted, GiB",
        "reserved, GiB",
    ];

    pub fn cells(&self) -> [String; 8] {
        let gib = |bytes: u64| format!("{:.2}", bytes as f64 / f64::from(1 << 30));
        [
            format!("{}{}", self.size, if self.recompute { ", blocks computed twice" } else { "" }),
            format!("{} x {}, {} px", self.batch, 1usize << self.depth, self.image_size),
            format!("{:.3}", self.seconds),
            format!("{:.3}", self.data_seconds),
            format!("{:.2}", self.tflops),
            format!("{:.0} %", 100.0 * self.share),
            gib(self.predicted_bytes),
            self.reserved_bytes.map_or_else(|| "unknown".into(), gib),
        ]
    }
}

/// Times training steps at every stage of a configuration.
pub fn train(timer: &Timer, size: &str, compute: Compute, peak_tflops: f64) -> Result<Vec<Train>, CliError> {
    let config = load(size)?;
    let mut lines = Vec::new();
    for stage in &config.stages {
        let mut one = config.clone();
        one.stages = vec![Stage { steps: u64::MAX / 2, ..stage.clone() }];
        // Objects made on the fly, without fits to refine: a step takes as long.
        (one.data.shards, one.loss.refinement) = (None, None);
        one.data.statistics_objects = 4;
        one.data.window = stage.batch.min(8);
        one.data.fresh = 0;
        one.optimizer.compute = compute;
        let folder = tempfile::tempdir().map_err(|e| CliError::failure(format!("no temporary folder: {e}")))?;
        let mut trainer = Trainer::open(one, folder.path(), None, &timer.device, |_| {})?;
        for _ in 0..2 {
            trainer.step()?;
        }
        let (begin, mut times) = (Instant::now(), Vec::new());
        while times.len() < 3 || (times.len() < 50 && begin.elapsed().as_secs_f64() < timer.seconds) {
            times.push(trainer.step()?);
        }
        times.sort_by(|a, b| a.seconds.total_cmp(&b.seconds));
        let middle = &times[times.len() / 2];
        let model = ModelConfig { image_size: stage.image_size, ..config.model.clone() };
        let workload = Workload { batch: stage.batch, views: config.loss.input_views.1, gaussians: 1 << stage.depth };
        let recompute = config.optimizer.recompute;
        let execution = Execution { gpu: timer.device != burn::tensor::Device::flex(), compute, recompute };
        let info = ModelInfo::with_execution(&model, workload, execution);
        let flops = info.encoder_flops + if recompute { 4.0 } else { 3.0 } * info.forward_flops;
        let tflops = flops / middle.seconds / 1e12;
        lines.push(Train {
            size: size.into(),
            depth: stage.depth,
            image_size: stage.image_size,
            batch: stage.batch,
            recompute,
            seconds: middle.seconds,
            data_seconds: middle.data_seconds,
            tflops,
            share: tflops / peak_tflops,
            predicted_bytes: info.step_bytes,
            reserved_bytes: reserved(&timer.device),
        });
    }
    Ok(lines)
}
