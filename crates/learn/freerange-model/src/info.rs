//! Sizes and costs of a model, from its configuration alone: nothing is allocated.
//!
//! **FLOPs** count a multiplication and an addition as two, in matrix products only: per token of a linear layer
//! `2 in out`, per head `4 tokens^2 width` for scores and mixing. The last block computes only Gaussian tokens beyond
//! its keys and values. A training step costs three forward passes (four with recomputation of blocks).
//!
//! **Memory of a training step**, for `r` rows (= batch x tokens) of width `d`, inner width `f`, `h` heads; `q` of the
//! rows leave the block (all but in the last block):
//! - weights, gradients, Adam's two moments, moving average: 5 numbers a trainable parameter, 1 a frozen one, of 4 bytes;
//! - what a block keeps for its gradient: its input (r d), the first normed input (r d), `qkv` (3 r d), mixed values and
//!   the attention's output (2 q d), the second residual input (q d), normed (q d), the feed-forward output (q d), the
//!   inner pair and its product (3 q f), the softmax denominators (q h). All have 4 bytes, but 2 on a GPU that computes in
//!   half precision, where only residual inputs and denominators have 4;
//! - with recomputation: each block's input alone;
//! - what is there at once while one block goes backward, beyond what it keeps: gradients of the inner pair and of the
//!   tokens; on a GPU also the queries, keys and values of all heads with their gradients and a piece of the scores; with
//!   recomputation, all that the block would have kept.
//!
//! Score matrices are never held whole (see the attention kernels). Left out: images, renders and the encoder's own
//! activations, which are gone when the transformer's are largest, and what an allocator holds in reserve.

mod cost;

use std::fmt;

use self::cost::{F32, Memory, encoder_flops, forward_flops};
use crate::{Compute, Dinov2Config, EncoderConfig, ModelConfig};

/// One tensor of the model.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct TensorInfo {
    /// As in a checkpoint, such as `dit.gs_in.weight`.
    pub name: String,
    /// Linear weights are `[out, in]`.
    pub shape: Vec<usize>,
}

impl TensorInfo {
    /// Number of values.
    pub fn count(&self) -> u64 {
        self.shape.iter().map(|&n| n as u64).product()
    }
}

/// A named part with its number of parameters.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct PartInfo {
    /// What it is.
    pub name: String,
    /// Its main sizes, in words.
    pub shape: String,
    /// Parameters.
    pub parameters: u64,
}

/// What one call looks like: the numbers of images, Gaussians and samples at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Workload {
    /// Samples at once.
    pub batch: usize,
    /// Input images per sample.
    pub views: usize,
    /// Gaussians per sample.
    pub gaussians: usize,
}

/// How a training step is computed, as far as memory goes. The default is the CPU's, in f32.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Execution {
    /// On a GPU, whose activations have the type of `compute`; on a CPU they are f32.
    pub gpu: bool,
    /// In which precision blocks compute.
    pub compute: Compute,
    /// Whether blocks keep only their inputs for the gradient.
    pub recompute: bool,
}

/// Sizes and costs of a model.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct ModelInfo {
    /// Parts and their parameters.
    pub parts: Vec<PartInfo>,
    /// Parameters that are trained.
    pub trainable: u64,
    /// Parameters of a frozen encoder.
    pub frozen: u64,
    /// What the costs below are for.
    pub workload: Workload,
    /// Tokens in the transformer.
    pub tokens: usize,
    /// FLOPs to encode the images of the whole batch, once per reconstruction.
    pub encoder_flops: f64,
    /// FLOPs of one pass of the transformer over the whole batch.
    pub forward_flops: f64,
    /// What the bytes below are for.
    pub execution: Execution,
    /// Bytes of weights, gradients, Adam's moments and the moving average.
    pub state_bytes: u64,
    /// Bytes that the blocks keep for the gradient.
    pub activation_bytes: u64,
    /// The same where each block is computed again in the backward pass.
    pub recomputed_activation_bytes: u64,
    /// Bytes that one block needs in the backward pass beyond those.
    pub working_bytes: u64,
    /// Bytes of a whole training step at its largest.
    pub step_bytes: u64,
}

fn linear(out: &mut Vec<TensorInfo>, name: &str, inputs: usize, outputs: usize) {
    out.push(TensorInfo { name: format!("{name}.weight"), shape: vec![outputs, inputs] });
    out.push(TensorInfo { name: format!("{name}.bias"), shape: vec![outputs] });
}

/// Every trainable tensor of a model, in the order of [`FreeRange::parameters`](crate::FreeRange::parameters).
pub fn tensors(config: &ModelConfig) -> Vec<TensorInfo> {
    let (d, f) = (config.hidden, config.ffn_width());
    let mut out = Vec::new();
    out.push(TensorInfo { name: "dit.registers".to_owned(), shape: vec![config.registers, d] });
    linear(&mut out, "dit.img_in", config.image_token_width(), d);
    let one_pass = config.kind.one_pass();
    if !one_pass {
        linear(&mut out, "dit.gs_in", config.gaussian_channels(), d);
        linear(&mut out, "dit.t_mlp.0", config.time_features, d);
        linear(&mut out, "dit.t_mlp.2", d, d);
    }
    if config.cell_channels() > 0 {
        linear(&mut out, "dit.lift.0", d + config.cell_channels(), d);
        linear(&mut out, "dit.lift.2", d, d);
    }
    if config.learned_tokens() > 0 {
        out.push(TensorInfo { name: "dit.latents".to_owned(), shape: vec![config.learned_tokens(), d] });
    }
    for i in 0..config.blocks {
        let name = |part: &str| format!("dit.blocks.{i}.{part}");
        match one_pass {
            false => linear(&mut out, &name("adaln"), d, 6 * d),
            true => out.push(TensorInfo { name: name("norms"), shape: vec![4, d] }),
        }
        linear(&mut out, &name("attn.qkv"), d, 3 * d);
        for part in ["attn.q_norm.weight", "attn.k_norm.weight"] {
            out.push(TensorInfo { name: name(part), shape: vec![config.head_width()] });
        }
        linear(&mut out, &name("attn.out"), d, d);
        linear(&mut out, &name("ffn.proj_in"), d, 2 * f);
        linear(&mut out, &name("ffn.proj_out"), f, d);
    }
    match one_pass {
        false => linear(&mut out, "dit.final.adaln", d, 2 * d),
        true => out.push(TensorInfo { name: "dit.final.norm".to_owned(), shape: vec![2, d] }),
    }
    linear(&mut out, "dit.final.linear", d, config.output_channels());
    out
}

/// Parameters of a DINOv2.
pub fn dinov2_parameters(config: &Dinov2Config) -> u64 {
    let (d, f) = (config.hidden as u64, config.ffn_width() as u64);
    let patch = 3 * u64::from(config.patch_size).pow(2);
    let embedding = d * (1 + config.registers as u64 + 1 + (config.position_side() as u64).pow(2)) + d * patch + d;
    let ffn = if config.swiglu { d * 2 * f + 2 * f + f * d + d } else { 2 * d * f + f + d };
    // Two norms, queries, keys, values and output (our module holds zeros where they have no bias), two scales.
    let layer = 4 * d + 4 * (d * d + d) + 2 * d + ffn;
    embedding + config.layers as u64 * layer + 2 * d
}

impl ModelInfo {
    /// Computes everything for a valid configuration and a workload, on a CPU in f32.
    pub fn new(config: &ModelConfig, workload: Workload) -> Self {
        Self::with_execution(config, workload, Execution::default())
    }

    /// Computes everything for a valid configuration, a workload and a way to compute it.
    pub fn with_execution(config: &ModelConfig, workload: Workload, execution: Execution) -> Self {
        let tensors = tensors(config);
        let sum = |prefix: &str| tensors.iter().filter(|t| t.name.starts_with(prefix)).map(TensorInfo::count).sum();
        let (d, f) = (config.hidden, config.ffn_width());
        let mut parts = Vec::new();
        let mut part = |name: &str, shape: String, parameters: u64| {
            parts.push(PartInfo { name: name.to_owned(), shape, parameters });
        };
        let frozen = match &config.encoder {
            EncoderConfig::Dinov2(c) => dinov2_parameters(c),
            EncoderConfig::Patch(_) => 0,
        };
        match &config.encoder {
            EncoderConfig::Dinov2(c) => part(
                "encoder: DINOv2 (frozen)",
                format!("{} layers of width {}, {} heads, patch {}", c.layers, c.hidden, c.heads, c.patch_size),
                frozen,
            ),
            EncoderConfig::Patch(c) => part(
                "encoder: patch",
                format!("{0} x {0} pixels x {1} channels to {2}", c.patch_size, c.channels, config.encoder.features()),
                sum("encoder."),
            ),
        }
        part("registers", format!("{} x {d}", config.registers), sum("dit.registers"));
        part("image input", format!("{} to {d}", config.image_token_width()), sum("dit.img_in"));
        let (p, blocks) = (config.gaussians_per_token, config.blocks);
        if config.kind.one_pass() {
            if config.cell_channels() > 0 {
                part("views of cells", format!("{} to {d} to {d}", d + config.cell_channels()), sum("dit.lift"));
            }
            part("learned tokens", format!("{} x {d}", config.learned_tokens()), sum("dit.latents"));
            part("blocks: norms", format!("{blocks} x (4 x {d})"), count(&tensors, ".norms", "dit.blocks"));
        } else {
            part("Gaussian input", format!("{p} Gaussians, {} to {d}", config.gaussian_channels()), sum("dit.gs_in"));
            part("time", format!("{} to {d} to {d}", config.time_features), sum("dit.t_mlp"));
            part(
                "blocks: modulation",
                format!("{blocks} x ({d} to 6 x {d})"),
                count(&tensors, ".adaln.", "dit.blocks"),
            );
        }
        part(
            "blocks: attention",
            format!("{blocks} x ({} heads of {})", config.heads, config.head_width()),
            count(&tensors, ".attn.", "dit.blocks"),
        );
        part("blocks: GEGLU", format!("{blocks} x ({d} to 2 x {f} to {d})"), count(&tensors, ".ffn.", "dit.blocks"));
        part("output", format!("{d} to {}", config.output_channels()), sum("dit.final"));

        let trainable: u64 = tensors.iter().map(TensorInfo::count).sum();
        let tokens = config.tokens(workload.views, workload.gaussians);
        let memory = Memory::new(config, workload, execution);
        let state_bytes = (5 * trainable + frozen) * F32;
        let kept = if execution.recompute { memory.recomputed } else { memory.activations };
        Self {
            parts,
            trainable,
            frozen,
            workload,
            tokens,
            encoder_flops: encoder_flops(config) * (workload.batch * workload.views) as f64,
            forward_flops: forward_flops(config, workload) * workload.batch as f64,
            execution,
            state_bytes,
            activation_bytes: memory.activations,
            recomputed_activation_bytes: memory.recomputed,
            working_bytes: memory.working,
            step_bytes: state_bytes + kept + memory.working,
        }
    }
}

fn count(tensors: &[TensorInfo], part: &str, prefix: &str) -> u64 {
    tensors.iter().filter(|t| t.name.starts_with(prefix) && t.name.contains(part)).map(TensorInfo::count).sum()
}

impl fmt::Display for ModelInfo {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let gib = |bytes: u64| bytes as f64 / f64::from(1 << 30);
        for part in &self.parts {
            writeln!(out, "{:<26} {:<48} {:>14}", part.name, part.shape, grouped(part.parameters))?;
        }
        writeln!(out, "{:<75} {:>14}", "trainable parameters", grouped(self.trainable))?;
        writeln!(out, "{:<75} {:>14}", "frozen parameters", grouped(self.frozen))?;
        let Workload { batch, views, gaussians } = self.workload;
        writeln!(out, "\nbatch {batch}, {views} views, {gaussians} Gaussians: {} tokens each", self.tokens)?;
        writeln!(out, "encoding the images        {:>12.2} GFLOP", self.encoder_flops / 1e9)?;
        writeln!(out, "one forward pass           {:>12.2} GFLOP", self.forward_flops / 1e9)?;
        writeln!(
            out,
            "one training step          {:>12.2} GFLOP",
            (self.encoder_flops + 3.0 * self.forward_flops) / 1e9
        )?;
        let Execution { gpu, compute, recompute } = self.execution;
        writeln!(out, "\na training step on a {} in {compute:?}:", if gpu { "GPU" } else { "CPU" })?;
        writeln!(out, "weights, gradients, Adam   {:>12.2} GiB", gib(self.state_bytes))?;
        writeln!(out, "activations                {:>12.2} GiB", gib(self.activation_bytes))?;
        writeln!(out, "activations, recomputed    {:>12.2} GiB", gib(self.recomputed_activation_bytes))?;
        writeln!(out, "one block going backward   {:>12.2} GiB", gib(self.working_bytes))?;
        let with = if recompute { "recomputed" } else { "kept" };
        write!(out, "together, activations {with:<11} {:>7.2} GiB", gib(self.step_bytes))
    }
}

/// Digits in groups of three.
fn grouped(n: u64) -> String {
    let digits = n.to_string();
    let groups: Vec<&str> =
        digits.as_bytes().rchunks(3).rev().map(|g| std::str::from_utf8(g).unwrap_or_default()).collect();
    groups.join(",")
}

#[cfg(test)]
mod tests {
    use burn::{module::Module, tensor::Device};
    use rand::SeedableRng;

    use super::*;
    use crate::{FreeRange, ModelKind, PatchConfig, VolumeConfig};

    fn model(config: &ModelConfig) -> FreeRange {
        FreeRange::new(config, &mut rand_chacha::ChaCha8Rng::seed_from_u64(1), &Device::flex()).unwrap()
    }

    const LOAD: Workload = Workload { batch: 2, views: 3, gaussians: 64 };

    #[test]
    fn names_and_shapes_are_the_modules() {
        for (registers, gradient_channels) in [(4, true), (0, false)] {
            let config = ModelConfig {
                image_size: 8,
                encoder: EncoderConfig::Patch(PatchConfig { patch_size: 4, channels: 3 }),
                hidden: 24,
                blocks: 3,
                heads: 4,
                ffn: Some(40),
                registers,
                gaussians_per_token: 4,
                time_features: 6,
                position_features: 8,
                gradient_channels,
                ..ModelConfig::default()
            };
            let real: Vec<TensorInfo> =
                model(&config).parameters().into_iter().map(|p| TensorInfo { name: p.name, shape: p.shape }).collect();
            assert_eq!(tensors(&config), real);
            let info = ModelInfo::new(&config, LOAD);
            assert_eq!(info.trainable, model(&config).num_params() as u64);
            assert_eq!(info.parts.iter().map(|p| p.parameters).sum::<u64>(), info.trainable);
        }
    }

    #[test]
    fn models_of_one_pass_are_counted_as_built() {
        let small = ModelConfig {
            image_size: 8,
            encoder: EncoderConfig::Patch(PatchConfig { patch_size: 4, channels: 4 }),
            hidden: 24,
            blocks: 2,
            heads: 4,
            ffn: Some(40),
            registers: 3,
            gradient_channels: false,
            ..ModelConfig::default()
        };
        let volume = VolumeConfig { tokens_per_side: 2, cells_per_token_side: 2, gaussians_per_cell: 3 };
        for (config, tokens, gaussians) in [
            (ModelConfig { kind: ModelKind::LatentTokens, latent_tokens: 6, ..small.clone() }, 3 + 12 + 6, 12),
            (ModelConfig { kind: ModelKind::PixelAligned, ..small.clone() }, 3 + 12, 3 * 64),
            (ModelConfig { kind: ModelKind::VoxelAligned, volume: Some(volume), ..small.clone() }, 3 + 12 + 8, 192),
        ] {
            let real: Vec<TensorInfo> =
                model(&config).parameters().into_iter().map(|p| TensorInfo { name: p.name, shape: p.shape }).collect();
            assert_eq!(tensors(&config), real);
            assert_eq!(config.gaussians(9, 3), gaussians);
            let info = ModelInfo::new(&config, Workload { batch: 2, views: 3, gaussians });
            assert_eq!((info.tokens, info.trainable), (tokens, model(&config).num_params() as u64));
            assert_eq!(info.parts.iter().map(|p| p.parameters).sum::<u64>(), info.trainable);
            assert!(info.step_bytes > info.state_bytes && info.forward_flops > 0.0);
        }
    }

    #[test]
    fn dinov2_is_counted_as_built() {
        for (swiglu, registers) in [(false, 0), (true, 4)] {
            let dinov2 = Dinov2Config {
                hidden: 24,
                layers: 2,
                heads: 3,
                image_size: 42,
                swiglu,
                registers,
                ..Dinov2Config::default()
            };
            let config = ModelConfig {
                image_size: 28,
                encoder: EncoderConfig::Dinov2(dinov2.clone()),
                hidden: 16,
                blocks: 1,
                heads: 2,
                ..ModelConfig::default()
            };
            let info = ModelInfo::new(&config, LOAD);
            assert_eq!(info.frozen, model(&config).encoder().dinov2().unwrap().num_params() as u64);
            assert_eq!(info.trainable + info.frozen, model(&config).num_params() as u64);
        }
    }

    #[test]
    fn a_step_of_the_papers_size_fits_80_gb_with_recomputation() {
        // 8,192 Gaussians, 8 views at 504 px (the largest multiple of DINOv2's patch within 512).
        let config = ModelConfig { image_size: 504, ..ModelConfig::default() };
        let load = Workload { batch: 1, views: 8, gaussians: 8192 };
        let of =
            |gpu, compute, recompute| ModelInfo::with_execution(&config, load, Execution { gpu, compute, recompute });
        let (kept, recomputed) = (of(true, Compute::Bf16, false), of(true, Compute::Bf16, true));
        assert!(recomputed.step_bytes < 80_000_000_000, "{recomputed}");
        assert!(recomputed.step_bytes < kept.step_bytes);
        assert!(kept.step_bytes < of(true, Compute::F32, false).step_bytes);
        // On a CPU, precision changes no memory.
        assert_eq!(of(false, Compute::Bf16, true).step_bytes, of(false, Compute::F32, true).step_bytes);
        assert!(recomputed.to_string().contains("GPU in Bf16"));
    }

    #[test]
    fn the_paper_has_four_tenths_of_a_billion() {
        let info = ModelInfo::new(&ModelConfig::default(), Workload { batch: 1, views: 4, gaussians: 8192 });
        // 18 blocks of 22 d^2: modulation 6, attention 4, GEGLU 12.
        let estimate = 18.0 * 22.0 * 1024.0 * 1024.0;
        assert!((info.trainable as f64 / estimate - 1.0).abs() < 0.02, "{}", info.trainable);
        // DINOv2-Base has 86.6 million, of which one mask token is not used here.
        assert_eq!(info.frozen, 86_580_480 - 768);
        assert!(info.recomputed_activation_bytes < info.activation_bytes / 8);
        let text = info.to_string();
        assert!(text.contains("18 x (16 heads of 64)") && text.contains("86,579,712"), "{text}");
    }

    #[test]
    fn flops_of_a_model_small_enough_to_count_by_hand() {
        let config = ModelConfig {
            image_size: 4,
            encoder: EncoderConfig::Patch(PatchConfig { patch_size: 4, channels: 3 }),
            hidden: 2,
            blocks: 1,
            heads: 1,
            ffn: Some(3),
            registers: 1,
            gaussians_per_token: 2,
            time_features: 4,
            position_features: 0,
            gradient_channels: true,
            ..ModelConfig::default()
        };
        let info = ModelInfo::new(&config, Workload { batch: 1, views: 1, gaussians: 4 });
        let inputs = 57 * 2 + 2 * 56 * 2;
        let time = 4 * 2 + 2 * 2;
        let block = 6 * 4 + 4 * 3 * 4 + (2 * 4 * 2) * 2 + 2 * 4 + 2 * (2 * 6 + 3 * 2);
        let output = 2 * 2 * 28;
        assert_eq!(info.tokens, 1 + 1 + 2);
        assert_eq!(info.forward_flops, f64::from(2 * (inputs + time + block + output)));
    }
}
