//! Image quality: MSE, PSNR, L1, and structural similarity with its gradient; with the feature `networks` also LPIPS,
//! DINO similarity, DreamSim and FID.
//!
//! Images are flat `[height, width, 3]` slices of `f32` in `[0, 1]`. Every function refuses slices whose
//! lengths do not match and non-finite pixels never pass as good: they make the result NaN, not a number (an
//! `Evaluator` refuses them).

mod error;
#[cfg(feature = "networks")]
mod frechet;
mod metric;
#[cfg(feature = "networks")]
mod networks;
mod pixel;
mod ssim;
mod ssim_cropped;
#[cfg(feature = "networks")]
pub mod weights;

pub use error::MetricsError;
#[cfg(feature = "networks")]
pub use frechet::{FeatureStatistics, frechet_distance};
pub use metric::Metric;
#[cfg(feature = "networks")]
pub use networks::{
    Evaluator, EvaluatorConfig, Inception, Lpips, LpipsNet, NotComputed, Pair, Scores, VGG_WIDTH, cosine_similarity,
};
pub use pixel::{HIGHEST_PSNR, capped_psnr, l1, mse, psnr, psnr_from_mse};
pub use ssim::{photometric_loss, ssim_3dgs, ssim_with_gradient};
pub use ssim_cropped::{ssim_skimage_gauss, ssim_skimage_sample};

/// Number of colour channels of every image in this crate.
pub const CHANNELS: usize = 3;
