//! The loss and its terms; what batches are made of.

use freerange_diffusion::{coupling::Coupling, sample::GradientAt};

/// The training loss (paper, Section 3.3).
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LossConfig {
    /// The flow-matching term.
    pub flow: bool,
    /// The rendering loss over input views, `w(t) R_Seen`.
    pub seen: bool,
    /// The rendering loss over other views, `w(t) R_Held`.
    pub held: bool,
    /// Held-out views per object.
    pub held_views: usize,
    /// Side, in pixels, of the images that the rendering losses compare.
    pub render_size: u32,
    /// Side, in pixels, of the images that the network's gradient channels are taken on.
    pub gradient_size: u32,
    /// Lower bound of `1 - t` in the flow loss.
    pub min_remaining: f32,
    /// Probability that a sample is trained without images, for classifier-free guidance.
    pub unconditional: f32,
    /// How noise is paired with Gaussians.
    pub coupling: Coupling,
    /// Tokens of Gaussians picked at random instead of neighbors in the tree (an ablation of the paper).
    pub random_patches: bool,
    /// Fewest and most input views; the number is drawn for each batch.
    pub input_views: (usize, usize),
    /// Batches that refine initial fits of their input views, which the objects must have; left out: none.
    pub refinement: Option<RefinementLoss>,
    /// Share of the batches in which the network is fed its own estimate, made without a gradient just before
    /// (`model.estimate_channels`).
    pub self_conditioning: f32,
    /// Most estimates made in such a batch, each from the one before; the number is drawn for each batch.
    pub estimates: usize,
    /// Where the gradient that the network sees is taken; at the noisy sample where there is no estimate.
    pub gradient_at: GradientAt,
    /// Fraction of the batches with partial observation: all input views on one side of the object.
    pub one_sided: f32,
    /// Random errors of the canonical frame, since a user's frame is estimated from few views.
    pub frame_jitter: FrameJitter,
    /// Augmentation: a symmetric variant of the object is drawn each time it is used.
    pub symmetries: Symmetries,
}

/// Training of a [`Refiner`](freerange_diffusion::sample::Refiner): batches without noise, at time 0, in which the network is fed an initial
/// fit as an estimate. They have the input views of their fits, and lead to what these should have been:
/// [`InputFit::target`](freerange_data::InputFit).
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RefinementLoss {
    /// Share of the batches that do; the others start from pure noise, with views of their own.
    pub share: f32,
    /// Weight of the rendering losses in them.
    pub render_weight: f32,
}

/// Standard deviations of a training object's frame errors, normal and cut at two of them. 0: none.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FrameJitter {
    /// Of the logarithm of the factor on all lengths.
    pub scale: f32,
    /// Of each coordinate of the center (the object's sphere has radius 0.5).
    pub center: f32,
}

/// Changes that turn an object into an equally likely one: see [`Symmetry`](crate::symmetry::Symmetry).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Symmetries {
    /// Quarter turns about the upright axis, and mirrors that contain it: eight objects of one.
    pub space: bool,
    /// Permutations of red, green and blue: six objects of one.
    pub color: bool,
}

impl Default for LossConfig {
    fn default() -> Self {
        Self {
            flow: true,
            seen: true,
            held: true,
            held_views: 4,
            render_size: 512,
            gradient_size: 512,
            min_remaining: freerange_diffusion::path::MIN_REMAINING,
            unconditional: 0.1,
            coupling: Coupling::Independent,
            random_patches: false,
            input_views: (4, 4),
            refinement: None,
            self_conditioning: 0.0,
            estimates: 1,
            gradient_at: GradientAt::Noisy,
            one_sided: 0.0,
            frame_jitter: FrameJitter::default(),
            symmetries: Symmetries::default(),
        }
    }
}
