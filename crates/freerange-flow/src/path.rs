//! The probability path: where a sample is at time t, how fast it moves, and how losses weigh t.
//!
//! Time runs from noise (t = 0) to data (t = 1): `z_t = (1 - t) eps + t z_1`. The network predicts the clean sample
//! ("x-prediction"), from which the velocity follows.

use burn::tensor::Tensor;
use freerange_core::{Invalid, check};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

/// Smallest `1 - t` that a velocity is divided by. Without it the flow loss has no upper bound near the data.
pub const MIN_REMAINING: f32 = 0.05;

/// `z_t = (1 - t) eps + t z_1`. Shapes: `noise`, `data` `[b, n, c]`, `t` `[b]`.
pub fn interpolate(noise: Tensor<3>, data: Tensor<3>, t: Tensor<1>) -> Tensor<3> {
    let t = t.unsqueeze_dims::<3>(&[1, 2]); // [b, 1, 1]
    noise.clone() + (data - noise) * t
}

/// Where a path that begins at a known guess is at time `t`, between the guess and the data, apart from noise.
///
/// A guess mixed with noise to time `start`, `z_start = (1 - start) eps + start guess`, and then carried in a straight line
/// to the data at time 1, is at `z_t = (1 - t) eps + t y` with `y = (1 - w) z_1 + w guess`: this returns `w`, which falls
/// from 1 at `start` to 0. Such paths have the velocity `(z_1 - z_t) / (1 - t)`, as those from pure noise.
pub fn guess_weight(t: f32, start: f32) -> f32 {
    if t <= start {
        return 1.0;
    }
    let done = (t - start) / (1.0 - start);
    (1.0 - done) * start / t
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

/// How training times are drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TimeSchedule {
    /// The cosine schedule of Nichol and Dhariwal, carried to the linear path at equal signal-to-noise ratio:
    /// `t = 1 - 1 / (1 + tan(pi u / 2))`.
    #[default]
    Cosine,
    /// `t = u`.
    Uniform,
    /// The logistic function of a normal variable (Esser et al. 2024).
    LogitNormal {
        /// Its mean; above 0 later times are drawn more often.
        mean: f32,
        /// Its standard deviation.
        deviation: f32,
    },
}

impl TimeSchedule {
    /// Refuses parameters that no time can be drawn with.
    pub fn validate(self) -> Result<(), Invalid> {
        let Self::LogitNormal { mean, deviation } = self else { return Ok(()) };
        check(mean.is_finite(), "loss.time.mean", "a finite number", mean)?;
        check(deviation.is_finite() && deviation >= 0.0, "loss.time.deviation", "a finite number, 0 or more", deviation)
    }

    /// Draws a time.
    pub fn draw(self, rng: &mut impl Rng) -> f32 {
        match self {
            Self::Cosine => cosine_time(rng.random()),
            Self::Uniform => rng.random(),
            Self::LogitNormal { mean, deviation } => {
                let normal: f32 = StandardNormal.sample(rng);
                1.0 / (1.0 + (-(mean + deviation * normal)).exp())
            }
        }
    }
}

/// The time of quantile `u` in `[0, 1]` under [`TimeSchedule::Cosine`]; rises from 0 to 1.
pub fn cosine_time(u: f32) -> f32 {
    // sin / (sin + cos) is 1 - 1 / (1 + tan) without the pole at u = 1.
    let (sin, cos) = (f64::from(u.clamp(0.0, 1.0)) * std::f64::consts::FRAC_PI_2).sin_cos();
    (sin / (sin + cos)) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    #[test]
    fn a_path_from_a_guess_has_the_velocity_of_all_paths() {
        // One number: noise, guess, data.
        let (noise, guess, data, start) = (-1.3f32, 0.4f32, 0.9f32, 0.3f32);
        let z = |t: f32| {
            let w = guess_weight(t, start);
            (1.0 - t) * noise + t * ((1.0 - w) * data + w * guess)
        };
        assert!((z(start) - (0.7 * noise + 0.3 * guess)).abs() < 1e-6);
        assert!((z(1.0) - data).abs() < 1e-6);
        for t in [0.31, 0.5, 0.8] {
            let slope = (z(t + 1e-3) - z(t - 1e-3)) / 2e-3;
            assert!((slope - (data - z(t)) / (1.0 - t)).abs() < 1e-3, "{t}");
        }
        assert_eq!((guess_weight(0.0, 0.0), guess_weight(0.5, 0.0)), (1.0, 0.0));
    }

    #[test]
    fn drawn_times_have_the_quantiles_of_their_schedule() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        let mut median = |schedule: TimeSchedule| {
            let mut times: Vec<f32> = (0..4001).map(|_| schedule.draw(&mut rng)).collect();
            assert!(times.iter().all(|t| (0.0..=1.0).contains(t)));
            times.sort_by(f32::total_cmp);
            times[2000]
        };
        assert!((median(TimeSchedule::Cosine) - 0.5).abs() < 0.02);
        assert!((median(TimeSchedule::Uniform) - 0.5).abs() < 0.02);
        let later = TimeSchedule::LogitNormal { mean: 0.5, deviation: 1.0 };
        assert!((median(later) - 0.622).abs() < 0.02);
    }
}
