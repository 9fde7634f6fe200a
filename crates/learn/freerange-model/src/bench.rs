//! Single parts of a model, to be timed.

use burn::{
    module::Module,
    tensor::{Device, Distribution, Tensor},
};
use rand::Rng;

use crate::{
    Compute, ModelConfig, ModelError,
    compute::is_cpu,
    dit::{self, Parts},
    layers::{Builder, RandomSource},
    ops,
};

/// How a part is computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Way {
    /// As in the model.
    Fused,
    /// As in the model, with recomputation for the gradient.
    Recomputed,
    /// By the model's operations one by one, in f32.
    Separate,
    /// By Burn's own operations, in f32.
    Burn,
}

/// One transformer block with random weights.
#[derive(Clone, Debug)]
pub struct Block {
    block: dit::Block,
    compute: Compute,
    heads: usize,
}

impl Block {
    /// The block of a model of this configuration, on `device`; trainable if that is an autodiff device.
    ///
    /// # Errors
    /// A configuration that does not make sense.
    pub fn new(
        config: &ModelConfig,
        compute: Compute,
        rng: &mut impl Rng,
        device: &Device,
    ) -> Result<Self, ModelError> {
        config.validate()?;
        let mut source = RandomSource(rng);
        let block = dit::Block::build(config, "block", &mut Builder { source: &mut source, device })?;
        Ok(Self { block, compute, heads: config.heads })
    }

    /// The same without gradients.
    pub fn without_gradients(mut self) -> Self {
        self.block = self.block.valid();
        self
    }

    /// All tokens through the block: `x` `[b, t, d]`, `c` `[b, d]` (the conditioning vector after its SiLU), both f32.
    /// Returns `[b, t, d]`, f32.
    pub fn forward(&self, x: Tensor<3>, c: Tensor<2>) -> Tensor<3> {
        self.forward_by(Way::Fused, x, c)
    }

    /// [`forward`](Self::forward), computed in a certain way.
    pub fn forward_by(&self, way: Way, x: Tensor<3>, c: Tensor<2>) -> Tensor<3> {
        let queries = x.dims()[1];
        match way {
            Way::Fused => self.block.forward(x, c, queries, self.compute, false),
            Way::Recomputed => self.block.forward(x, c, queries, self.compute, true),
            Way::Separate => self.block.forward_by_parts(x, c, queries, &Parts::fused()),
            Way::Burn => self.block.forward_by_parts(x, c, queries, &Parts::readable()),
        }
    }

    /// The block's attention alone, in f32 or, where `compute` says so and the device can, in half precision:
    /// `qkv` `[b, t, 3 d]`, f32, with columns ordered `[3, heads, d / heads]`, to `[b, t, d]`.
    pub fn attention(&self, way: Way, qkv: Tensor<3>) -> Tensor<3> {
        let tokens = qkv.dims()[1];
        let [q, k] = self.block.norms();
        match way {
            Way::Burn => ops::reference::attention(qkv, q, k, self.heads, tokens),
            Way::Fused | Way::Recomputed | Way::Separate => {
                let qkv = if is_cpu(&qkv.device()) { qkv } else { ops::activation(qkv, self.compute) };
                ops::attention(qkv, q, k, self.heads, tokens, self.compute)
            }
        }
    }
}

/// Random numbers of unit deviation.
pub fn noise<const D: usize>(shape: [usize; D], device: &Device) -> Tensor<D> {
    Tensor::random(shape, Distribution::Normal(0.0, 1.0), device)
}
