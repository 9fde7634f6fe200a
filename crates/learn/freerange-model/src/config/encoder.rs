//! Sizes of the image encoders.

use serde::{Deserialize, Serialize};

use super::limits::{divides, within};
use crate::ModelError;

/// How images become tokens.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum EncoderConfig {
    /// Raw pixels of each patch; needs no outside weights.
    Patch(PatchConfig),
    /// Frozen DINOv2.
    Dinov2(Dinov2Config),
}

/// The encoder without outside weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PatchConfig {
    /// Side of a patch in pixels.
    pub patch_size: u32,
    /// 3 (RGB) or 4 (RGB and alpha).
    pub channels: usize,
}

/// Architecture of a DINOv2; the defaults are `facebook/dinov2-base`. And where its weights lie.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Dinov2Config {
    /// Width.
    pub hidden: usize,
    /// Number of blocks.
    pub layers: usize,
    /// Attention heads.
    pub heads: usize,
    /// Side of a patch in pixels.
    pub patch_size: u32,
    /// Side of the square image for which the position embedding is stored, in pixels.
    pub image_size: u32,
    /// Inner width of the feed-forward network over `hidden`.
    pub mlp_ratio: usize,
    /// SwiGLU instead of GELU in the feed-forward network.
    pub swiglu: bool,
    /// Register tokens; 0 for the first generation of published weights.
    pub registers: usize,
    /// Epsilon of the layer norms.
    pub layer_norm_eps: f64,
    /// Whether queries, keys and values have a bias.
    pub qkv_bias: bool,
    /// Whether the position embedding is shrunk with an antialiasing filter (published: only with registers).
    pub antialias: bool,
    /// Where training finds the published weights: a folder as the Hugging Face hub has it (`config.json` and
    /// `model.safetensors`; in a file, its path is relative to the file), or `hf:owner/name`. A checkpoint has none of
    /// this: it records the weights that it was trained with.
    pub weights: Option<String>,
    /// Random weights instead, for dry runs of training. What is trained on them is of no use.
    pub random: bool,
}

impl Default for PatchConfig {
    fn default() -> Self {
        Self { patch_size: 16, channels: 4 }
    }
}

impl Default for Dinov2Config {
    fn default() -> Self {
        Self {
            hidden: 768,
            layers: 12,
            heads: 12,
            patch_size: 14,
            image_size: 518,
            mlp_ratio: 4,
            swiglu: false,
            registers: 0,
            layer_norm_eps: 1e-6,
            qkv_bias: true,
            antialias: false,
            weights: None,
            random: false,
        }
    }
}

impl Dinov2Config {
    /// The same without a word about where weights come from.
    pub fn architecture(&self) -> Self {
        Self { weights: None, random: false, ..self.clone() }
    }

    /// Inner width of the feed-forward network. SwiGLU keeps the parameter count: two thirds, rounded up to 8.
    pub fn ffn_width(&self) -> usize {
        let inner = self.hidden * self.mlp_ratio;
        if self.swiglu { (inner * 2 / 3).div_ceil(8) * 8 } else { inner }
    }

    /// Patches along a side of the image for which the position embedding is stored.
    pub fn position_side(&self) -> usize {
        (self.image_size / self.patch_size) as usize
    }

    /// Checks every size.
    pub fn validate(&self) -> Result<(), ModelError> {
        within("encoder.hidden", self.hidden, 1, 16_384)?;
        within("encoder.layers", self.layers, 1, 512)?;
        within("encoder.heads", self.heads, 1, 1_024)?;
        within("encoder.patch_size", self.patch_size as usize, 1, 256)?;
        within("encoder.image_size", self.image_size as usize, self.patch_size as usize, 8_192)?;
        within("encoder.mlp_ratio", self.mlp_ratio, 1, 64)?;
        within("encoder.registers", self.registers, 0, 1_024)?;
        divides("encoder.heads", self.heads, "encoder.hidden", self.hidden)?;
        if !(self.layer_norm_eps > 0.0 && self.layer_norm_eps < 1.0) {
            return Err(ModelError::config("encoder.layer_norm_eps", "a number between 0 and 1", self.layer_norm_eps));
        }
        if self.random && self.weights.is_some() {
            return Err(ModelError::config("encoder.random", "false with encoder.weights", true));
        }
        Ok(())
    }
}

impl EncoderConfig {
    /// The same without a word about where weights come from.
    pub fn architecture(&self) -> Self {
        match self {
            Self::Patch(c) => Self::Patch(c.clone()),
            Self::Dinov2(c) => Self::Dinov2(c.architecture()),
        }
    }

    /// Side of a patch in pixels.
    pub fn patch_size(&self) -> u32 {
        match self {
            Self::Patch(c) => c.patch_size,
            Self::Dinov2(c) => c.patch_size,
        }
    }

    /// Channels of the input images: 3 (RGB) or 4 (RGB and alpha).
    pub fn channels(&self) -> usize {
        match self {
            Self::Patch(c) => c.channels,
            Self::Dinov2(_) => 3,
        }
    }

    /// Appearance features per patch, before position, color and ray are appended.
    pub fn features(&self) -> usize {
        match self {
            Self::Patch(c) => c.channels * (c.patch_size * c.patch_size) as usize,
            Self::Dinov2(c) => c.hidden,
        }
    }
}
