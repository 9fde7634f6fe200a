//! The probability path: where a sample is at time t, how fast it moves, and how losses weigh t.
//!
//! Time runs from noise (t = 0) to data (t = 1): `z_t = (1 - t) eps + t z_1`. The network predicts the clean sample
//! ("x-prediction"), from which the velocity follows.

use burn::tensor::Tensor;

/// Smallest `1 - t` that a velocity is divided by. Without it the flow loss has no upper bound near the data.
pub const MIN_REMAINING: f32 = 0.05;

/// `z_t = (1 - t) eps + t z_1`. Shapes: `noise`, `data` `[b, n, c]`, `t` `[b]`.
pub fn interpolate(noise: Tensor<3>, data: Tensor<3>, t: Tensor<1>) -> Tensor<3> {
    let t = t.unsqueeze_dims::<3>(&[1, 2]); // [b, 1, 1]
    noise.clone() + (data - noise) * t
}

/// The flow-matching loss of each sample, `mean |v - (z_1 - eps)|^2` over Gaussians and channels. Returns `[b]`.
///
/// With `v = (z1_hat - z_t) / (1 - t)` and `z_t` on the path, the difference is `(z1_hat - z_1) / (1 - t)`: this form
/// is exact and does not cancel. `1 - t` is kept at or above `min_remaining` (the paper has no such bound; pass 0 for it).
pub fn flow_loss(estimate: Tensor<3>, data: Tensor<3>, t: Tensor<1>, min_remaining: f32) -> Tensor<1> {
    let [b, n, c] = estimate.dims();
    let weight = t.neg().add_scalar(1.0).clamp_min(min_remaining).powf_scalar(-2.0);
    let squared = (estimate - data).square().reshape([b, n * c]).mean_dim(1).reshape([b]);
    squared * weight
}

/// Weight of the rendering losses at time `t`: `w(t) = 50 min(1, t / 0.9)^5` (paper, Section 3.3).
pub fn render_weight(t: f32) -> f32 {
    50.0 * (t / 0.9).min(1.0).powi(5)
}

/// The training time of quantile `u` in `[0, 1]`: the cosine schedule of Nichol and Dhariwal, carried to the linear path at
/// equal signal-to-noise ratio, `t = 1 - 1 / (1 + tan(pi u / 2))`. Rises from 0 to 1.
pub fn cosine_time(u: f32) -> f32 {
    // sin / (sin + cos) is 1 - 1 / (1 + tan) without the pole at u = 1.
    let (sin, cos) = (f64::from(u.clamp(0.0, 1.0)) * std::f64::consts::FRAC_PI_2).sin_cos();
    (sin / (sin + cos)) as f32
}
