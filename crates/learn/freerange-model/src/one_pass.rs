//! From the last tokens of a model that predicts in one pass to Gaussians.
//!
//! Three of them stand beside flow matching: latent tokens (the paper's "No Flow Matching"), whose rows are normalized
//! Gaussians as they are; pixel-aligned ones, bounded as GS-LRM's (Zhang et al. 2024); voxel-aligned ones, bounded as
//! LaRa's (Chen et al. 2024), from what the views show at each cell. Lengths are of the canonical frame, in which the object's sphere has the diameter 1. Both
//! papers' scenes have twice that, so that their bounds on lengths are halved here.

use burn::tensor::{Tensor, TensorData, activation::sigmoid};

use crate::{
    CellViews, ModelConfig, ModelKind, PLUCKER, VolumeConfig,
    config::{CHANNELS, PIXEL_CHANNELS},
    encoder::patches,
};

/// How far along its ray a pixel-aligned Gaussian can be from where the ray passes the center of the frame: the object's
/// radius, and what a frame estimated from few photos may be off.
pub(crate) const REACH: f32 = 0.75;
/// What is added to the log scales of pixel-aligned Gaussians, and what they are at most.
const PIXEL_SCALE: [f32; 2] = [-2.3 - std::f32::consts::LN_2, -1.2 - std::f32::consts::LN_2];
/// What is added to logits of opacity: Gaussians begin faint.
const OPACITY_BIAS: f32 = -2.0;
/// Half of a volume's side: the object's radius and a margin for the estimated frame.
pub(crate) const HALF_SIDE: f32 = 0.55;
/// Largest scale of a voxel-aligned Gaussian, in cells; they begin at half a cell.
const LARGEST_IN_CELLS: f32 = 2.0;

/// What binds Gaussians to the input views, in a model of one pass.
#[derive(Clone, Debug)]
#[expect(clippy::large_enum_variant, reason = "one per batch")]
pub enum Alignment {
    /// One Plücker ray per pixel, `[b, views, h, w, 6]`, of a [pixel-aligned](ModelKind::PixelAligned) model.
    Rays(Tensor<5>),
    /// What the views show of each token of a [voxel-aligned](ModelKind::VoxelAligned) model.
    Cells(CellViews),
}

/// Turns the rows of tokens into Gaussians. Without weights.
#[derive(Clone, Debug)]
pub(crate) enum Decoder {
    /// Rows are Gaussians, several per token. Of flow matching, too, which needs no decoder.
    Plain,
    /// One Gaussian per pixel of patches of this side.
    Pixels(usize),
    /// Gaussians near the cells of a volume.
    Volume(VolumeConfig),
}

impl Decoder {
    /// The one of a valid configuration.
    pub fn new(config: &ModelConfig) -> Self {
        match (config.kind, config.volume) {
            (ModelKind::PixelAligned, _) => Self::Pixels(config.encoder.patch_size() as usize),
            (ModelKind::VoxelAligned, Some(volume)) => Self::Volume(volume),
            _ => Self::Plain,
        }
    }

    /// `[b, tokens, channels]`, and for pixels one ray each, `[b, views, h, w, 6]`, to `[b, n, 14]`.
    pub fn decode(&self, out: Tensor<3>, rays: Option<Tensor<5>>) -> Tensor<3> {
        let [b, tokens, channels] = out.dims();
        match (self, rays) {
            (Self::Plain, None) => out.reshape([b, tokens * channels / CHANNELS, CHANNELS]),
            (Self::Pixels(side), Some(rays)) => {
                let pixels = tokens * side * side;
                let rays = patches(rays, *side).reshape([b, pixels, PLUCKER]);
                on_rays(out.reshape([b, pixels, PIXEL_CHANNELS]), rays)
            }
            (Self::Volume(volume), None) => in_cells(out.reshape([b, tokens * channels / CHANNELS, CHANNELS]), volume),
            (_, rays) => panic!("one ray per pixel belongs to a pixel-aligned model: {self:?}, {}", rays.is_some()),
        }
    }
}

/// Between -1 and 1, as twice a sigmoid less one.
fn bounded(x: Tensor<3>) -> Tensor<3> {
    sigmoid(x) * 2.0 - 1.0
}

/// Channels of rotations: quaternions (w, x, y, z), about the identity.
fn rotation(x: Tensor<3>) -> Tensor<3> {
    let identity = Tensor::<1>::from_floats([1.0, 0.0, 0.0, 0.0], &x.device());
    x + identity.reshape([1, 1, 4])
}

/// `a x b` along the last axis. `[b, n, 3]`
fn cross(a: Tensor<3>, b: Tensor<3>) -> Tensor<3> {
    let turned =
        |x: &Tensor<3>, by: usize| Tensor::cat((0..3).map(|i| x.clone().narrow(2, (i + by) % 3, 1)).collect(), 2);
    turned(&a, 1) * turned(&b, 2) - turned(&a, 2) * turned(&b, 1)
}

/// Pixel-aligned Gaussians. `out` `[b, n, 12]`, `rays` `[b, n, 6]` to `[b, n, 14]`.
fn on_rays(out: Tensor<3>, rays: Tensor<3>) -> Tensor<3> {
    let part = |first: usize, count: usize| out.clone().narrow(2, first, count);
    let (moment, direction) = (rays.clone().narrow(2, 0, 3), rays.narrow(2, 3, 3));
    // Of a unit direction and the moment o x d this is the ray's point nearest to the frame's center.
    let nearest = cross(direction.clone(), moment);
    let center = nearest + direction * (bounded(part(0, 1)) * REACH);
    let log_scale = (part(1, 3) + PIXEL_SCALE[0]).clamp_max(PIXEL_SCALE[1]);
    let gaussians = vec![center, log_scale, rotation(part(4, 4)), part(8, 1) + OPACITY_BIAS, sigmoid(part(9, 3))];
    Tensor::cat(gaussians, 2)
}

/// Voxel-aligned Gaussians. `out` `[b, n, 14]`, cell by cell of token by token, to `[b, n, 14]`.
fn in_cells(out: Tensor<3>, volume: &VolumeConfig) -> Tensor<3> {
    let part = |first: usize, count: usize| out.clone().narrow(2, first, count);
    let cell = 2.0 * HALF_SIDE / (volume.tokens_per_side * volume.cells_per_token_side) as f32;
    let of_cell = |center| std::iter::repeat_n(center, volume.gaussians_per_cell).flatten();
    let centers: Vec<f32> = volume.cell_centers().into_iter().flat_map(of_cell).collect();
    let centers = Tensor::<3>::from_data(TensorData::new(centers, [1, out.dims()[1], 3]), &out.device());
    let center = centers + bounded(part(0, 3)) * cell;
    let log_scale = (part(3, 3) + (cell / 2.0).ln()).clamp_max((LARGEST_IN_CELLS * cell).ln());
    Tensor::cat(vec![center, log_scale, rotation(part(6, 4)), part(10, 1) + OPACITY_BIAS, sigmoid(part(11, 3))], 2)
}

impl VolumeConfig {
    /// The center of each token's share in the canonical frame, in the order x, y, z with z fastest.
    pub fn token_centers(&self) -> Vec<[f32; 3]> {
        places(self.tokens_per_side).map(|token| Self::center(token, self.tokens_per_side)).collect()
    }

    /// The center of each cell in the canonical frame, token by token, the cells of a token in the same order as tokens.
    pub fn cell_centers(&self) -> Vec<[f32; 3]> {
        let inner = self.cells_per_token_side;
        let of = |token: [usize; 3]| places(inner).map(move |cell| std::array::from_fn(|i| token[i] * inner + cell[i]));
        let cells = places(self.tokens_per_side).flat_map(of);
        cells.map(|cell| Self::center(cell, self.tokens_per_side * inner)).collect()
    }

    fn center(place: [usize; 3], side: usize) -> [f32; 3] {
        place.map(|i| (i as f32 + 0.5) * 2.0 * HALF_SIDE / side as f32 - HALF_SIDE)
    }
}

fn places(side: usize) -> impl Iterator<Item = [usize; 3]> {
    (0..side.pow(3)).map(move |i| [i / (side * side), i / side % side, i % side])
}
