//! AdamW, and the learning rate over a run.

use freerange_model::Compute;
use freerange_util::{Invalid, check};

use crate::ranks::AllReduceDtype;

/// AdamW and its schedule.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OptimizerConfig {
    /// Highest learning rate, reached after the warm-up.
    pub learning_rate: f64,
    /// Learning rate at the end.
    pub final_learning_rate: f64,
    /// Shape of the decrease.
    pub schedule: RateSchedule,
    /// Steps of linear warm-up.
    pub warmup: u64,
    /// Decoupled weight decay.
    pub weight_decay: f32,
    /// Parameters with weight decay.
    pub decay: Decay,
    /// First and second moment decay.
    pub betas: (f32, f32),
    /// Largest joint norm of the gradients.
    pub clip: f32,
    /// Decay of the moving average of the weights (reached gradually over the first steps).
    pub ema: f32,
    /// Precision of the blocks: `f32`, `bf16`, or `auto` for bf16 where the device has it, chosen once for a run. Weights and sums stay in 32 bits.
    pub compute: Compute,
    /// All-reduce dtype of gradients: `f32`, or `bf16` for half of the bytes.
    pub all_reduce_dtype: AllReduceDtype,
    /// Gradient checkpointing: keep only the input of each block and compute it again for the gradient. A fraction of the memory
    /// for a third more work.
    pub recompute: bool,
}

impl Default for OptimizerConfig {
    fn default() -> Self {
        Self {
            learning_rate: 1e-4,
            final_learning_rate: 5e-6,
            schedule: RateSchedule::Cosine,
            warmup: 2000,
            weight_decay: 0.01,
            decay: Decay::All,
            betas: (0.9, 0.95),
            clip: 1.0,
            ema: 0.9999,
            compute: Compute::F32,
            all_reduce_dtype: AllReduceDtype::F32,
            recompute: false,
        }
    }
}

/// Which parameters decay.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Decay {
    /// All.
    #[default]
    All,
    /// Those of two axes or more: neither biases nor factors of norms.
    Matrices,
}

/// How the learning rate falls after the warm-up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RateSchedule {
    /// Along half a cosine over the whole run.
    #[default]
    Cosine,
    /// Constant until the last `decay` steps, then linear. A run can be made longer at any time before.
    Constant {
        /// Steps of the decrease; 0: none.
        decay: u64,
    },
}

impl OptimizerConfig {
    /// Refuses what no step could be taken with.
    pub(super) fn validate(&self) -> Result<(), Invalid> {
        let (high, low) = (self.learning_rate, self.final_learning_rate);
        check(high.is_finite() && high > 0.0, "optimizer.learning_rate", "a finite number above 0", high)?;
        check(low.is_finite() && low >= 0.0, "optimizer.final_learning_rate", "a finite number, 0 or more", low)?;
        let decay = self.weight_decay;
        check(decay.is_finite() && decay >= 0.0, "optimizer.weight_decay", "a finite number, 0 or more", decay)?;
        let below_one = |beta: f32| (0.0..1.0).contains(&beta);
        let (first, second) = self.betas;
        check(below_one(first) && below_one(second), "optimizer.betas", "two numbers, 0 to below 1", self.betas)?;
        check(below_one(self.ema), "optimizer.ema", "0 to below 1", self.ema)?;
        check(self.clip > 0.0, "optimizer.clip", "above 0", self.clip)?;
        // Nothing scales the loss here, and without that the gradients of many weights round to zero.
        check(self.compute != Compute::F16, "optimizer.compute", "\"f32\" or \"bf16\"", "f16")
    }

    /// The learning rate of step `step` of `total`: linear warm-up, then the schedule.
    pub fn rate(&self, step: u64, total: u64) -> f64 {
        if step < self.warmup {
            return self.learning_rate * (step + 1) as f64 / self.warmup as f64;
        }
        let left = match self.schedule {
            RateSchedule::Cosine => {
                let progress = (step - self.warmup) as f64 / (total.saturating_sub(self.warmup)).max(1) as f64;
                0.5 * (1.0 + (std::f64::consts::PI * progress.min(1.0)).cos())
            }
            RateSchedule::Constant { decay } => (total.saturating_sub(step) as f64 / decay.max(1) as f64).min(1.0),
        };
        self.final_learning_rate + (self.learning_rate - self.final_learning_rate) * left
    }
}
