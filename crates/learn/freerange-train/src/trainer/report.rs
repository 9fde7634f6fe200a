//! What training tells of itself.

use crate::validation::Figures;

/// What is reported after a step.
#[derive(Clone, Debug, serde::Serialize)]
pub struct StepReport {
    /// Steps taken so far, this one included.
    pub step: u64,
    /// Total loss.
    pub loss: f32,
    /// Flow-matching term.
    pub flow: f32,
    /// L1 over input views.
    pub seen: f32,
    /// L1 over held-out views.
    pub held: f32,
    /// Norm of the gradients before clipping.
    pub gradient_norm: f32,
    /// Learning rate.
    pub learning_rate: f64,
    /// Seconds that the step took.
    pub seconds: f64,
    /// Of these, seconds spent waiting for objects and making tensors of them (for the next step; a GPU works meanwhile).
    pub data_seconds: f64,
    /// Steps so far whose loss or gradients were not finite: they changed nothing.
    pub skipped: u64,
    /// Objects so far that could not be read.
    pub broken: u64,
    /// Seconds that each of several ranks had worked when it began to wait for the others.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub rank_seconds: Vec<f32>,
    /// Seconds that this rank of several spent on the sum, its wait for the slowest included.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sum_seconds: Option<f64>,
    /// Whether [`Trainer::stop_when`](super::Trainer::stop_when) said so, on any rank.
    #[serde(skip)]
    pub stop: bool,
}

impl StepReport {
    /// The rank that the others waited for, and for how many seconds they did on average; none of a single rank.
    pub fn slowest(&self) -> Option<(usize, f32)> {
        let (rank, most) = self.rank_seconds.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1))?;
        let others = self.rank_seconds.len().checked_sub(1).filter(|&n| n > 0)?;
        let waited: f32 = self.rank_seconds.iter().map(|s| most - s).sum();
        Some((rank, waited / others as f32))
    }
}

/// What is reported after a measurement on objects that training does not see.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Validated {
    /// Steps taken so far.
    pub step: u64,
    /// Samples seen so far.
    pub seen_samples: u64,
    /// What was measured.
    pub validation: Figures,
    /// The best measurement so far, this one included, which `best.safetensors` is of; none where no PSNR was a number.
    pub best: Option<Best>,
}

/// The best measurement of a run.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Best {
    /// Steps taken by then.
    pub step: u64,
    /// [`Figures::psnr`].
    pub psnr: f64,
}

impl Best {
    /// Whether it takes the place of the best one before. What is not finite never does.
    pub(super) fn is_better_than(self, before: Option<Self>) -> bool {
        self.psnr.is_finite() && before.is_none_or(|before| self.psnr > before.psnr)
    }
}
