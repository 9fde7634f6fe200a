//! The training loop: objects in, checkpoints out, resumable at every saved state as if never stopped.

mod encoder;
mod folder;
mod lanes;
mod objects;
mod open;
mod report;
mod state;
mod step;
#[cfg(test)]
mod tests;

use std::{path::PathBuf, rc::Rc};

use burn::{module::Module, tensor::Device};
use freerange_model::{Checkpoint, Compute, Dinov2, FreeRange, ModelConfig};
use freerange_splat::channel;

use self::{lanes::Lane, state::Progress};
pub use self::{
    open::{Among, EncoderWeights, Initial},
    report::{Best, StepReport, Validated},
};
use crate::{
    FlowError,
    batch::Batch,
    config::TrainConfig,
    optimizer::AdamW,
    photometric::Photometric,
    ranks::{Ranks, agree},
    validation::{Figures, Validation},
    weights::Weights,
};

/// A training run in memory.
pub struct Trainer {
    config: TrainConfig,
    described: serde_json::Value, // the configuration, with how objects are made
    device: Device,               // the plain one
    model: Option<FreeRange>,     // without the frozen encoder; none only while the optimiser changes it
    frozen: Option<Dinov2>,
    average: Weights,
    optimizer: AdamW,
    progress: Progress,
    photometric: Photometric,
    ranks: Rc<dyn Ranks>,
    lanes: Vec<Lane>, // of this rank
    broken: u64,      // objects before those of all streams that could not be read
    stop_when: Box<dyn Fn() -> bool>,
    ahead: Option<Result<Batch, FlowError>>, // of the next step
    not_finite: u32,                         // steps in a row
    validation: Option<Validation>,
    folder: PathBuf,
}

impl Trainer {
    /// Is asked after every step; once it is so on one rank, the step reports it on all of them alike.
    pub fn stop_when(&mut self, enough: impl Fn() -> bool + 'static) {
        self.stop_when = Box::new(enough);
    }

    /// Steps taken so far.
    pub fn step_count(&self) -> u64 {
        self.progress.step
    }

    /// The configuration of the run.
    pub fn config(&self) -> &TrainConfig {
        &self.config
    }

    fn model(&self) -> &FreeRange {
        self.model.as_ref().expect("a step gives it back")
    }

    /// Measures the averaged weights, if that is due after the steps so far; `best.safetensors` are those of the best
    /// measurement.
    pub fn validate(&mut self) -> Result<Option<Validated>, FlowError> {
        let (step, every) = (self.progress.step, self.config.validation.every);
        let Some(validation) = self.validation.as_ref().filter(|_| step > 0 && step.is_multiple_of(every)) else {
            return Ok(None);
        };
        let tracked = self.average.apply(self.model().clone()).put_dinov2(self.frozen.clone());
        let checkpoint = self.checkpoint(self.averaged())?;
        let stage = self.config.stage(step - 1);
        let own = validation.measure(&checkpoint, &tracked, &self.config, stage, &self.device);
        let (own, pictures) = agree(&*self.ranks, own)?;
        let figures = Figures { pictures, ..Figures::of(&*self.ranks, own)? };
        let found = Best { step, psnr: figures.psnr };
        let best = self.progress.best.filter(|best| best.psnr >= found.psnr).unwrap_or(found);
        if best == found && self.ranks.rank() == 0 {
            checkpoint.save(&self.folder.join("best.safetensors"))?;
        }
        self.progress.best = Some(best);
        Ok(Some(Validated { step, seen_samples: self.samples(), validation: figures, best }))
    }

    /// The model with the averaged weights. Sampling chooses its own arithmetic.
    fn averaged(&self) -> FreeRange {
        self.average.apply(self.model().clone().valid()).with_compute(Compute::F32).with_recompute(false)
    }

    fn gradient_rms(&self) -> [f32; channel::COUNT] {
        // Before the first step nothing is known: one is as good as any, and the channels are clamped.
        self.progress.gradient_square.map(|x| if x > 0.0 { x.sqrt().max(1e-12) } else { 1.0 })
    }

    /// The averaged weights with everything that sampling needs.
    fn checkpoint(&self, average: FreeRange) -> Result<Checkpoint, FlowError> {
        let stage = self.config.stage(self.progress.step.saturating_sub(1));
        let config = ModelConfig { image_size: stage.image_size, ..self.config.model.architecture() };
        let provenance = serde_json::json!({
            "configuration": self.described,
            "steps": self.progress.step,
            "samples": self.samples(),
            "training_seconds": self.progress.seconds,
            "program": concat!("freerange ", env!("CARGO_PKG_VERSION")),
            "sample": self.config.sample,
        });
        Ok(Checkpoint {
            config,
            model: average.put_dinov2(self.frozen.clone()),
            normalization: self.progress.normalization.clone(),
            gradient_rms: self.gradient_rms(),
            depth: stage.depth,
            provenance,
        })
    }

    /// Objects seen so far, counting repetitions.
    fn samples(&self) -> u64 {
        let mut left = self.progress.step;
        self.config.stages.iter().fold(0, |sum, stage| {
            let steps = left.min(stage.steps);
            left -= steps;
            sum + steps * stage.batch as u64
        })
    }
}
