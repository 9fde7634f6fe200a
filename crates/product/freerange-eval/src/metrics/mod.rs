//! What a render is scored by: PSNR and SSIM (of the rasterizer's crate); with the feature `networks` also LPIPS, DINO
//! similarity, DreamSim and FID.
//!
//! Images are flat `[height, width, 3]` slices of `f32` in `[0, 1]`. An `Evaluator` refuses pixels that are not finite.

mod error;
#[cfg(feature = "networks")]
mod frechet;
mod metric;
#[cfg(feature = "networks")]
mod networks;
#[cfg(feature = "networks")]
pub mod weights;

pub use error::MetricsError;
#[cfg(feature = "networks")]
pub use frechet::{FeatureStatistics, frechet_distance, frechet_distance_of_few};
pub use metric::Metric;
#[cfg(feature = "networks")]
pub use networks::{
    Evaluator, EvaluatorConfig, Inception, Lpips, LpipsNet, NotComputed, Pair, Scores, VGG_WIDTH, cosine_similarity,
};
