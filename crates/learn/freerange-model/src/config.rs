//! Every size of the model, with the paper's values as defaults.

mod encoder;
mod limits;

use serde::{Deserialize, Serialize};

pub use self::encoder::{Dinov2Config, EncoderConfig, PatchConfig};
use self::limits::{divides, within};
use crate::ModelError;

/// Channels per Gaussian.
pub const CHANNELS: usize = freerange_gaussians::channel::COUNT;
/// Channels of a Plücker ray: moment, direction.
pub const PLUCKER: usize = 6;
/// Channels of a pixel-aligned Gaussian before decoding: distance, scales, rotation, opacity, color.
pub(crate) const PIXEL_CHANNELS: usize = 1 + 3 + 4 + 1 + 3;
/// Largest side of the images whose pixels become Gaussians: a million of each.
const MOST_PIXEL_ALIGNED: usize = 1024;
/// Most Gaussians of one object that a volume may have.
const MOST_GAUSSIANS: usize = 1 << 24;
/// Channels per Gaussian of what the input views show of it.
pub const OBSERVATION: usize = 9;
/// Channels per Gaussian of where it lies with respect to what the input views show.
pub const PLACE: usize = 23;

/// What the transformer's tokens stand for, and how Gaussians come out of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ModelKind {
    /// Flow matching over the Gaussians themselves: the paper's model.
    #[default]
    FlowMatching,
    /// Learned latent tokens instead of noise, one pass, no time: "No Flow Matching" in the paper's Table 3.
    LatentTokens,
    /// One pass in which every pixel of the input views becomes a Gaussian on its ray (GS-LRM, Zhang et al. 2024).
    PixelAligned,
    /// One pass from a learned volume of tokens, each cell with a few Gaussians near it (LaRa, Chen et al. 2024).
    VoxelAligned,
}

impl ModelKind {
    /// Whether the model predicts Gaussians in one pass: no noise, no time, nothing fed back.
    pub fn one_pass(self) -> bool {
        self != Self::FlowMatching
    }

    /// As configurations name it.
    pub fn name(self) -> &'static str {
        match self {
            Self::FlowMatching => "flow_matching",
            Self::LatentTokens => "latent_tokens",
            Self::PixelAligned => "pixel_aligned",
            Self::VoxelAligned => "voxel_aligned",
        }
    }
}

/// The learned volume of a [voxel-aligned](ModelKind::VoxelAligned) model. It covers the canonical object, a sphere of
/// radius 0.5, with a margin.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VolumeConfig {
    /// Tokens along a side of the volume.
    pub tokens_per_side: usize,
    /// Cells along a side of each token's share of the volume.
    pub cells_per_token_side: usize,
    /// Gaussians per cell.
    pub gaussians_per_cell: usize,
}

impl VolumeConfig {
    /// Tokens of the whole volume.
    pub fn tokens(&self) -> usize {
        self.tokens_per_side.pow(3)
    }

    /// Gaussians of each token.
    pub fn gaussians_per_token(&self) -> usize {
        self.cells_per_token() * self.gaussians_per_cell
    }

    /// Cells of each token.
    pub fn cells_per_token(&self) -> usize {
        self.cells_per_token_side.pow(3)
    }
}

/// Sizes of the whole network. The defaults are the paper's.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ModelConfig {
    /// What tokens stand for.
    pub kind: ModelKind,
    /// Side of the square input images in pixels; a multiple of the encoder's patch.
    pub image_size: u32,
    /// How images become tokens.
    pub encoder: EncoderConfig,
    /// Width `d` of the transformer.
    pub hidden: usize,
    /// Number of transformer blocks.
    pub blocks: usize,
    /// Attention heads; divides `hidden`.
    pub heads: usize,
    /// Inner width of the feed-forward network; 4 x `hidden` where left out.
    pub ffn: Option<usize>,
    /// Learned tokens that belong to neither image nor Gaussian.
    pub registers: usize,
    /// Neighbors in the tree's order that share one token: 1, 2, 4 or 8.
    pub gaussians_per_token: usize,
    /// Learned tokens of a [`LatentTokens`](ModelKind::LatentTokens) model, which asks for them; 0 for every other kind.
    pub latent_tokens: usize,
    /// The volume of a [`VoxelAligned`](ModelKind::VoxelAligned) model, which asks for it; none for every other kind.
    pub volume: Option<VolumeConfig>,
    /// Width of the sinusoidal embedding of the time; even.
    pub time_features: usize,
    /// Width of the sinusoidal embedding of a patch's position; a multiple of 4.
    pub position_features: usize,
    /// Whether the photometric gradient is an input beside the noisy Gaussians.
    pub gradient_channels: bool,
    /// Self-conditioning (Chen et al. 2022; not the paper's): an earlier estimate of the clean Gaussians is an input, too; zeros
    /// where there is none.
    pub estimate_channels: bool,
    /// Visibility features (not the paper's): how much of each Gaussian of that estimate the input views see, and in which
    /// colors; zeros where there is none.
    pub observation_channels: bool,
    /// Silhouette features (not the paper's): where each Gaussian of that estimate lies with respect to the input views'
    /// silhouettes, the surface, and colors that agree. Needs `observation_channels`.
    pub place_channels: bool,
    /// Preconditioning (Karras et al. 2022; not the paper's): standard deviations, one per channel, of the errors of earlier
    /// estimates, in normalized units. The last layer then predicts the correction alone, at unit variance. Without an
    /// estimate they are 1.
    pub preconditioning: Option<[f32; CHANNELS]>,
}

impl Default for ModelConfig {
    fn default() -> Self {
        Self {
            kind: ModelKind::FlowMatching,
            image_size: 518,
            encoder: EncoderConfig::Dinov2(Dinov2Config::default()),
            hidden: 1024,
            blocks: 18,
            heads: 16,
            ffn: None,
            registers: 32,
            gaussians_per_token: 2,
            latent_tokens: 0,
            volume: None,
            time_features: 256,
            position_features: 32,
            gradient_channels: true,
            estimate_channels: false,
            observation_channels: false,
            place_channels: false,
            preconditioning: None,
        }
    }
}

impl ModelConfig {
    /// The same without a word about where weights come from.
    pub fn architecture(&self) -> Self {
        Self { encoder: self.encoder.architecture(), ..self.clone() }
    }

    /// Inner width of the feed-forward network.
    pub fn ffn_width(&self) -> usize {
        self.ffn.unwrap_or(4 * self.hidden)
    }

    /// Width of one attention head.
    pub fn head_width(&self) -> usize {
        self.hidden / self.heads
    }

    /// Channels of the input images: 3 (RGB) or 4 (RGB and alpha).
    pub fn image_channels(&self) -> usize {
        self.encoder.channels()
    }

    /// Patches along a side of an input image.
    pub fn patches_per_side(&self) -> usize {
        (self.image_size / self.encoder.patch_size()) as usize
    }

    /// Width of an image token before the input projection: features, position, mean color, Plücker ray.
    pub fn image_token_width(&self) -> usize {
        self.encoder.features() + self.position_features + 3 + PLUCKER
    }

    /// Width of a Gaussian token before the input projection.
    pub fn gaussian_channels(&self) -> usize {
        let kinds = 1 + usize::from(self.gradient_channels) + usize::from(self.estimate_channels);
        self.gaussians_per_token * (CHANNELS * kinds + self.observed())
    }

    /// Channels per Gaussian of what the input views show of it.
    pub fn observed(&self) -> usize {
        match (self.observation_channels, self.place_channels) {
            (false, _) => 0,
            (true, false) => OBSERVATION,
            (true, true) => OBSERVATION + PLACE,
        }
    }

    /// Gaussians that come out for `views` images, where a flow-matching model is asked for `2^depth`.
    pub fn gaussians(&self, depth: u32, views: usize) -> usize {
        match self.kind {
            ModelKind::FlowMatching => 1 << depth,
            ModelKind::LatentTokens => self.latent_tokens * self.gaussians_per_token,
            ModelKind::PixelAligned => views * (self.image_size as usize).pow(2),
            ModelKind::VoxelAligned => self.volume.map_or(0, |v| v.tokens() * v.gaussians_per_token()),
        }
    }

    /// Channels of each token that leaves the transformer.
    pub fn output_channels(&self) -> usize {
        match self.kind {
            ModelKind::FlowMatching | ModelKind::LatentTokens => self.gaussians_per_token * CHANNELS,
            ModelKind::PixelAligned => (self.encoder.patch_size() as usize).pow(2) * PIXEL_CHANNELS,
            ModelKind::VoxelAligned => self.volume.map_or(0, |v| v.gaussians_per_token()) * CHANNELS,
        }
    }

    /// Learned tokens in the place of Gaussian tokens: latent tokens, or those of a volume.
    pub fn learned_tokens(&self) -> usize {
        match self.kind {
            ModelKind::FlowMatching | ModelKind::PixelAligned => 0,
            ModelKind::LatentTokens => self.latent_tokens,
            ModelKind::VoxelAligned => self.volume.map_or(0, |v| v.tokens()),
        }
    }

    /// Tokens that become Gaussians, for `views` images and `gaussians` Gaussians.
    pub fn output_tokens(&self, views: usize, gaussians: usize) -> usize {
        match self.kind {
            ModelKind::FlowMatching => gaussians / self.gaussians_per_token,
            ModelKind::PixelAligned => self.image_tokens(views),
            ModelKind::LatentTokens | ModelKind::VoxelAligned => self.learned_tokens(),
        }
    }

    /// What each view shows at a token of a volume, beside its features: one pixel per cell. 0 for other kinds.
    pub fn cell_channels(&self) -> usize {
        self.volume.map_or(0, |v| v.cells_per_token() * self.image_channels())
    }

    pub(crate) fn image_tokens(&self, views: usize) -> usize {
        views * self.patches_per_side().pow(2)
    }

    /// Tokens in the transformer for `views` images and `gaussians` Gaussians.
    pub fn tokens(&self, views: usize, gaussians: usize) -> usize {
        let others = match self.kind {
            ModelKind::PixelAligned => 0, // image tokens themselves become Gaussians
            _ => self.output_tokens(views, gaussians),
        };
        self.registers + self.image_tokens(views) + others
    }

    /// Checks every size; anything this accepts can be built, given the memory.
    pub fn validate(&self) -> Result<(), ModelError> {
        within("hidden", self.hidden, 1, 16_384)?;
        within("blocks", self.blocks, 1, 512)?;
        within("heads", self.heads, 1, 1_024)?;
        within("ffn", self.ffn_width(), 1, 131_072)?;
        within("registers", self.registers, 0, 4_096)?;
        within("time_features", self.time_features, 2, 16_384)?;
        within("position_features", self.position_features, 0, 4_096)?;
        divides("heads", self.heads, "hidden", self.hidden)?;
        if !self.time_features.is_multiple_of(2) {
            return Err(ModelError::config("time_features", "an even number", self.time_features));
        }
        if !self.position_features.is_multiple_of(4) {
            return Err(ModelError::config("position_features", "a multiple of 4", self.position_features));
        }
        if ![1, 2, 4, 8].contains(&self.gaussians_per_token) {
            return Err(ModelError::config("gaussians_per_token", "1, 2, 4 or 8", self.gaussians_per_token));
        }
        if let Some(deviations) = self.preconditioning
            && !deviations.iter().all(|d| (1e-3..=1e3).contains(d))
        {
            let found = format!("{deviations:?}");
            return Err(ModelError::config("preconditioning", "14 numbers between 0.001 and 1000", found));
        }
        if self.observation_channels && !self.estimate_channels {
            let expected = "false without estimate_channels";
            return Err(ModelError::config("observation_channels", expected, self.observation_channels));
        }
        if self.place_channels && !self.observation_channels {
            return Err(ModelError::config(
                "place_channels",
                "false without observation_channels",
                self.place_channels,
            ));
        }
        self.validate_kind()?;
        match &self.encoder {
            EncoderConfig::Patch(c) => {
                within("encoder.patch_size", c.patch_size as usize, 1, 256)?;
                within("encoder.channels", c.channels, 3, 4)?;
            }
            EncoderConfig::Dinov2(c) => c.validate()?,
        }
        within("image_size", self.image_size as usize, self.encoder.patch_size() as usize, 8_192)?;
        if !self.image_size.is_multiple_of(self.encoder.patch_size()) {
            let expected = format!("a multiple of the encoder's patch size {}", self.encoder.patch_size());
            return Err(ModelError::config("image_size", expected, self.image_size));
        }
        Ok(())
    }
}

impl ModelConfig {
    /// Refuses parts that this kind of model does not have.
    fn validate_kind(&self) -> Result<(), ModelError> {
        let kind = self.kind.name();
        let only = |field: &'static str, there: bool, wanted: bool| match (there, wanted) {
            (true, false) => Err(ModelError::config(field, format!("none with kind = \"{kind}\""), "one")),
            (false, true) => Err(ModelError::config(field, format!("one with kind = \"{kind}\""), "none")),
            _ => Ok(()),
        };
        only("latent_tokens", self.latent_tokens > 0, self.kind == ModelKind::LatentTokens)?;
        within("latent_tokens", self.latent_tokens, 0, 1 << 20)?;
        only("volume", self.volume.is_some(), self.kind == ModelKind::VoxelAligned)?;
        if let Some(VolumeConfig { tokens_per_side, cells_per_token_side, gaussians_per_cell }) = self.volume {
            within("volume.tokens_per_side", tokens_per_side, 1, 64)?;
            within("volume.cells_per_token_side", cells_per_token_side, 1, 8)?;
            within("volume.gaussians_per_cell", gaussians_per_cell, 1, 64)?;
            within("volume (Gaussians of all its cells)", self.gaussians(0, 0), 1, MOST_GAUSSIANS)?;
        }
        if self.kind == ModelKind::PixelAligned {
            within("image_size", self.image_size as usize, 1, MOST_PIXEL_ALIGNED)?;
        }
        if self.kind.one_pass() {
            only("gradient_channels", self.gradient_channels, false)?;
            only("estimate_channels", self.estimate_channels, false)?;
            only("preconditioning", self.preconditioning.is_some(), false)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_the_papers() {
        let config = ModelConfig::default();
        config.validate().unwrap();
        assert_eq!((config.image_token_width(), config.gaussian_channels()), (809, 56));
        assert_eq!((config.head_width(), config.ffn_width()), (64, 4096));
        let small = ModelConfig { image_size: 224, ..config };
        assert_eq!(small.tokens(4, 2048), 32 + 4 * 256 + 1024);
    }

    #[test]
    fn a_file_may_name_any_part() {
        let text =
            "hidden = 64\nheads = 4\nimage_size = 64\n[encoder]\nkind = \"patch\"\npatch_size = 8\nchannels = 3\n";
        let config: ModelConfig = toml::from_str(text).unwrap();
        config.validate().unwrap();
        assert_eq!(config.ffn_width(), 256);
        assert_eq!(config.image_token_width(), 3 * 64 + 41);
        let again: ModelConfig = toml::from_str(&toml::to_string(&config).unwrap()).unwrap();
        assert_eq!(again, config);
    }

    #[test]
    fn unknown_fields_are_refused() {
        assert!(toml::from_str::<ModelConfig>("hiden = 64").unwrap_err().to_string().contains("hiden"));
        let text = "[encoder]\nkind = \"patch\"\npatchsize = 8\n";
        assert!(toml::from_str::<ModelConfig>(text).unwrap_err().to_string().contains("patchsize"));
    }

    #[test]
    fn nonsense_is_refused_by_name() {
        let good = ModelConfig::default;
        let cases: [(&str, ModelConfig); 8] = [
            ("heads", ModelConfig { heads: 5, ..good() }),
            ("heads", ModelConfig { heads: 0, ..good() }),
            ("hidden", ModelConfig { hidden: 0, ..good() }),
            ("gaussians_per_token", ModelConfig { gaussians_per_token: 3, ..good() }),
            ("time_features", ModelConfig { time_features: 7, ..good() }),
            ("position_features", ModelConfig { position_features: 30, ..good() }),
            ("image_size", ModelConfig { image_size: 512, ..good() }),
            ("blocks", ModelConfig { blocks: usize::MAX, ..good() }),
        ];
        for (name, config) in cases {
            let message = config.validate().unwrap_err().to_string();
            assert!(message.contains(&format!(" {name}: expected")), "{message}");
        }
    }
}
