//! What a model costs: operations of a forward pass, and memory of a training step.

use super::{Execution, Workload};
use crate::{Compute, EncoderConfig, ModelConfig};

/// Bytes of a number.
pub(super) const F32: u64 = size_of::<f32>() as u64;

/// Bytes of a training step's activations.
pub(super) struct Memory {
    pub activations: u64,
    pub recomputed: u64,
    pub working: u64,
}

impl Memory {
    pub fn new(config: &ModelConfig, workload: Workload, execution: Execution) -> Self {
        let [d, f, h] = [config.hidden, config.ffn_width(), config.heads].map(|n| n as u64);
        let tokens = config.tokens(workload.views, workload.gaussians);
        let r = (workload.batch * tokens) as u64;
        let last = (workload.batch * config.output_tokens(workload.views, workload.gaussians)) as u64;
        let half = execution.gpu && execution.compute != Compute::F32;
        let number = if half { F32 / 2 } else { F32 };
        let block = |q: u64| F32 * (r * d + q * d + q * h) + number * (r * 4 * d + q * (4 * d + 3 * f));
        let blocks = config.blocks as u64;
        let activations = if blocks == 0 { 0 } else { (blocks - 1) * block(r) + block(last) };
        let recomputed = blocks * r * d * F32;
        // While GEGLU goes backward, the product and the output are gone, and the gradients of the inner pair, of its
        // product and of the tokens are there.
        let feed_forward = F32 * r * d + number * r * (2 * f).saturating_sub(d);
        let attention = if execution.gpu {
            // Heads, their gradients, the gradients of qkv, of the mixed values and of the residual, a piece of scores.
            let pair = r / (workload.batch as u64).max(1) * tokens as u64;
            let scores = (pair * h * workload.batch as u64).min(SCORES) * (2 * F32 + 2 * number);
            F32 * r * (3 * d + d) + number * r * (3 * d + 3 * d + 2 * d) + scores
        } else {
            F32 * r * (3 * d + 2 * d)
        };
        // The feed-forward network's tensors are gone when attention goes backward.
        let freed = number * r * (2 * d + 3 * f) + F32 * r * d;
        let beyond = feed_forward.max(attention.saturating_sub(freed));
        let working = if blocks == 0 { 0 } else { beyond + if execution.recompute { block(r) } else { 0 } };
        Self { activations, recomputed, working }
    }
}

/// Scores of one piece of attention on a GPU, at most.
const SCORES: u64 = (256 << 20) / F32;

/// One sample through the transformer.
pub(super) fn forward_flops(config: &ModelConfig, workload: Workload) -> f64 {
    let [d, f] = [config.hidden, config.ffn_width()].map(|x| x as f64);
    let tokens = config.tokens(workload.views, workload.gaussians) as f64;
    let outputs = config.output_tokens(workload.views, workload.gaussians) as f64;
    let images = config.image_tokens(workload.views) as f64;
    let (noisy, time) = match config.kind.one_pass() {
        true => (0.0, 0.0),
        false => (outputs * config.gaussian_channels() as f64, config.time_features as f64 * d + d * d),
    };
    let lift = match config.cell_channels() {
        0 => 0.0,
        channels => outputs * (workload.views as f64 * (d + channels as f64) + d),
    };
    let inputs = images * config.image_token_width() as f64 + noisy + lift;
    let output = outputs * config.output_channels() as f64;
    let block = |queries: f64| {
        let modulation = if config.kind.one_pass() { 0.0 } else { 6.0 * d * d };
        let qkv = tokens * 3.0 * d * d;
        let attention = 2.0 * queries * tokens * d + queries * d * d;
        modulation + qkv + attention + queries * 3.0 * d * f
    };
    let blocks = match config.blocks {
        0 => 0.0,
        n => (n - 1) as f64 * block(tokens) + block(outputs),
    };
    2.0 * (inputs * d + time + blocks + output * d)
}

/// One image through the encoder.
pub(super) fn encoder_flops(config: &ModelConfig) -> f64 {
    let patches = config.patches_per_side().pow(2) as f64;
    match &config.encoder {
        EncoderConfig::Patch(_) => 0.0,
        EncoderConfig::Dinov2(c) => {
            let (d, f) = (c.hidden as f64, c.ffn_width() as f64);
            let tokens = patches + 1.0 + c.registers as f64;
            let ffn = if c.swiglu { 3.0 } else { 2.0 } * d * f;
            let layer = tokens * (4.0 * d * d + ffn) + 2.0 * tokens * tokens * d;
            2.0 * (patches * 3.0 * f64::from(c.patch_size).powi(2) * d + c.layers as f64 * layer)
        }
    }
}
