//! The plain vision transformer (Dosovitskiy et al. 2020) in the variants that DreamSim uses, with the tensor names of
//! DINO's repository.

use burn::tensor::{
    Device, Tensor,
    activation::{gelu, sigmoid},
    module::{attention, layer_norm, linear},
    ops::AttentionModuleOptions,
};

use super::source::{Source, tensor};
use crate::metrics::MetricsError;

/// The variant.
#[derive(Clone, Copy, Debug)]
pub(crate) struct VitConfig {
    pub width: usize,
    pub depth: usize,
    pub heads: usize,
    /// Pixels along a patch's side.
    pub patch: usize,
    /// Pixels along the image's side.
    pub side: usize,
    /// `x sigmoid(1.702 x)` in place of GELU: OpenAI's CLIP.
    pub quick_gelu: bool,
    /// Normalize the tokens before the first block (CLIP); the file calls it `pos_drop`.
    pub pre_norm: bool,
    pub epsilon: f64,
    /// The class token after the final norm, projected to this width (CLIP). `None`: the class token as it leaves the
    /// last block, without norm.
    pub projection: Option<usize>,
}

#[derive(Clone, Debug)]
pub(crate) struct Vit {
    config: VitConfig,
    class: Tensor<3>,    // [1, 1, d]
    position: Tensor<3>, // [1, 1 + patches, d]
    patches: Linear,
    pre_norm: Option<Norm>,
    blocks: Vec<Block>,
    head: Option<(Norm, Tensor<2>)>, // projection [d, width]
}

#[derive(Clone, Debug)]
struct Block {
    norm1: Norm,
    qkv: Linear,
    out: Linear,
    norm2: Norm,
    fc1: Linear,
    fc2: Linear,
}

#[derive(Clone, Debug)]
struct Linear {
    weight: Tensor<2>, // [in, out]
    bias: Tensor<1>,
}

impl Linear {
    fn load(s: &mut impl Source, name: &str, inputs: usize, outputs: usize, d: &Device) -> Result<Self, MetricsError> {
        let weight = tensor(s, &format!("{name}.weight"), [outputs, inputs], d)?;
        Ok(Self { weight: weight.transpose(), bias: tensor(s, &format!("{name}.bias"), [outputs], d)? })
    }

    fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        linear(x, self.weight.clone(), Some(self.bias.clone()))
    }
}

#[derive(Clone, Debug)]
struct Norm {
    weight: Tensor<1>,
    bias: Tensor<1>,
    epsilon: f64,
}

impl Norm {
    fn load(s: &mut impl Source, name: &str, config: &VitConfig, d: &Device) -> Result<Self, MetricsError> {
        Ok(Self {
            weight: tensor(s, &format!("{name}.weight"), [config.width], d)?,
            bias: tensor(s, &format!("{name}.bias"), [config.width], d)?,
            epsilon: config.epsilon,
        })
    }

    fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        layer_norm(x, self.weight.clone(), Some(self.bias.clone()), self.epsilon)
    }
}

impl Vit {
    pub fn build(s: &mut impl Source, config: VitConfig, device: &Device) -> Result<Self, MetricsError> {
        let d = config.width;
        let tokens = 1 + (config.side / config.patch).pow(2);
        let pixels = 3 * config.patch * config.patch;
        // The convolution over whole patches is a linear map of a patch's pixels, channel by channel.
        let conv: Tensor<4> = tensor(s, "patch_embed.proj.weight", [d, 3, config.patch, config.patch], device)?;
        Ok(Self {
            config,
            class: tensor(s, "cls_token", [1, 1, d], device)?,
            position: tensor(s, "pos_embed", [1, tokens, d], device)?,
            patches: Linear {
                weight: conv.reshape([d, pixels]).transpose(),
                bias: tensor(s, "patch_embed.proj.bias", [d], device)?,
            },
            pre_norm: config.pre_norm.then(|| Norm::load(s, "pos_drop", &config, device)).transpose()?,
            blocks: (0..config.depth)
                .map(|i| {
                    let name = |part: &str| format!("blocks.{i}.{part}");
                    Ok(Block {
                        norm1: Norm::load(s, &name("norm1"), &config, device)?,
                        qkv: Linear::load(s, &name("attn.qkv"), d, 3 * d, device)?,
                        out: Linear::load(s, &name("attn.proj"), d, d, device)?,
                        norm2: Norm::load(s, &name("norm2"), &config, device)?,
                        fc1: Linear::load(s, &name("mlp.fc1"), d, 4 * d, device)?,
                        fc2: Linear::load(s, &name("mlp.fc2"), 4 * d, d, device)?,
                    })
                })
                .collect::<Result<_, MetricsError>>()?,
            head: match config.projection {
                None => None,
                Some(width) => Some((Norm::load(s, "norm", &config, device)?, tensor(s, "proj", [d, width], device)?)),
            },
        })
    }

    /// Features of normalized images. `[b, 3, side, side]` to `[b, width]`
    pub fn forward(&self, images: Tensor<4>) -> Tensor<2> {
        let c = &self.config;
        let [b, _, _, _] = images.dims();
        let (n, p) = (c.side / c.patch, c.patch);
        let patches = images.reshape([b, 3, n, p, n, p]).permute([0, 2, 4, 1, 3, 5]).reshape([b, n * n, 3 * p * p]);
        let patches = self.patches.forward(patches);
        let mut x = Tensor::cat(vec![self.class.clone().repeat_dim(0, b), patches], 1) + self.position.clone();
        if let Some(norm) = &self.pre_norm {
            x = norm.forward(x);
        }
        for block in &self.blocks {
            x = block.forward(x, c);
        }
        let class = x.narrow(1, 0, 1); // [b, 1, d]
        match &self.head {
            None => class.reshape([b, c.width]),
            Some((norm, projection)) => norm.forward(class).reshape([b, c.width]).matmul(projection.clone()),
        }
    }
}

impl Block {
    fn forward(&self, x: Tensor<3>, config: &VitConfig) -> Tensor<3> {
        let [b, tokens, d] = x.dims();
        let heads = config.heads;
        let qkv = self.qkv.forward(self.norm1.forward(x.clone()));
        let part = |i: usize| qkv.clone().narrow(2, i * d, d).reshape([b, tokens, heads, d / heads]).swap_dims(1, 2);
        let y = attention(part(0), part(1), part(2), None, None, AttentionModuleOptions::default());
        let x = x + self.out.forward(y.swap_dims(1, 2).reshape([b, tokens, d]));
        let y = self.fc1.forward(self.norm2.forward(x.clone()));
        let y = if config.quick_gelu { y.clone() * sigmoid(y * 1.702) } else { gelu(y) };
        x + self.fc2.forward(y)
    }
}
